"""Flat part of the surface of a capture around the place where another object stood."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.above_plane import MIN_OPACITY
from egs_warp.segmentation.connectivity import close_to, connected_parts, enclosed

_NEIGHBOUR = 4
"""Number, counted from 1, of the nearest neighbour whose median distance measures how sparse the surface is."""


def bounded_by_surface(cloud: GaussianCloud, plane: Plane, footprint: np.ndarray, band: float) -> np.ndarray:
    """Return the mask (n,) bool of the Gaussians that the flat surface around a footprint bounds from above.

    The surface consists of the connected parts of the opaque Gaussians at most ``band`` from the ``plane`` that reach
    the footprint, and of the holes in these parts. It bounds its own Gaussians and all those below. Another surface at
    the same height, such as a rim, is not part of it unless the two are connected.

    Args:
        cloud: the capture.
        plane: plane of the surface.
        footprint: (k, 3) points of the object that stood on the surface.
        band: maximum distance of a Gaussian of the surface from the plane, and minimum distance along the plane between
            separate parts; both in the units of the capture.
    """
    means = cloud.means.numpy().astype(np.float64)
    heights, tangents = plane.heights(means), np.stack(plane.tangents(), axis=1)
    flat = means @ tangents
    near = np.flatnonzero((np.abs(heights) < band) & cloud.visible(MIN_OPACITY))
    if len(near) <= _NEIGHBOUR:
        return np.zeros(len(means), bool)
    spacing = float(np.median(KDTree(flat[near]).query(flat[near], k=_NEIGHBOUR + 1)[0][:, _NEIGHBOUR]))
    reach = max(band, spacing)
    parts = connected_parts(cloud, near, cell=band, plane=plane, above=-np.inf)
    is_reached = close_to(flat[near], footprint @ tangents, reach)
    surface = flat[near[np.isin(parts, parts[is_reached])]]
    return (heights < band) & (close_to(flat, surface, reach) | enclosed(flat, surface, reach))
