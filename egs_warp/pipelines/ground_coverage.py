"""Tests whether a body starts and ends its run on captured ground: the simulated ground is infinite, but a captured
table has edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from egs_warp.contact.terrain import Surface
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.motions.planned_legs import Leg
from egs_warp.motions.sequence import Stance
from egs_warp.motions.support import SupportPolygon
from egs_warp.notes import Problem

ENDS_OUTSIDE_GROUND = "it ends beyond the edge of the captured ground, in the air"
"""Description of the end of a run that the picture shows in the air, although the simulated ground has no edge."""
_GROUND_DISTANCE = 0.05
"""Maximum distance from the ground, in body heights, of nodes that stand on it and of Gaussians that belong to it."""
_COVER_DISTANCE = 0.03
"""Horizontal distance from a ground Gaussian, in body heights, within which a node is over ground; if it is larger,
twice the width of the Gaussian applies."""
_MIN_SHARE = 0.5
"""Minimum fraction of the standing nodes that must be over ground."""
_MAX_OVERHANG = 0.1
"""Maximum fraction of the standing nodes beyond the edge of the captured ground without a note."""
_TRIALS = 20
"""Number of fractions of a requested distance that are tried, to find the largest one that ends on captured ground."""
_MIN_OPACITY = 0.3
"""Minimum opacity of a ground Gaussian."""
_TOP = 0.998
"""Quantile of the heights of an object's Gaussians that is its height; the highest may be floaters."""
_MIN_FOOT = 8
"""Minimum number of Gaussians of a foot whose rim is examined."""
_DIRECTIONS = 72
"""Number of directions in which ground is looked for beside a foot."""
_RIM_OFFSETS = (0.05, 0.1, 0.15, 0.2)
"""Distances from the foot at which ground is looked for, relative to the height of the object or the width of its foot,
whichever is larger. Nearer to the foot, ground Gaussians may have been removed together with the object."""
_MAX_OPEN_SHARE = 0.15
"""Share of the directions without ground above which a note is given."""


def share_over_ground(
    nodes: np.ndarray, scene: GaussianCloud, ground: Surface, height: float, *, start: np.ndarray | None = None
) -> float:
    """Return the fraction of the standing nodes that are over captured ground; 1 if no node stands on the ground.

    Args:
        nodes: (n, 3) m, cage nodes in the frame of the body.
        scene: Background in the frame of the body.
        ground: Surface of the ground: the plane z = 0, or a ``HeightField``.
        height: Height of the body, m.
        start: (n, 3) m, nodes at the start, if the ground under the body counts as captured: the body hid it, and it
            may not have been filled.
    """

    def heights(points: np.ndarray) -> np.ndarray:
        return _heights(points, ground)

    standing = nodes[heights(nodes) < _GROUND_DISTANCE * height]
    means = scene.means.numpy().astype(np.float64)
    floor = np.flatnonzero((np.abs(heights(means)) < _GROUND_DISTANCE * height) & scene.visible(_MIN_OPACITY))
    if len(standing) == 0:
        return 1.0
    is_over = np.zeros(len(standing), bool)
    if len(floor) > 0:
        widths = scene.breadths(floor)
        distances, nearest = KDTree(means[floor, :2]).query(standing[:, :2])
        is_over |= distances < np.maximum(2.0 * widths[nearest], _COVER_DISTANCE * height)
    before = np.zeros((0, 3)) if start is None else start[heights(start) < _GROUND_DISTANCE * height]
    if len(before) > 0:
        hidden = SupportPolygon.hull(before[:, :2])
        is_over |= np.array([hidden.margin(node) >= -_COVER_DISTANCE * height for node in standing[:, :2]])
    return float(is_over.mean())


def _heights(points: np.ndarray, ground: Surface) -> np.ndarray:
    """Return the heights (n,) of ``points`` (n, 3) above the ground, m."""
    return ground.heights(points) if isinstance(ground, HeightField) else points[:, 2]


def ground_coverage_warning(
    nodes: np.ndarray, scene: GaussianCloud | None, ground: Surface, height: float, *, start: np.ndarray | None = None
) -> tuple[str, ...]:
    """Return a warning if a body whose final ``nodes`` are given is not over captured ground.

    The arguments are those of ``share_over_ground``; ``scene`` is None without a background.
    """
    if scene is None or share_over_ground(nodes, scene, ground, height, start=start) >= _MIN_SHARE:
        return ()
    return (Problem(f"{ENDS_OUTSIDE_GROUND}; choose a shorter distance or another direction"),)


