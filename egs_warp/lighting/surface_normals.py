"""Smooth outward normals of an object's Gaussians."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import GaussianCloud

_SOLID = 0.3
"""Minimum opacity of a Gaussian that is part of the surface."""
_MAX_POINTS = 12_000
"""Maximum number of points at which normals are computed; the other Gaussians use the normal of the nearest point."""
_NEAR, _FAR = 40, 320
"""Number of neighbours that span a patch of the surface, and number of neighbours whose mean lies inside the object."""
_MIN_AGREEMENT = 0.6
"""Minimum length of the mean of neighbouring unit normals; the mean is shorter where there is no smooth surface, as in
fur or at a thin edge."""


def surface_normals(cloud: GaussianCloud) -> np.ndarray:
    """Return the outward unit normals (n, 3) float64 of the surface that the Gaussians form, zero where there is no
    surface.

    A normal is the direction in which the nearest opaque Gaussians have the least variance. The axes of single
    Gaussians are too noisy: in a capture, their shortest axes deviate from the surface's normal by tens of degrees.
    """
    means = cloud.means.numpy().astype(np.float64)
    chosen = np.flatnonzero(cloud.visible(_SOLID))
    chosen = chosen[:: -(-len(chosen) // _MAX_POINTS) or 1]
    if len(chosen) <= _NEAR:
        return np.zeros_like(means)
    points = means[chosen]
    tree = KDTree(points)
    near = np.asarray(tree.query(points, k=min(_FAR, len(points)))[1])
    piece = points[near[:, :_NEAR]]
    piece = piece - piece.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", piece, piece))[1][:, :, 0]
    outward = points - points[near].mean(axis=1)
    normals *= np.where(np.einsum("ni,ni->n", normals, outward) < 0.0, -1.0, 1.0)[:, None]
    # Averaging over the same neighbours corrects normals with the wrong sign.
    normals = normals[near[:, :_NEAR]].mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(lengths > _MIN_AGREEMENT, normals / np.maximum(lengths, _MIN_AGREEMENT), 0.0)
    return normals[tree.query(means)[1]]
