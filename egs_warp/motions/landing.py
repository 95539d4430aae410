"""Landing place of a jump: its height, and whether the ground at this place supports the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.contact.terrain import Solid, surface_above
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.sequence import Stance, TargetError
from egs_warp.motions.stance import sole_shares
from egs_warp.motions.support import SupportPolygon

_MIN_MARGIN = 0.5
"""Minimum distance of the centre of mass from the edge of the supported part of the base, relative to its distance from
the edge of the whole base. With a smaller distance, a body that lands a little too far tips over the edge of the
ground."""
_MAX_HOLLOW = 0.1
"""Depth of the ground below a part of the base, in body heights, at which the ground no longer supports this part.
Hollows of rough ground are shallower."""
_MAX_DROP = 1.0
"""Maximum depth of the landing place below the start, body heights."""
_TRIED = 20
"""Number of equal parts into which the requested distance is divided. The message suggests the largest supported
multiple of a part."""


def landing_of(stance: Stance, target: JumpTarget) -> JumpTarget:
    """Return ``target`` with the rise of the surface on which the feet will land.

    The jump clears the surface by at least half of the requested height. The target is unchanged if the surface is
    higher than the jump, such as a wall or a lintel.

    Raises:
        TargetError: see ``check_landing``.
    """
    rise = _rise(stance, target.distance)
    if np.isfinite(rise) and rise <= target.height:
        target = replace(target, rise=rise, height=max(target.height, rise + 0.5 * target.height))
    check_landing(stance, target)
    return target


def shortened(stance: Stance, target: JumpTarget, distance: float) -> JumpTarget:
    """Return ``target`` with the shorter ``distance``, m, and the rise of the surface there.

    If this surface is higher than that of ``target``, the jump is higher by the difference. Rise and height are
    unchanged if there is no surface, or if it is higher than the jump.
    """
    rise = _rise(stance, distance)
    if not np.isfinite(rise) or rise > target.height:
        return replace(target, distance=distance)
    return replace(target, distance=distance, rise=rise, height=target.height + max(rise - target.rise, 0.0))


def check_landing(stance: Stance, target: JumpTarget) -> None:
    """Check that the ground supports the body where it will land.

    Raises:
        TargetError: there is no ground at the landing place, the ground is too far below, or the centre of mass would
            be too close to the edge of the supported part of the base. The message suggests the largest distance with
            enough support.
    """
    if _is_supported(stance, target.distance, target.rise):
        return
    height = stance.body.height
    supported = [
        distance
        for distance in target.distance * np.arange(_TRIED - 1, 0, -1) / _TRIED
        if _is_supported(stance, distance, max(_rise(stance, distance), -2.0 * _MAX_DROP * height))
    ]
    # Round down, so that the ground supports the body at the suggested distance.
    advice = "turn to another direction first"
    if supported:
        advice = f"give a distance of at most {np.floor(100.0 * supported[0] / height) / 100.0:g}"
    raise TargetError(
        f"the ground ends where the body would land, {target.distance / height:.2g} body heights ahead; {advice}"
    )


def _rise(stance: Stance, distance: float) -> float:
    """Return the height in metres, above the feet, of the surface ``distance`` m ahead of them; 0 if the stance has no
    surfaces, -inf if there is no surface below that point."""
    if not stance.solids:
        return 0.0
    feet, up = sole_shares(stance.body, stance.ground, stance.standing) @ stance.standing, stance.ground.axes[2]
    ahead = surface_above(stance.solids, feet + distance * stance.ground.axes[0], up)
    return ahead - surface_above(stance.solids, feet, up)


def _is_supported(stance: Stance, distance: float, rise: float) -> bool:
    """Return True if the ground supports enough of the base after a displacement by ``distance`` m ahead and ``rise`` m
    up."""
    # Half spaces have no edges, so the ground supports the whole base.
    if distance == rise == 0.0 or all(
        isinstance(surface, Solid) and len(surface.faces) == 1 for surface in stance.solids
    ):
        return True
    height, up = stance.body.height, stance.ground.axes[2]
    if rise < -_MAX_DROP * height:
        return False
    shift = distance * stance.ground.axes[0] + rise * up
    points = stance.contact_points
    # Increase of each point's height above the ground; it is zero on a slope that continues.
    lower = np.array(
        [surface_above(stance.solids, point, up) - surface_above(stance.solids, point + shift, up) for point in points]
    )
    has_ground = lower < _MAX_HOLLOW * height
    # A body that jumps down must not land on the edge from which it jumped.
    if rise < -_MAX_HOLLOW * height and (lower < -_MAX_HOLLOW * height).any():
        return False
    if has_ground.all() or not has_ground.any():
        return bool(has_ground.all())
    local = stance.ground.local(points)[:, :2]
    middle = stance.body.centre_of_mass(stance.ground.local(stance.standing))[:2]
    whole, part = SupportPolygon.hull(local), SupportPolygon.hull(local[has_ground])
    return part.margin(middle) >= _MIN_MARGIN * whole.margin(middle)
