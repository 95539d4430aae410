"""Whether a trajectory that was read is one: its arrays fit each other, and what is drawn from them is finite."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.limits import FURTHEST
from egs_warp.locomotion.trajectory import Trajectory

LONGEST = 86_400.0
"""Seconds of a run, a day: it has so many pictures times sixty."""
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "time": ("states",),
    "dt": ("steps",),
    "positions": ("states", "nodes", 3),
    "velocities": ("states", "nodes", 3),
    "rest_positions": ("nodes", 3),
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
}
"""Extents of each array by name; those of one name are alike."""
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
"""Arrays of whole numbers, each below an extent."""
_POSITIVE = ("node_mass", "height", "metres_per_unit", "ground_spacing", "dt")
_UNKNOWN = ("planned_com", "min_gap")
"""May hold what is not finite: no plan, no point."""


def check_trajectory(t: Trajectory) -> None:
    """Raise ``ValueError``, which names the array, for what cannot be drawn."""
    extents = _extents(t)
    for name in t.__dataclass_fields__:
        values = np.asarray(getattr(t, name))
        if values.dtype.kind not in "iuf":
            raise ValueError(f"{name} holds no numbers")
        if name not in _UNKNOWN and not (np.abs(values) <= FURTHEST).all():
            raise ValueError(f"{name} holds what is not finite or too large")
        if name in _POSITIVE and not (values > 0.0).all():
            raise ValueError(f"{name} is not positive")
    for name, below in _INDICES.items():
        values = getattr(t, name)
        if values.dtype.kind not in "iu" or (values.size and not 0 <= values.min() <= values.max() < extents[below]):
            raise ValueError(f"{name} points at what is not there")
    starts = t.muscle_end_starts
    if (
        starts.dtype.kind not in "iu"
        or starts[0] != 0
        or starts[-1] != extents["entries"]
        or (np.diff(starts) < 0).any()
    ):
        raise ValueError("muscle_end_starts points at what is not there")
    if (np.diff(t.time) <= 0.0).any() or t.time[-1] - t.time[0] > LONGEST:
        raise ValueError("time does not go on from step to step, or for more than a day")
    if not (TetMesh(t.rest_positions, t.tets).volumes() > 0.0).all():
        raise ValueError("tets have no volume in rest_positions")
    if np.linalg.norm(t.gravity) == 0.0:
        raise ValueError("gravity has no direction")
    if np.abs(t.body_axes @ t.body_axes.T - np.eye(3)).max() > 1e-6:
        raise ValueError("body_axes are no axes")


def _extents(t: Trajectory) -> dict[str, int]:
    """What the names of ``_SHAPES`` stand for."""
    found: dict[str, int] = {}
    for name, shape in _SHAPES.items():
        values = getattr(t, name)
        if values.ndim != len(shape) or any(
            found.setdefault(extent, have) != have if isinstance(extent, str) else extent != have
            for extent, have in zip(shape, values.shape, strict=True)
        ):
            raise ValueError(f"{name} has shape {values.shape}")
    found["ends"] = found["offsets"] - 1
    wrong = found["states"] != found["steps"] + 1 or found["planned"] not in (0, found["states"])
    if wrong or min(found[name] for name in ("nodes", "tets", "planes", "offsets")) < 1:
        raise ValueError("its arrays do not fit each other")
    # Of a run that nothing pushed it may be left out.
    unpushed = found["kicks"] == 0 and t.kick_velocity.shape == (0, 0, 3)
    if t.kick_velocity.shape != (found["kicks"], found["nodes"], 3) and not unpushed:
        raise ValueError(f"kick_velocity has shape {t.kick_velocity.shape}")
    return found
