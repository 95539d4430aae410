"""What is behind the moving object: a plain floor with a grid, one colour, or a captured scene; and the object's soft
shadow on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.render import backdrop as kernels
from egs_warp.launching import empty, launch_rows
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import ContactShadow

_SKY, _FLOOR, _LINE = wp.vec3(1.0, 1.0, 1.0), wp.vec3(0.86, 0.86, 0.87), wp.vec3(0.74, 0.75, 0.78)
_BUMP = 0.06
"""Of the shadow's reach: what is this high above the plane still takes its shadow, at half strength; of what lies below
it, twice as deep, for through thin spots of a floor one sees deeper."""
_SOFTENED = 0.25
"""Of the window of the median: blur of the edge of what takes the shadow."""


@dataclass(frozen=True)
class Backdrop:
    """What an animation is drawn over, and where on it the shadow of what moves falls. Made for one camera."""

    unshadowed: wp.array
    """(H W,) vec3."""
    shadow: ContactShadow
    strength: wp.array | None
    """(H W,) float32: how much of the shadow each pixel takes; None without one."""

    def shadow_opacity(self, body: GaussianCloud) -> wp.array:
        """(H, W) float32, 0 to about 0.5: how much of what is behind the shadow hides."""
        camera = self.shadow.camera
        if self.strength is None:
            return wp.zeros((camera.height, camera.width), dtype=wp.float32, device=self.shadow.device)
        return self.shadow.cover(body, self.strength).reshape((camera.height, camera.width))

    def background(self, body: GaussianCloud) -> wp.array:
        """(H, W) vec3: what is seen behind ``body``, with its shadow."""
        camera, device = self.shadow.camera, self.shadow.device
        shape = (camera.height, camera.width)
        if self.strength is None:
            return self.unshadowed.reshape(shape)
        colour = empty(len(self.unshadowed), wp.vec3, device)
        cover = self.shadow.cover(body, self.strength)
        launch_rows(kernels.dim_kernel, len(colour), inputs=[self.unshadowed, cover], outputs=[colour], device=device)
        return colour.reshape(shape)


def grid_floor(ground: ContactShadow, *, cell: float, shadow: bool = True) -> Backdrop:
    """A pale plane with a grid whose lines are ``cell`` (world units) apart."""
    colour = empty(len(ground.depth), wp.vec3, ground.device)
    launch_rows(
        kernels.grid_kernel,
        len(colour),
        inputs=[ground.flat, ground.pixel, ground.fade, cell, _SKY, _FLOOR, _LINE],
        outputs=[colour],
        device=ground.device,
    )
    return Backdrop(colour, ground, ground.fade if shadow else None)


def plain_colour(ground: ContactShadow, colour: tuple[float, float, float], *, shadow: bool = True) -> Backdrop:
    """One colour, on which only the shadow falls; its ``cover`` is a shadow to be laid over something else."""
    bare = wp.full(len(ground.depth), wp.vec3(*colour), dtype=wp.vec3, device=ground.device)
    return Backdrop(bare, ground, ground.fade if shadow else None)


def captured_scene(
    scene: GaussianCloud,
    camera: Camera,
    plane: Plane,
    *,
    centre: np.ndarray,
    reach: float,
    grain: float,
    height: float,
    shadow: bool = True,
) -> Backdrop:
    """The rest of a capture, rendered once; the shadow falls where the plane is what one sees.

    ``scene`` in the world's units; ``centre`` (3,) and ``reach`` bound the shadow, ``grain`` and ``height`` are as
    ``ContactShadow`` wants them.
    """
    import cv2

    image, shape = render_gaussians(scene, camera), (camera.height, camera.width)
    depth = np.where(image.alpha.numpy() > 0.5, image.depth.numpy(), 0.0).astype(np.float32)
    ground = ContactShadow(
        camera,
        plane,
        centre=centre,
        reach=reach,
        device=scene.device,
        grain=grain,
        height=height,
        depth=np.asarray(cv2.medianBlur(depth, 5)),
    )
    bare = wp.array(np.clip(image.colour.numpy(), 0.0, 1.0).reshape(-1, 3), dtype=wp.vec3, device=scene.device)
    if not shadow:
        return Backdrop(bare, ground, None)
    lift = ground.lift.numpy().reshape(shape) / (_BUMP * reach)
    on_plane = np.clip(1.5 - np.where(lift > 0.0, lift, -0.5 * lift), 0.0, 1.0)
    on_plane *= ground.depth.numpy().reshape(shape) > 0.0
    # Specks in the air before the floor would shine in the shadow, and hard edges look cut out.
    kernel = 2 * (max(camera.width, camera.height) // 40) + 1
    on_plane = np.asarray(cv2.medianBlur(np.rint(255.0 * on_plane).astype(np.uint8), kernel), np.float32) / 255.0
    on_plane = cv2.GaussianBlur(on_plane, (0, 0), _SOFTENED * kernel)
    strength = on_plane * ground.fade.numpy().reshape(shape) * image.alpha.numpy()
    return Backdrop(bare, ground, wp.array(strength.ravel(), dtype=wp.float32, device=scene.device))
