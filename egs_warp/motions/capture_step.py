"""Capture step: a step or hop that places the feet where an unbalanced body can come to rest over them.

A standing body whose capture point has left its support falls unless it moves its feet. A body on legs takes walking
steps; a body on a single base, or one that would lose its balance in a step, hops. See docs/concepts/motions.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.balance import Measurement
from egs_warp.motions.feet import SupportKind, foot_loads
from egs_warp.motions.gait_selection import unstable_reason
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget, level_flight
from egs_warp.motions.pendulum import FallingPendulum, capture_point
from egs_warp.motions.route import Route, StepLimits
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController
from egs_warp.motions.walk import Walk
from egs_warp.motions.walk_posture import LEGGED_TIMING, LeggedPosture, select_posture

FALLEN_TILT = 60.0
"""Tilt in degrees beyond which a body has fallen. A body with feet of half width w and its centre of mass at height h
tips over beyond a tilt of atan(w / h), which is below 60 degrees if the feet are narrower than 3.5 h."""
STEP_MARGIN = 0.02
"""Distance of the capture point outside the support, in body heights, beyond which a body steps."""
STEP_SPEED = 1.6
"""Speed of a capture step, relative to the nominal speed of a walk."""
HOP_HEIGHT = 0.08
"""Height of a capture hop, in body heights."""
_HOP_STYLE = {"anticipation": 0.5, "timing": 0.5}
"""Factors on the style of a capture hop, which has a short crouch and a quick thrust."""
_MIN_COM_HEIGHT = 0.15
"""Lower bound of the height of the centre of mass in the formula of the capture point, in body heights."""
MIN_DISTANCE, MAX_DISTANCE = 0.05, 0.8
"""Minimum and maximum length of a capture step or hop, in body heights."""


def capture_motion(
    stance: Stance, controller: BalanceController, measurement: Measurement, positions: np.ndarray, report: StepReport
) -> Walk | Jump | None:
    """Return the motion that brings an unbalanced body to rest over new footholds.

    It is None if the capture point is in the support or at most ``STEP_MARGIN`` outside, if nothing supports the body,
    if the body has fallen and must get up, or if it cannot step.

    Args:
        stance: stance in which the body stood.
        controller: balance controller of the body in that stance.
        measurement: measured body, in the ground frame of ``stance``.
        positions: (N, 3) m, nodes of the body.
        report: report of the previous time step.
    """
    body = stance.body
    gravity, com = float(np.linalg.norm(body.gravity)), measurement.com
    rate = float(np.sqrt(gravity / max(float(com[2]), _MIN_COM_HEIGHT * body.height)))
    capture = capture_point(com[:2], measurement.velocity[:2] + measurement.angular_velocity_term, rate)
    if (
        report.contacts.count == 0
        or not np.isfinite(capture).all()
        or measurement.support.margin(capture) > -STEP_MARGIN * body.height
        or stance.base() in (SupportKind.ROUND_BASE, SupportKind.LYING)
        or _up_cosine(stance, measurement) < np.cos(np.radians(FALLEN_TILT))
    ):
        return None
    # The body tips over the point of its support that is nearest to the capture point.
    edge = measurement.support.nearest(capture)
    fall = FallingPendulum(com[:2], capture, edge, rate)
    moved, centre = stance.moved_to(positions), measurement.foot_centre - controller.base_offset
    try:
        steps = select_posture(moved)[1] is LeggedPosture and unstable_reason(stance) is None
        return _step(stance, moved, fall, centre, report) if steps else _hop(stance, moved, fall, centre)
    except UserError:
        return None


def _up_cosine(stance: Stance, measurement: Measurement) -> float:
    """Return the cosine of the tilt of the body from its standing pose."""
    up = stance.ground.axes[2]
    return float(up @ measurement.rotation @ up)


def _hop(stance: Stance, moved: Stance, fall: FallingPendulum, centre: np.ndarray) -> Jump:
    """Return the hop of the body that stands at ``moved``, whose feet land under the capture point. ``fall`` is the
    falling pendulum; ``centre`` (2,) m is the standing position of the centre of mass over the present feet. Both are
    in the ground frame of ``stance``."""
    body, gravity = moved.body, float(np.linalg.norm(moved.body.gravity))
    moved = replace(moved, style=moved.style.scaled(_HOP_STYLE))
    height = HOP_HEIGHT * body.height
    take_off = Jump(moved, JumpTarget(0.0, height)).take_off_time(height)
    velocity = fall.velocity_at(take_off)
    landed = fall.com_at(take_off) + velocity * (level_flight(height, body.height, gravity) + 1.0 / fall.rate)
    length, direction = _within_limits(landed - centre, body.height)
    forward = moved.with_forward(direction @ stance.ground.axes[:2])
    return Jump(forward, JumpTarget(length, height), skips_settling=True, catches_fall=True)


def _step(stance: Stance, moved: Stance, fall: FallingPendulum, centre: np.ndarray, report: StepReport) -> Walk:
    """Return the walk of the body that stands at ``moved``, whose feet step under the capture point; the feet with the
    smallest load step first. ``fall`` and ``centre`` (2,) are as for ``_hop``."""
    body = moved.body
    time_unit = float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
    landed = fall.capture_at(LEGGED_TIMING.swing_time * time_unit / STEP_SPEED)
    length, direction = _within_limits(landed - centre, body.height)
    offset = moved.ground.axes[:2] @ (length * direction @ stance.ground.axes[:2])
    walk = Walk(moved, _shift_route(offset), length, speed=STEP_SPEED, skips_shift=True)
    groups, loads = walk.gait.groups, foot_loads(walk.feet, report, body.weight)
    first = int(np.argmin([sum(loads[foot] for foot in group) for group in groups]))
    walk.gait = replace(walk.gait, groups=groups[first:] + groups[:first])
    return walk


def _within_limits(offset: np.ndarray, height: float) -> tuple[float, np.ndarray]:
    """Return the direction (2,) of ``offset`` (2,), and its length limited to the allowed range, m."""
    length = max(float(np.linalg.norm(offset)), 1e-12)
    return float(np.clip(length, MIN_DISTANCE * height, MAX_DISTANCE * height)), offset / length


def _shift_route(offset: np.ndarray) -> Route:
    """Return the route that moves the body by ``offset`` (2,) m in equal steps, without turning."""

    def planar_poses(limits: StepLimits) -> np.ndarray:
        count = max(int(np.ceil(float(np.linalg.norm(offset)) / limits.length)), 1)
        return np.linspace([0.0, 0.0, 0.0], [*offset, 0.0], count + 1)

    return planar_poses