def overhang_note(
    nodes: np.ndarray, scene: GaussianCloud | None, ground: Surface, height: float, *, start: np.ndarray | None = None
) -> tuple[str, ...]:
    """Return a note if a body whose final ``nodes`` are given stands partly beyond the edge of captured ground; if it
    does so mostly, ``ground_coverage_warning`` says so.

    The arguments are those of ``ground_coverage_warning``.
    """
    if scene is None:
        return ()
    over = share_over_ground(nodes, scene, ground, height, start=start)
    if over < _MIN_SHARE or over >= 1.0 - _MAX_OVERHANG:
        return ()
    return (
        Problem(
            f"at the end, {100.0 * (1.0 - over):.0f} % of its soles are beyond the edge of the captured ground; choose"
            " a shorter distance or another direction to keep them on it"
        ),
    )


def planned_end_note(
    legs: Sequence[Leg], stance: Stance, scene: GaussianCloud | None, ground: Surface
) -> tuple[str, ...]:
    """Return a warning about the first of the requested displacements that would end beyond the edge of the captured
    ground, wholly or partly, with the largest distance that keeps at least nine tenths of the soles on it.

    Args:
        legs: Displacements that the script requests (``planned_legs``).
        stance: Stance of the body at the start.
        scene: Background in the frame of the body; None without a background.
        ground: Surface of the ground.
    """
    height = stance.body.height

    def share(leg: Leg, fraction: float) -> float:
        offset = height * (leg.start + fraction * leg.step)
        turn = stance.ground.rotation_about_up(leg.heading)
        origin = stance.ground.origin
        moved = origin + (stance.standing - origin) @ turn.T + offset @ stance.ground.axes[:2]
        # The body follows the ground, which is higher or lower there.
        rise = _heights(stance.standing, ground) - _heights(moved, ground)
        moved = moved + rise[:, None] * (ground.normal if isinstance(ground, HeightField) else [0.0, 0.0, 1.0])
        assert scene is not None
        return share_over_ground(moved, scene, ground, height, start=stance.standing)

    for leg in legs if scene is not None else ():
        over = share(leg, 1.0)
        if over >= 1.0 - _MAX_OVERHANG:
            continue
        fractions = np.arange(1, _TRIALS) / _TRIALS
        beyond = np.flatnonzero([share(leg, fraction) < 1.0 - _MAX_OVERHANG for fraction in fractions])
        largest = (int(beyond[0]) if len(beyond) else _TRIALS - 1) / _TRIALS
        asked = float(np.linalg.norm(leg.step))
        fitting = np.floor(100.0 * largest * asked) / 100.0
        room = (
            f"at most {fitting:.2f} of the requested {asked:.3g} body heights fit in this direction; choose"
            " that distance or another direction"
            if fitting > 0.0
            else "no distance fits in this direction; choose another direction, or a motion in place"
        )
        end = "beyond the edge of the captured ground, in the air"
        if over >= _MIN_SHARE:
            end = f"with {100.0 * (1.0 - over):.0f} % of the soles beyond the edge of the captured ground"
        return (Problem(f"'{leg.name}' would end {end}: {room}"),)
    return ()


def ground_edge_note(
    means: np.ndarray, scene: GaussianCloud, plane: Plane, ground: HeightField | None = None
) -> tuple[str, ...]:
    """Return a note if no ground was captured beside a part of the foot of an object, which then hangs over an edge of
    the ground or stands at one; the simulated ground has no edge.

    Args:
        means: (n, 3) Means of the object's Gaussians.
        scene: Gaussians of the rest of the capture.
        plane: Plane under the object.
        ground: Ground that is not flat; None for the plane.
    """
    tangents = np.stack(plane.tangents())
    surface = plane if ground is None else ground
    heights = plane.heights(means)
    height = float(np.quantile(heights, _TOP))
    foot = means[surface.heights(means) < _GROUND_DISTANCE * height] @ tangents.T
    if len(foot) < _MIN_FOOT:
        return ()
    size = max(height, float(np.ptp(foot, axis=0).max()))
    others = scene.means.numpy().astype(np.float64)
    near = np.abs(surface.heights(others)) < _GROUND_DISTANCE * size
    floor = np.flatnonzero(near & scene.visible(_MIN_OPACITY))
    if len(floor) == 0:
        return ()
    angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    outward = np.column_stack([np.cos(angles), np.sin(angles)])
    rim = foot[np.argmax(foot @ outward.T, axis=0)]
    tree, widths = KDTree(others[floor] @ tangents.T), scene.breadths(floor)
    is_covered = np.zeros(_DIRECTIONS, bool)
    for offset in _RIM_OFFSETS:
        distances, nearest = tree.query(rim + offset * size * outward)
        is_covered |= distances < np.maximum(2.0 * widths[nearest], 2.0 * _COVER_DISTANCE * size)
    open_share = float(1.0 - is_covered.mean())
    if open_share <= _MAX_OPEN_SHARE:
        return ()
    return (
        Problem(
            f"beside {100.0 * open_share:.0f} % of the object's foot, no ground was captured at its level: the object"
            " hangs over an edge or stands at one; the simulated ground continues there"
        ),
    )
