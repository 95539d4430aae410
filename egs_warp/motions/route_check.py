"""Whether the ground lets a body go its way."""

from __future__ import annotations

import numpy as np

from egs_warp.errors import UserError
from egs_warp.motions.sequence import Stance

HIGHEST_STEP = 0.03
"""Body heights: what is higher above the ground, or lower below it, stands in the way."""


def check_route(place: Stance, places: np.ndarray) -> None:
    """Raises ``UserError`` where a body that stands at ``place`` comes over a step on its way by ``places`` (n, 3): see
    ``motions.route``."""
    body, ground = place.body, place.ground
    start = ground.local(body.centre_of_mass(place.standing))
    normal = ground.axes @ ground.surface_normal
    slope = -normal[:2] / normal[2]
    for x, y, _ in places:
        level = np.array([start[0] + x, start[1] + y, 0.0])
        level[2] = slope @ level[:2]
        rise = place.surface_height_above(ground.world(level)) / body.height
        if abs(rise) > HIGHEST_STEP:
            where = f"{x / body.height:.2f} ahead and {y / body.height:.2f} to the left"
            found = f"what is there is {abs(rise):.2f} body heights {'higher' if rise > 0.0 else 'lower'}"
            raise UserError(f"walk: the way leads over a step, {where}: {found}; walk round it, or jump or hop")
