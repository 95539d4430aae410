"""``creature.npz``: Gaussians, muscles and camera of a run, with which a page can render it from any direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from egs_warp.deformation.deformer import Deformer
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.geometry.main_light import MainLight
from egs_warp.io.arrays import READ_ERRORS, read_npz
from egs_warp.io.atomic import atomic_write
from egs_warp.io.limits import MAX_COORDINATE, check_pixels
from egs_warp.motions.feet import Foot
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.short_repr import short_repr

FILE = "creature.npz"
_LIGHT = ("direction", "half_angle", "shade", "irradiance")
_CAMERA = ("rotation", "translation", "width", "height", "fx", "fy", "cx", "cy", "near", "far")


@dataclass(frozen=True)
class RenderData:
    """Gaussians, muscles and camera of a run; metres, in the frame of the body.

    In the shapes below, P is the number of muscle end points, N the number of nodes, M the number of segments, and F
    the number of fibres.
    """

    __repr__ = short_repr

    splats: GaussianCloud
    """Gaussians at rest, after splitting, to be embedded in the rest cage of the trajectory."""
    camera: Camera
    """Camera of the film."""
    muscle_ends: sp.csr_matrix
    """(P, N) Matrix that maps node positions to end points."""
    muscle_segments: np.ndarray
    """(M, 2) int32, end points of each segment."""
    muscle_bounds: np.ndarray
    """(M,) m, bounds of the activations of the trajectory."""
    fibre_from_segment: np.ndarray
    """(M,) int32, fibre of each segment."""
    fibre_names: tuple[str, ...]
    """(F,) Name of each fibre."""
    fibre_kinds: tuple[str, ...]
    """(F,) Kind of each fibre (``FibreKind``)."""
    foot_from_node: np.ndarray
    """(N,) int32, index of the foot to whose sole a node belongs, -1 for other nodes."""
    light: MainLight | None = None
    """Main light of the film, in the axes of the body; None if it was drawn without one."""

    @classmethod
    def of(
        cls,
        splats: GaussianCloud,
        camera: Camera,
        muscles: MuscleSet,
        feet: Sequence[Foot] = (),
        *,
        light: MainLight | None = None,
    ) -> RenderData:
        """Create the record from the Gaussians, camera and light of a film, and the muscles and feet of the body."""
        foot_from_node = np.full(muscles.node_count, -1, np.int32)
        for index, foot in enumerate(feet):
            foot_from_node[foot.sole] = index
        return cls(
            splats,
            camera,
            muscles.end_rows,
            muscles.segments,
            muscles.bounds,
            muscles.fibre_from_segment,
            muscles.fibre_names,
            tuple(kind.value for kind in muscles.fibre_kinds),
            foot_from_node,
            light,
        )

    def save(self, path: Path, *, deformer: Deformer | None = None) -> None:
        """Write ``creature.npz`` (docs/guide/report.md); equal creatures give bytewise equal files.

        Args:
            path: The file.
            deformer: Deformer of ``splats``. Its precomputed arrays (``Deformer.plan_arrays``) are written too, so that
                programs without this package can deform the splats.
        """
        arrays: dict[str, Any] = {name: getattr(self.splats, name).numpy() for name in ARRAYS}
        arrays["antialiased"] = np.bool_(self.splats.antialiased)
        arrays |= {f"camera_{name}": np.asarray(getattr(self.camera, name)) for name in _CAMERA}
        arrays |= {
            "muscle_end_starts": self.muscle_ends.indptr.astype(np.int32),
            "muscle_end_nodes": self.muscle_ends.indices.astype(np.int32),
            "muscle_end_weights": self.muscle_ends.data,
            "muscle_segments": self.muscle_segments,
            "muscle_bounds": self.muscle_bounds,
            "fibre_from_segment": self.fibre_from_segment,
            "fibre_names": np.array(self.fibre_names, dtype=np.str_),
            "fibre_kinds": np.array(self.fibre_kinds, dtype=np.str_),
            "foot_from_node": self.foot_from_node,
        }
        if self.light is not None:
            arrays |= {f"light_{name}": np.asarray(getattr(self.light, name)) for name in _LIGHT}
        if deformer is not None:
            arrays |= {**deformer.plan_arrays(), "max_stretch": np.float64(deformer.max_stretch)}
        with atomic_write(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: Path, *, node_count: int, device: str | None = None) -> RenderData:
        """Read a file that ``save`` wrote for a cage of ``node_count`` nodes. Raises ``UserError`` for other files."""
        try:
            arrays = read_npz(path)
            camera: dict[str, Any] = {name: arrays[f"camera_{name}"] for name in _CAMERA}
            whole: dict[str, Any] = {name: int(camera[name]) for name in ("width", "height")}
            real: dict[str, Any] = {name: float(camera[name]) for name in ("fx", "fy", "cx", "cy", "near", "far")}
            starts = arrays["muscle_end_starts"]
            rows = (arrays["muscle_end_weights"], arrays["muscle_end_nodes"], starts)
            data = cls(
                GaussianCloud.from_numpy(
                    *(arrays[name] for name in ARRAYS),
                    # Files of runs of earlier versions do not contain this field.
                    antialiased=bool(arrays.get("antialiased", False)),
                    device=device,
                ),
                Camera(**whole, **real, rotation=camera["rotation"], translation=camera["translation"]),
                sp.csr_matrix(rows, shape=(len(starts) - 1, node_count)),
                arrays["muscle_segments"],
                arrays["muscle_bounds"],
                arrays["fibre_from_segment"],
                tuple(map(str, arrays["fibre_names"])),
                tuple(map(str, arrays["fibre_kinds"])),
                arrays["foot_from_node"],
                _light_from(arrays),
            )
            data._check(node_count)
        except FileNotFoundError as error:
            raise UserError(f"{path}: is missing; run egs-warp animate again to write it") from error
        except READ_ERRORS as error:
            raise UserError(f"{path}: cannot be read ({error}); run egs-warp animate again to write it") from error
        return data

    def _check(self, node_count: int) -> None:
        """Raise ``ValueError`` for values that cannot be rendered."""
        camera, ends = self.camera, self.muscle_ends
        ends.check_format()
        check_pixels(camera.width, camera.height, "its camera")
        numbers = np.concatenate([camera.rotation.ravel(), camera.translation, [camera.cx, camera.cy, camera.far]])
        if (camera.rotation.shape, camera.translation.shape) != ((3, 3), (3,)) or not (
            abs(numbers) <= MAX_COORDINATE
        ).all():
            shapes = f"{camera.rotation.shape} and {camera.translation.shape}"
            raise ValueError(
                "its camera has numbers that are too large or not finite, or rotation and translation of the wrong"
                f" shapes {shapes}"
            )
        lengths = np.array([camera.fx, camera.fy, camera.near, camera.far - camera.near])
        if not (lengths > 0.0).all() or lengths.max() > MAX_COORDINATE or min(camera.width, camera.height) < 1:
            raise ValueError(
                f"its camera has fx {camera.fx:g}, fy {camera.fy:g}, near {camera.near:g}, far {camera.far:g} and"
                f" {camera.width} x {camera.height} pixels, which are not possible together"
            )
        count = len(self.muscle_bounds)
        _check_rows("muscle_segments", self.muscle_segments, (count, 2), 0, len(ends.indptr) - 1)
        _check_rows("fibre_from_segment", self.fibre_from_segment, (count,), 0, len(self.fibre_names))
        _check_rows("foot_from_node", self.foot_from_node, (node_count,), -1, node_count)
        if len(self.fibre_names) != len(self.fibre_kinds):
            raise ValueError(f"{len(self.fibre_names)} fibre_names, but {len(self.fibre_kinds)} fibre_kinds")
        if self.muscle_bounds.shape != (count,):
            raise ValueError(f"muscle_bounds has shape {self.muscle_bounds.shape}, expected ({count},)")
        if not np.isfinite(self.muscle_bounds).all():
            raise ValueError("muscle_bounds has values that are not finite")
        if not (np.abs(ends.data) <= MAX_COORDINATE).all():
            raise ValueError("muscle_end_weights has values that are too large or not finite")


def _light_from(arrays: Mapping[str, np.ndarray]) -> MainLight | None:
    """Return the light of a file; None if it has none. Raises ``ValueError`` for an invalid one."""
    if "light_direction" not in arrays:
        return None
    direction, half_angle, shade, irradiance = (np.asarray(arrays[f"light_{name}"], float) for name in _LIGHT)
    return MainLight(direction.reshape(3), float(half_angle), float(shade), irradiance.reshape(4, 4))


def _check_rows(name: str, values: np.ndarray, shape: tuple[int, ...], minimum: int, below: int) -> None:
    """Raise ``ValueError`` unless ``values`` are integers of the given ``shape`` in the range from ``minimum`` to below
    ``below``."""
    if values.shape != shape or values.dtype.kind not in "iu":
        raise ValueError(f"{name} has shape {values.shape} of {values.dtype}, expected integers of shape {shape}")
    if values.size and not minimum <= values.min() <= values.max() < below:
        raise ValueError(
            f"{name} has an index out of range ({values.min()} to {values.max()}, allowed {minimum} to {below - 1})"
        )
