"""Measurement of footfalls and foot slip from a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.locomotion.rollout import are_supporting
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import Foot, foot_of_node

_MIN_STANCE_LOAD = 0.05
"""Share of the weight above which a foot supports the body; with a smaller share, it is being set down or lifted."""


@dataclass(frozen=True)
class Footfalls:
    """Slip and landings of the feet in a walk; lengths are relative to the stride."""

    slip: float
    """Largest slip of a foot during one stance, along the ground. The slip in a time step is the mean over the foot's
    contacts, weighted by their normal forces; it is summed over the steps from landing to lift-off."""
    sole_shift: float
    """Largest displacement of the middle of a sole during one stance, from slip and rolling together."""
    landings: int
    """Number of times that a foot landed."""


def footfalls(
    trajectory: Trajectory, feet: Sequence[Foot], *, stride: float, first: int = 0, last: int = -1
) -> Footfalls:
    """Measure the footfalls between two states of a recorded trajectory. Only contacts that support the body count
    (``are_supporting``).

    Args:
        trajectory: recorded motion.
        feet: feet of the body.
        stride: length of a stride, m; if it is 0, slip and shift are reported as 0.
        first: index of the first state.
        last: index of the last state.
    """
    t = trajectory
    last = last % len(t.time)
    up = -t.gravity / np.linalg.norm(t.gravity)
    flat = np.eye(3) - np.outer(up, up)
    weight = t.node_mass.sum() * np.linalg.norm(t.gravity)
    within = (t.contact_step >= first) & (t.contact_step < last)
    within &= are_supporting(t.contact_plane, t.contact_normal, t.gravity, t.world_index)
    step, nodes, shares = t.contact_step[within], t.contact_nodes[within], t.contact_weights[within]
    moved = t.positions[step[:, None] + 1, nodes] - t.positions[step[:, None], nodes]
    slid = np.einsum("cw,cwi->ci", shares, moved) @ flat
    normal = np.einsum("ci,ci->c", t.contact_force[within], t.contact_normal[within])
    foot = foot_of_node(feet)[nodes[np.arange(len(nodes)), np.argmax(shares, axis=1)]]
    slip = shift = 0.0
    landings = 0
    for index, one in enumerate(feet):
        is_own = foot == index
        load = np.bincount(step[is_own] - first, normal[is_own], last - first)
        slip_vector = np.stack(
            [np.bincount(step[is_own] - first, normal[is_own] * slid[is_own, k], last - first) for k in range(3)], 1
        )
        lengths = np.linalg.norm(slip_vector, axis=1) / np.where(load > 0.0, load, 1.0)
        middle = t.positions[first : last + 1, one.sole].mean(axis=1) @ flat
        for begin, end in _runs(load > _MIN_STANCE_LOAD * weight):
            landings += begin > 0
            slip = max(slip, float(lengths[begin:end].sum()))
            stood = middle[begin + 1 : end + 1]
            shift = max(shift, float(np.linalg.norm(stood - stood[0], axis=1).max()))
    over = 1.0 / stride if stride > 0.0 else 0.0
    return Footfalls(over * slip, over * shift, landings)


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return the start and the (exclusive) end of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
