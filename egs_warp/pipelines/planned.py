"""Where a motion planned the centre of mass to be, beside where it was."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.hop import Hop
from egs_warp.motions.jump import Jump
from egs_warp.motions.sequence import MotionSequence

_SETTLED = 0.3
"""Of sqrt(H / g): when a jump begins to crouch."""


def planned_com(sequence: MotionSequence, body: SoftBody, trajectory: Trajectory) -> np.ndarray:
    """(F+1, 3) metres, NaN where nothing was planned; no rows if nothing was at all.

    Jumps, hops and twists have a plan from the crouch to touch-down, made before the first step; what they do follows
    the measured body instead.
    """
    path = np.full((len(trajectory.time), 3), np.nan)
    for entry, (first, last) in zip(sequence.done, sequence.spans(trajectory.time), strict=True):
        jump = entry.motion.jump if isinstance(entry.motion, Hop) else entry.motion
        if isinstance(jump, Jump):
            start = body.centre_of_mass(trajectory.positions[first])
            for index in range(first, last + 1):
                path[index] = start + _planned(jump, trajectory.time[index] - trajectory.time[first])
    return path if np.isfinite(path).any() else np.zeros((0, 3))


def _planned(jump: Jump, elapsed: float) -> np.ndarray:
    """(3,) metres from where the centre of mass stood, ``elapsed`` seconds after the motion began."""
    plan, ground = jump.plan, jump.ground
    axes = ground.axes @ ground.turn(jump.facing.turn) if jump.left_ground else ground.axes
    elapsed = max(elapsed - _SETTLED * np.sqrt(jump.body.height / jump.gravity), 0.0)
    nothing = np.zeros(3)
    if elapsed <= plan.crouch_time:
        return plan.crouch(nothing, elapsed)[0] @ axes
    elapsed -= plan.crouch_time
    if elapsed <= plan.thrust_time:
        return plan.thrust(nothing, elapsed)[0] @ axes
    position, _ = plan.thrust(nothing, plan.thrust_time)
    elapsed -= plan.thrust_time
    if elapsed > plan.flight_time:
        return np.full(3, np.nan)
    speed = np.array([plan.speed_forward, 0.0, plan.speed_up])
    return (position + elapsed * speed - 0.5 * jump.gravity * elapsed**2 * np.array([0.0, 0.0, 1.0])) @ axes
