"""Built-in scenes: an object, the complete floor under it, and a camera that shows both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from egs_warp.assets.environments import bedroom, chess_board, cloth_table
from egs_warp.assets.figurine import figurine
from egs_warp.assets.object import BuiltInObject
from egs_warp.assets.pawn import pawn
from egs_warp.assets.snake import snake
from egs_warp.assets.stool import stool
from egs_warp.checked_calls import Seed
from egs_warp.errors import UserError, did_you_mean
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.launching import use_device
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class Scene:
    """An object on its plane in an environment. An upright object is one unit tall, a lying one two units long."""

    __repr__ = short_repr

    name: str
    object: GaussianCloud
    """Gaussians of the object, scene units."""
    background: GaussianCloud
    """The complete environment without the object, scene units: the reference for inpainting."""
    plane: Plane
    """Ground plane under the object, scene units."""
    eye: np.ndarray
    """(3,) Suggested camera position, scene units."""
    target: np.ndarray
    """(3,) Point at the centre of the image, scene units."""

    @property
    def up(self) -> np.ndarray:
        """(3,) Unit normal of the plane."""
        return self.plane.normal

    def whole(self) -> tuple[GaussianCloud, np.ndarray]:
        """Return object and environment as one capture, and the mask (n,) bool of the object's Gaussians."""
        mask = np.zeros(self.object.count + self.background.count, bool)
        mask[: self.object.count] = True
        return concatenate(self.object, self.background), mask

    def camera(self, *, width: int = 512, height: int = 512) -> Camera:
        """Return the suggested camera for an image of ``width`` x ``height`` pixels."""
        return Camera.look_at(self.eye, self.target, self.up, width=width, height=height, vertical_fov_degrees=40.0)


_SCENES: Mapping[str, tuple[Callable[..., BuiltInObject], Callable[..., GaussianCloud], tuple, tuple]] = {
    "pawn": (pawn, chess_board, (1.2, -3.6, 1.7), (0.55, 0.0, 0.42)),
    "stool": (stool, bedroom, (1.5, -2.9, 1.75), (0.0, 0.1, 0.42)),
    "figurine": (figurine, cloth_table, (0.9, -3.0, 1.55), (0.0, 0.0, 0.40)),
    "snake": (snake, bedroom, (2.3, -2.3, 1.35), (0.0, -0.25, 0.1)),
}

BUILT_IN_SCENES: tuple[str, ...] = tuple(_SCENES)
"""Names that ``scene`` accepts."""


def scene(name: str, *, seed: Seed = 0, device: str | None = None) -> Scene:
    """Create the built-in scene ``name``. Equal arguments give bitwise equal scenes. Raises ``UserError`` for an
    unknown name."""
    if name not in _SCENES:
        raise UserError(
            f"scene {name!r} is unknown{did_you_mean(name, BUILT_IN_SCENES)}; give one of {', '.join(BUILT_IN_SCENES)}"
        )
    if device is not None:
        use_device(device)
    make_object, make_environment, eye, target = _SCENES[name]
    built = make_object(seed=seed, device=device)
    return Scene(
        name=name,
        object=built.cloud,
        background=make_environment(seed=seed + 1, device=device),
        plane=built.plane,
        eye=np.array(eye),
        target=np.array(target),
    )
