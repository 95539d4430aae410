"""Checks of a loaded trajectory: array shapes are consistent, and the values that are rendered are finite."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.limits import MAX_COORDINATE
from egs_warp.locomotion.trajectory import EXTENTS, Trajectory

MAX_DURATION = 86_400.0
"""Maximum duration of a run, s: one day."""
_INDICES = {
    "tets": "nodes",
    "solid_from_plane": "planes",
    "contact_step": "steps",
    "contact_nodes": "nodes",
    "contact_plane": "planes",
    "joint_step": "steps",
    "joint_nodes": "nodes",
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
            raise ValueError(f"{name} has type {values.dtype}, not numbers")
        if name not in _MAY_BE_NAN and not (np.abs(values) <= MAX_COORDINATE).all():
            raise ValueError(f"{name} has values that are too large or not finite (limit {MAX_COORDINATE:g})")
        if name in _POSITIVE and not (values > 0.0).all():
            raise ValueError(f"{name} is not positive (minimum {values.min():g})")
    for name, below in _INDICES.items():
        values, least = getattr(t, name), -MAX_BODIES if name == "contact_plane" else 0
        if values.dtype.kind not in "iu":
            raise ValueError(f"{name} has type {values.dtype}, not integers")
        if values.size and not least <= values.min() <= values.max() < extents[below]:
            raise ValueError(
                f"{name} has an index out of range ({values.min()} to {values.max()}, allowed {least} to"
                f" {extents[below] - 1})"
            )
    starts = t.muscle_end_starts
    if (
        starts.dtype.kind not in "iu"
        or starts[0] != 0
        or starts[-1] != extents["entries"]
        or (np.diff(starts) < 0).any()
    ):
        raise ValueError(f"muscle_end_starts are not ascending integers from 0 to {extents['entries']}")
    if (np.diff(t.time) <= 0.0).any():
        step = int(np.argmax(np.diff(t.time) <= 0.0))
        raise ValueError(f"time does not increase in step {step}, from {t.time[step]:g} to {t.time[step + 1]:g} s")
    if t.time[-1] - t.time[0] > MAX_DURATION:
        raise ValueError(f"time spans more than a day, {t.time[-1] - t.time[0]:g} s")
    for name in ("rest_positions", "unloaded_positions"):
        if not (TetMesh(getattr(t, name), t.tets).volumes() > 0.0).all():
            raise ValueError(f"tets have no positive volume in {name}")
    if np.linalg.norm(t.gravity) == 0.0:
        raise ValueError("gravity is zero")
    if np.abs(t.body_axes @ t.body_axes.T - np.eye(3)).max() > 1e-6:
        raise ValueError("body_axes are not orthonormal")
    if abs(np.linalg.norm(t.front) - 1.0) > 1e-6 or abs(t.front[2]) > 1e-6:
        raise ValueError(f"front {t.front.tolist()} is not a horizontal unit vector")


def _extents(t: Trajectory) -> dict[str, int]:
    """Return the value of each extent of ``EXTENTS``; raise ``ValueError`` for inconsistent shapes."""
    extents: dict[str, int] = {}
    # Velocities of a run without pushes, and the stiffness of a uniform body, may be absent.
    absent = {"relative_stiffness": (0,), **({} if len(t.kick_step) else {"kick_velocity": (0, 0, 3)})}
    for name, shape in EXTENTS.items():
        values = getattr(t, name)
        if values.shape == absent.get(name):
            continue
        if values.ndim != len(shape) or any(
            extents.setdefault(extent, size) != size if isinstance(extent, str) else extent != size
            for extent, size in zip(shape, values.shape, strict=True)
        ):
            raise ValueError(f"{name} has shape {values.shape}, expected ({', '.join(map(str, shape))})")
    extents["ends"] = extents["offsets"] - 1
    is_wrong = extents["states"] != extents["steps"] + 1 or extents["planned"] not in (0, extents["states"])
    if is_wrong or min(extents[name] for name in ("nodes", "tets", "planes", "offsets")) < 1:
        counts = ", ".join(
            f"{extents[name]} {name}" for name in ("states", "steps", "planned", "nodes", "tets", "planes", "offsets")
        )
        raise ValueError(f"its arrays have inconsistent shapes: {counts}")
    return extents
