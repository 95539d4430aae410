"""Selection of a gait by the support of the body: bodies on feet or a flat base walk, bodies that lie along the ground
crawl, and balls roll. Bodies that would lose their balance on the feet that stand, or waddle slowly, move in jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.motions.crawl import Crawl
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.footing import FootholdPlanner
from egs_warp.motions.gait import feet_in_turn
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.pendulum import max_lag
from egs_warp.motions.roll import Roll
from egs_warp.motions.route import Route, turn_route
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk
from egs_warp.motions.walk_plan import WalkControl
from egs_warp.motions.walk_posture import LEGGED_TIMING, LeggedPosture, rocking_reason, walking_feet

MIN_STEP_RESERVE = 0.012
"""Minimum reserve of a swing (``step_reserve``), in body heights. During a swing, the measured centre of pressure
differs from the requested one by 0.01 to 0.04 body heights."""
MIN_PACE = 0.04
"""Minimum speed of a waddle with the longest steps that the body can make, in sqrt(g H). The value is empirical: it
lies between those of measured bodies that arrive late (0.038) and in time (0.041). A walk on legs has 0.058, a row of
small jumps 0.1."""
_AMPLE_FRICTION = 1e3
"""Coulomb coefficient with which friction does not limit the steps."""
_JUMP_HEIGHT = 0.3
"""Height in body heights of the jump in which a ball turns about the up axis."""


def move_along(
    stance: Stance, route: Route, step_length: float, *, speed: float = 1.0, step_fraction: float = 1.0
) -> BodyMotion:
    """Return the motion that moves a body along a route.

    Args:
        stance: stance at the start.
        route: route to follow.
        step_length: length of the steps of a walk, m; with infinity, the body makes its longest steps.
        speed: speed relative to the nominal speed.
        step_fraction: factor on the maximum length and maximum turn of the steps of a walk, at most 1.

    Raises:
        UserError: if the body cannot move, or the route leads over a step in the ground.
    """
    base = stance.base()
    if base is SupportKind.LYING:
        return Crawl(stance, route, speed=speed)
    if base is SupportKind.ROUND_BASE:
        return Roll(stance, route, speed=speed)
    return Walk(stance, route, step_length, speed=speed, step_fraction=step_fraction)


def turn_in_place(
    stance: Stance, angle: float, step_length: float, *, speed: float = 1.0, step_fraction: float = 1.0
) -> BodyMotion:
    """Return the motion that turns the body by ``angle`` radians on the spot.

    A ball, which stands on a point, turns in a jump; other bodies turn by the motion of ``move_along``.
    """
    if stance.base() is SupportKind.ROUND_BASE:
        return Turn(stance, JumpTarget(0.0, _JUMP_HEIGHT * stance.body.height), angle)
    return move_along(stance, turn_route(angle), step_length, speed=speed, step_fraction=step_fraction)


def step_reserve(stance: Stance) -> float:
    """Return the smallest error in metres of the capture point, ahead or behind, that the centre of pressure can
    correct in a swing of a walk.

    The planned centre of pressure is the point under the standing feet that is nearest to the centre of mass. Of feet
    that stand ahead of the centre of mass or behind it, this is an edge, and only the margin between the plan and the
    limit of the control is left to correct an error. The result is infinite for a body that does not walk.
    """
    feet, _ = walking_feet(stance)
    if not feet:
        return np.inf
    planner, control = FootholdPlanner(stance, feet), WalkControl()
    com = stance.body.centre_of_mass(stance.ground.local(stance.standing))
    rate, time = float(np.sqrt(np.linalg.norm(stance.body.gravity) / com[2])), LEGGED_TIMING.swing_time
    reserves = []
    for lifted in feet_in_turn(len(feet)):
        standing = [foot for foot in range(len(feet)) if foot not in lifted]
        pressure = planner.support(planner.start, standing, control.planned_margin).nearest(com[:2])
        limits = planner.support(planner.start, standing, control.margin)
        for ahead in np.array([[1.0, 0.0], [-1.0, 0.0]]):
            distance = float(limits.extent(ahead) - pressure @ ahead)
            reserves.append(max_lag(np.array([distance]), time * stance.body.time_unit, rate))
    return min(reserves)


def walking_pace(stance: Stance) -> float:
    """Return the speed in sqrt(g H) at which the body at ``stance`` would waddle with its longest steps, at the nominal
    speed of this gait. The result is infinite for a body that walks on legs or does not walk.

    Friction is assumed to be sufficient to turn a base: on slippery ground, jumps would be shorter, too.
    """
    feet, posture = walking_feet(stance)
    if not feet or posture is LeggedPosture:
        return np.inf
    walk = posture(replace(stance, friction=_AMPLE_FRICTION), feet)
    return walk.step_limits.length / stance.body.height / (walk.timing.swing_time + walk.timing.double_support_time)


def unstable_reason(stance: Stance) -> str | None:
    """Return the reason why the body at ``stance`` would lose its balance in a step; None if it can walk."""
    reserve = step_reserve(stance) / stance.body.height
    if reserve >= MIN_STEP_RESERVE:
        return None
    return (
        f"during a swing, the standing feet could correct an error of the capture point of only {reserve:.3f} body"
        f" heights ahead or behind; a walk needs {MIN_STEP_RESERVE:g}"
    )


def jumping_reason(stance: Stance) -> str | None:
    """Return the reason why the body at ``stance`` should travel in jumps instead of steps; None if it can walk.

    A body on a narrow base or on short legs can waddle, but its steps are in proportion to its width.
    """
    pace = walking_pace(stance)
    if pace >= MIN_PACE:
        return unstable_reason(stance)
    return unstable_reason(stance) or (
        f"it would waddle at only {pace:.3f} sqrt(g H), because {rocking_reason(stance)}; a walk needs {MIN_PACE:g}"
    )
