"""Whether a body ends on ground that was captured: the mechanics' ground has no edge, a table has."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.contact.terrain import Surface
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField

_NEAR = 0.05
"""Of the body's height: what is so near to the ground is of it, of body and scene."""
_REACH = 0.03
"""Of the body's height: what has a splat so near to it, or within its broad side, is over ground."""
_LEAST = 0.5
"""Of what stands: with less over ground it stands in the air."""
_SOLID = 0.3


def share_over_ground(nodes: np.ndarray, scene: GaussianCloud, ground: Surface, height: float) -> float:
    """Share, 0 to 1, of what stands of ``nodes`` (n, 3) under which the ``scene`` shows ground; 1 where nothing
    stands. All in the frame of the body, ``height`` tall, whose ground is z = 0, or ``ground`` if that is not flat.
    """

    def heights(points: np.ndarray) -> np.ndarray:
        return ground.heights(points) if isinstance(ground, HeightField) else points[:, 2]

    standing = nodes[heights(nodes) < _NEAR * height]
    means = scene.means.numpy().astype(np.float64)
    floor = np.flatnonzero((np.abs(heights(means)) < _NEAR * height) & (scene.opacities() > _SOLID))
    if len(standing) == 0:
        return 1.0
    if len(floor) == 0:
        return 0.0
    broad = scene.breadths(floor)
    away, nearest = KDTree(means[floor, :2]).query(standing[:, :2])
    return float((away < np.maximum(2.0 * broad[nearest], _REACH * height)).mean())


def ground_coverage_warning(
    nodes: np.ndarray, scene: GaussianCloud | None, ground: Surface, height: float
) -> tuple[str, ...]:
    """What there is to say of a body whose ``nodes`` end beyond what was captured of its ground."""
    if scene is None or share_over_ground(nodes, scene, ground, height) >= _LEAST:
        return ()
    return ("it ends beyond the edge of the captured ground, in the air; ask for less distance, or another way",)
