"""Checks of a loaded trajectory: array shapes are consistent, and the values that are rendered are finite."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.limits import MAX_COORDINATE
from egs_warp.locomotion.trajectory import Trajectory

MAX_DURATION = 86_400.0
"""Maximum duration of a run, s: one day."""
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "time": ("states",),
    "dt": ("steps",),
    "positions": ("states", "nodes", 3),
    "velocities": ("states", "nodes", 3),
    "rest_positions": ("nodes", 3),
    "unloaded_positions": ("nodes", 3),
    "tets": ("tets", 4),
    "node_mass": ("nodes",),
    "gravity": (3,),
    "planes": ("planes", 4),
    "solid_from_plane": ("planes",),
    "contact_step": ("contacts",),
    "contact_nodes": ("contacts", 4),
    "contact_weights": ("contacts", 4),
    "contact_plane": ("contacts",),
    "contact_normal": ("contacts", 3),
    "contact_force": ("contacts", 3),
    "contact_gap": ("contacts",),
    "min_gap": ("states",),
    "activations": ("steps", "segments"),
    "muscle_end_starts": ("offsets",),
    "muscle_end_nodes": ("entries",),
    "muscle_end_weights": ("entries",),
    "muscle_segments": ("segments", 2),
    "muscle_rest_lengths": ("segments",),
    "muscle_stiffness": ("segments",),
    "ground_axes": (3, 3),
    "ground_origin": (3,),
    "ground_coefficients": ("rows", "columns"),
    "kick_step": ("kicks",),
    "planned_com": ("planned", 3),
    "body_axes": (3, 3),
    "body_origin": (3,),
    "front": (3,),
}
"""Extents of each array, as numbers or names; extents with the same name are equal."""
_INDICES = {
    "tets": "nodes",
    "solid_from_plane": "planes",
    "contact_step": "steps",
    "contact_nodes": "nodes",
    "contact_plane": "planes",
    "muscle_end_nodes": "nodes",
    "muscle_segments": "ends",
    "kick_step": "steps",
}
"""Extent below which all values of each integer array must be."""
MAX_BODIES = 10_000
"""Maximum number of bodies of a world; ``contact_plane`` is -1 - k for contacts with body k."""
_POSITIVE = ("node_mass", "height", "metres_per_unit", "ground_spacing", "dt", "relative_stiffness")
_MAY_BE_NAN = ("planned_com", "min_gap")
"""Arrays that may contain NaN, for states without a plan or contact points."""


def check_trajectory(t: Trajectory) -> None:
    """Check the arrays.

    Raises:
        ValueError: the trajectory cannot be rendered; the message names the array.
    """
    extents = _extents(t)
    for name in t.__dataclass_fields__:
        values = np.asarray(getattr(t, name))
        if values.dtype.kind not in "iuf":
            raise ValueError(f"{name} is not numeric")
        if name not in _MAY_BE_NAN and not (np.abs(values) <= MAX_COORDINATE).all():
            raise ValueError(f"{name} has values that are too large or not finite")
        if name in _POSITIVE and not (values > 0.0).all():
            raise ValueError(f"{name} is not positive")
    for name, below in _INDICES.items():
        values, least = getattr(t, name), -MAX_BODIES if name == "contact_plane" else 0
        if values.dtype.kind not in "iu" or (
            values.size and not least <= values.min() <= values.max() < extents[below]
        ):
            raise ValueError(f"{name} has an index out of range")
    starts = t.muscle_end_starts
    if (
        starts.dtype.kind not in "iu"
        or starts[0] != 0
        or starts[-1] != extents["entries"]
        or (np.diff(starts) < 0).any()
    ):
        raise ValueError("muscle_end_starts has an index out of range")
    if (np.diff(t.time) <= 0.0).any() or t.time[-1] - t.time[0] > MAX_DURATION:
        raise ValueError("time does not increase from step to step, or spans more than a day")
    for name in ("rest_positions", "unloaded_positions"):
        if not (TetMesh(getattr(t, name), t.tets).volumes() > 0.0).all():
            raise ValueError(f"tets have no positive volume in {name}")
    if np.linalg.norm(t.gravity) == 0.0:
        raise ValueError("gravity is zero")
    if np.abs(t.body_axes @ t.body_axes.T - np.eye(3)).max() > 1e-6:
        raise ValueError("body_axes are not orthonormal")
    if abs(np.linalg.norm(t.front) - 1.0) > 1e-6 or abs(t.front[2]) > 1e-6:
        raise ValueError("front is not a unit vector along the ground")


def _extents(t: Trajectory) -> dict[str, int]:
    """Return the value of each extent of ``_SHAPES``; raise ``ValueError`` for inconsistent shapes."""
    extents: dict[str, int] = {}
    for name, shape in _SHAPES.items():
        values = getattr(t, name)
        if values.ndim != len(shape) or any(
            extents.setdefault(extent, size) != size if isinstance(extent, str) else extent != size
            for extent, size in zip(shape, values.shape, strict=True)
        ):
            raise ValueError(f"{name} has shape {values.shape}, expected ({', '.join(map(str, shape))})")
    extents["ends"] = extents["offsets"] - 1
    is_wrong = extents["states"] != extents["steps"] + 1 or extents["planned"] not in (0, extents["states"])
    if is_wrong or min(extents[name] for name in ("nodes", "tets", "planes", "offsets")) < 1:
        raise ValueError("its arrays have inconsistent shapes")
    if t.relative_stiffness.shape not in ((0,), (extents["tets"],)):
        raise ValueError(f"relative_stiffness has shape {t.relative_stiffness.shape}, expected ({extents['tets']},)")
    # ``kick_velocity`` may be absent if the run has no pushes.
    has_no_pushes = extents["kicks"] == 0 and t.kick_velocity.shape == (0, 0, 3)
    if t.kick_velocity.shape != (extents["kicks"], extents["nodes"], 3) and not has_no_pushes:
        expected = (extents["kicks"], extents["nodes"], 3)
        raise ValueError(f"kick_velocity has shape {t.kick_velocity.shape}, expected {expected}")
    return extents
