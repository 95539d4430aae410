"""Test whether a body ends its run on captured ground: the simulated ground is infinite, but a captured table has
edges."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.contact.terrain import Surface
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.motions.support import SupportPolygon

ENDS_OUTSIDE_GROUND = "it ends beyond the edge of the captured ground, in the air"
"""Description of the end of a run that the picture shows in the air, although the simulated ground has no edge."""
_GROUND_DISTANCE = 0.05
"""Maximum distance from the ground, in body heights, of nodes that stand on it and of Gaussians that belong to it."""
_COVER_DISTANCE = 0.03
"""Horizontal distance from a ground Gaussian, in body heights, within which a node is over ground; if it is larger,
twice the width of the Gaussian applies."""
_MIN_SHARE = 0.5
"""Minimum fraction of the standing nodes that must be over ground."""
_MIN_OPACITY = 0.3
"""Minimum opacity of a ground Gaussian."""


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
        return ground.heights(points) if isinstance(ground, HeightField) else points[:, 2]

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


def ground_coverage_warning(
    nodes: np.ndarray, scene: GaussianCloud | None, ground: Surface, height: float, *, start: np.ndarray | None = None
) -> tuple[str, ...]:
    """Return a warning if a body whose final ``nodes`` are given is not over captured ground.

    The arguments are those of ``share_over_ground``; ``scene`` is None without a background.
    """
    if scene is None or share_over_ground(nodes, scene, ground, height, start=start) >= _MIN_SHARE:
        return ()
    return (f"{ENDS_OUTSIDE_GROUND}; choose a shorter distance or another direction",)
