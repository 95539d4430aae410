"""How a body goes its way, by what it stands on: it walks on feet or a flat base, crawls on its length, rolls as a
ball.
"""

from __future__ import annotations

from egs_warp.motions.crawl import Crawl
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.roll import Roll
from egs_warp.motions.route import Route, turn_route
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk

_LEAP = 0.3
"""Body heights that a ball rises to turn about up."""


def move_along(place: Stance, route: Route, pace_length: float, *, speed: float = 1.0) -> BodyMotion:
    """The motion that takes the body at ``place`` along ``route``; ``pace_length``, metres, is asked of feet, ``speed``
    is over the usual. Raises ``UserError`` for a body that cannot, and where something stands in the way."""
    base = place.base()
    if base is SupportKind.LYING:
        return Crawl(place, route, speed=speed)
    if base is SupportKind.ROUND_BASE:
        return Roll(place, route, speed=speed)
    return Walk(place, route, pace_length, speed=speed)


def turn_in_place(place: Stance, angle: float, pace_length: float, *, speed: float = 1.0) -> BodyMotion:
    """The motion that turns the body by ``angle`` radians on the spot; a ball, which stands on a point, leaps for
    it."""
    if place.base() is SupportKind.ROUND_BASE:
        return Turn(place, JumpTarget(0.0, _LEAP * place.body.height), angle)
    return move_along(place, turn_route(angle), pace_length, speed=speed)
