"""Check of a route for steps in the ground."""

from __future__ import annotations

import numpy as np

from egs_warp.motions.sequence import Stance, TargetError

MAX_STEP_HEIGHT = 0.03
"""Largest height of an obstacle above the ground, and depth of a hollow below it, in body heights."""


def check_route(stance: Stance, planar_poses: np.ndarray) -> None:
    """Check that a route does not lead over a step in the ground.

    Args:
        stance: stance at the start.
        planar_poses: (n, 3) planar poses of the route; see ``motions.route``.

    Raises:
        TargetError: at the first step that is higher or deeper than ``MAX_STEP_HEIGHT``.
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
            where = f"{x / body.height:.2f} body heights ahead and {y / body.height:.2f} to the left"
            obstacle = f"the surface there is {abs(rise):.2f} body heights {'higher' if rise > 0.0 else 'lower'}"
            raise TargetError(f"walk: the path leads over a step, {where}: {obstacle}; walk around it, or jump or hop")
