"""Planned path of the centre of mass, for comparison with the simulated one."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.sequence import MotionSequence


def planned_com(sequence: MotionSequence, body: SoftBody, trajectory: Trajectory) -> np.ndarray:
    """Return the planned centre of mass (F + 1, 3) m, which is NaN in states without a plan; the array has no rows if
    no motion has a plan.

    Jumps, hops and twists have a plan from the crouch to touch-down, which is computed before the first step. A turn in
    several twists has a plan of its first twist only. The controllers use the measured state, not this plan.
    """
    path = np.full((len(trajectory.time), 3), np.nan)
    for entry, (first, last) in zip(sequence.done, sequence.spans(trajectory.time), strict=True):
        start = body.centre_of_mass(trajectory.positions[first])
        for index in range(first, last + 1):
            moved = entry.motion.planned_com(trajectory.time[index] - trajectory.time[first])
            if moved is not None:
                path[index] = start + moved
    return path if np.isfinite(path).any() else np.zeros((0, 3))
