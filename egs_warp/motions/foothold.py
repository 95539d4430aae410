"""Foothold of a landing: the point nearest to the target over which the body can come to rest."""

from __future__ import annotations

import numpy as np

from egs_warp.motions.balance import Balance
from egs_warp.motions.jump_plan import stopping_time
from egs_warp.motions.support import SupportPolygon, nearest_in_half_planes

MAX_FOOTHOLD_OFFSET = 0.4
"""Maximum offset of the foothold from the capture point towards the target, as a fraction of the footprint."""
NARROW_SUPPORT, WIDE_SUPPORT = np.tan(np.radians([8.0, 17.0]))
"""Distances from the edge of the footprint, relative to the height of the centre of mass: up to the first, the foothold
must equal the capture point; from the second on, the foothold may differ from it by ``MAX_FOOTHOLD_OFFSET``."""


def nearest_foothold(
    balance: Balance,
    target: np.ndarray,
    com: np.ndarray,
    velocity: np.ndarray,
    fall_speed: np.ndarray,
    landing_time: np.ndarray,
) -> np.ndarray:
    """Return the foothold (c, 2) of a landing: the target if the body can come to rest over it, otherwise the nearest
    point over which it can.

    Args:
        balance: balance in the frame of the landing.
        target: (c, 2) m, target of the middle of the feet.
        com: (c, 2) m, centre of mass at touch-down.
        velocity: (c, 2) m/s, velocity along the ground at touch-down.
        fall_speed: (c,) m/s, downward speed at touch-down.
        landing_time: (c,) s, time in which the fall is stopped.
    """
    stop = stopping_time(balance.standing_height, fall_speed, balance.gravity, landing_time)
    capture = com + velocity * stop[:, None] + balance.base_offset
    limits = foothold_limits(balance.footprint, balance.standing_height)
    return capture - nearest_in_half_planes(balance.footprint.normals, limits, capture - target)


def foothold_limits(footprint: SupportPolygon, standing_height: np.ndarray) -> np.ndarray:
    """Return the largest distance (..., m) in metres of the capture point from the foothold towards each edge of the
    ``footprint``; ``standing_height`` (...,), m, is the height of the centre of mass."""
    away = footprint.offsets
    width = away / standing_height[..., None]
    share = np.clip((width - NARROW_SUPPORT) / (WIDE_SUPPORT - NARROW_SUPPORT), 0.0, 1.0)
    return MAX_FOOTHOLD_OFFSET * share * away
