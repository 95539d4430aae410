"""Check of a route against steps of the ground."""

from __future__ import annotations

import numpy as np

from egs_warp.errors import UserError
from egs_warp.motions.sequence import Stance

MAX_STEP_HEIGHT = 0.03
"""Largest difference in body heights between the height of an obstacle or gap and that of the ground."""


def check_route(stance: Stance, planar_poses: np.ndarray) -> None:
    """Check that a route does not lead over a step of the ground.

    Args:
        stance: stance at the start.
        planar_poses: (n, 3) planar poses of the route, see ``motions.route``.

    Raises:
        UserError: at the first step that is higher than ``MAX_STEP_HEIGHT``.
    """
    body, ground = stance.body, stance.ground
    start = ground.local(body.centre_of_mass(stance.standing))
    normal = ground.axes @ ground.surface_normal
    slope = -normal[:2] / normal[2]
    for x, y, _ in planar_poses:
        level = np.array([start[0] + x, start[1] + y, 0.0])
        level[2] = slope @ level[:2]
        rise = stance.surface_height_above(ground.world(level)) / body.height
        if abs(rise) > MAX_STEP_HEIGHT:
            where = f"{x / body.height:.2f} ahead and {y / body.height:.2f} to the left"
            obstacle = f"the surface there is {abs(rise):.2f} body heights {'higher' if rise > 0.0 else 'lower'}"
            raise UserError(f"walk: the path leads over a step, {where}: {obstacle}; walk round it, or jump or hop")
