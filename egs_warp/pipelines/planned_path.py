"""Where a motion planned the centre of mass to be, beside where it was."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.sequence import MotionSequence


def planned_com(sequence: MotionSequence, body: SoftBody, trajectory: Trajectory) -> np.ndarray:
    """(F+1, 3) metres, NaN where nothing was planned; no rows if nothing was at all.

    Jumps, hops and twists have a plan from the crouch to touch-down (a turn in several twists that of the first), made
    before the first step; what they do follows the measured body instead.
    """
    path = np.full((len(trajectory.time), 3), np.nan)
    for entry, (first, last) in zip(sequence.done, sequence.spans(trajectory.time), strict=True):
        start = body.centre_of_mass(trajectory.positions[first])
        for index in range(first, last + 1):
            moved = entry.motion.planned_com(trajectory.time[index] - trajectory.time[first])
            if moved is not None:
                path[index] = start + moved
    return path if np.isfinite(path).any() else np.zeros((0, 3))
