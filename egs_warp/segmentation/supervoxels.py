"""Supervoxels of a capture, and the gaps between neighbouring Gaussians."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.graph_cut import SplatGraph

_SIGMAS = 3.0
"""Half-length of a Gaussian in standard deviations."""
_COLOUR_SPLITS = 2
"""Number of final halvings that may also separate points by colour."""
_COLOUR_RANGE = 0.3
"""Range of a colour channel, 0 to 1, that counts as much as the longest side of a cluster when the cluster is
halved."""


def link_gaps(cloud: GaussianCloud, nodes: np.ndarray, links: SplatGraph) -> np.ndarray:
    """Return the length (m,) of the empty part of each link between the Gaussians with the indices ``nodes`` (k,),
    divided by the median length of all links; it is negative if the two Gaussians overlap."""
    points = cloud.means.numpy()[nodes].astype(np.float64)
    arms = points[links.second] - points[links.first]
    lengths = np.linalg.norm(arms, axis=1)
    along = arms / np.maximum(lengths, 1e-30)[:, None]
    quaternions = cloud.rotations.numpy()[nodes]
    scales = np.exp(cloud.log_scales.numpy()[nodes].astype(np.float64))
    extents = (
        np.linalg.norm(
            scales[ends] * Rotation.from_quat(quaternions[ends], scalar_first=True).apply(along, inverse=True), axis=1
        )
        for ends in (links.first, links.second)
    )
    # Links between Gaussians at the same position have zero length and are left out of the median.
    typical = float(np.median(lengths[links.length > 0.0])) if (links.length > 0.0).any() else 1.0
    return (lengths - _SIGMAS * sum(extents)) / max(typical, 1e-30)


def supervoxels(points: np.ndarray, colours: np.ndarray, levels: int) -> np.ndarray:
    """Group points into at most 2^``levels`` clusters by repeated halving along the longest side; the last halvings may
    also separate points by colour.

    Args:
        points: (n, 3) positions.
        colours: (n, 3) from 0 to 1.
        levels: number of halvings.

    Returns:
        (n,) int32, cluster of each point.
    """
    count = len(points)
    values = np.concatenate([points, colours], axis=1)
    order, owner = np.arange(count), np.zeros(count, np.int64)
    for level in range(levels):
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        ordered = values[order]
        extents = np.maximum.reduceat(ordered, starts) - np.minimum.reduceat(ordered, starts)
        longest = extents[:, :3].max(axis=1, keepdims=True)
        extents[:, :3] /= np.maximum(longest, 1e-30)
        extents[:, 3:] *= 1.0 / _COLOUR_RANGE if level >= levels - _COLOUR_SPLITS else 0.0
        sizes = np.diff(starts, append=count)
        axis = np.repeat(np.argmax(extents, axis=1), sizes)
        along = ordered[np.arange(count), axis]
        order = order[np.lexsort((along, owner))]
        place = np.arange(count) - np.repeat(starts, sizes)
        owner = 2 * owner + (place >= np.repeat((sizes + 1) // 2, sizes))
    result = np.empty(count, np.int32)
    result[order] = np.unique(owner, return_inverse=True)[1]
    return result
