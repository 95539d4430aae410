"""Selection of a gait by the support of the body: bodies on feet or a flat base walk, bodies that lie along the ground
crawl, and balls roll."""

from __future__ import annotations

from egs_warp.motions.crawl import Crawl
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.roll import Roll
from egs_warp.motions.route import Route, turn_route
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk

_JUMP_HEIGHT = 0.3
"""Height in body heights of the jump in which a ball turns about the up axis."""


def move_along(
    stance: Stance, route: Route, step_length: float, *, speed: float = 1.0, step_fraction: float = 1.0
) -> BodyMotion:
    """Return the motion that moves a body along a route.

    Args:
        stance: stance at the start.
        route: route to follow.
        step_length: length of the steps of a walk, m.
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
