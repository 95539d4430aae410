"""Estimate of the plane under an object whose ground is not visible, from the fact that a body at rest minimises its
potential energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.connectivity import close_to
from egs_warp.segmentation.object_spec import Segmentation

_FINE, _VISIBLE = 0.03, 0.05
"""Maximum width, as a fraction of the object's size, and minimum opacity of fine Gaussians. An object has texture and
therefore fine Gaussians; the haze around it has none. The plain rear of a computer mouse has Gaussians up to 0.03 wide;
the haze over its desk has a width of 0.045 and more."""
_REACH = 0.05
"""Maximum extent of the object beyond its known outline, as a fraction of its size."""
_BELOW = 0.25
"""Maximum extent of the object below the given plane, which may be wrong, as a fraction of the object's size."""
_STRAYS = 0.005
"""Fraction of the Gaussians that may lie below the plane, such as strays and mirror images in a glossy table."""
_FRINGE, _FOOT, _HAZE = 0.1, 0.05, 0.1
"""Maximum distance from the object, maximum height above its plane, and maximum width of the remnants at the object's
foot, as fractions of the object's size."""
_POINTS = 4000
"""Maximum number of points that are used; larger sets are sampled evenly."""
_ROUNDS, _GRID_SIZE = 4, 15
"""Number of successively narrower searches, and number of directions that are tried along each axis."""


def resting_plane(
    cloud: GaussianCloud, object_mask: np.ndarray, plane: Plane, up: np.ndarray, *, degrees: float, size: float
) -> Plane:
    """Return the plane on which the object rests, within ``degrees`` of ``up`` (3,), from its own lowest parts.

    Of all planes below the object, this is the one closest to the object's centre: on it, the potential energy is
    minimal (a body stands on a facet of its hull). Only fine Gaussians are used, because haze has none.

    Args:
        cloud: the capture.
        object_mask: (n,) bool, the known part of the object.
        plane: a plane that may cut through the object.
        up: (3,) up direction.
        degrees: maximum angle to ``up``.
        size: size of the object, scene units.

    Raises:
        UserError: there are too few fine Gaussians.
    """
    fine = (cloud.breadths() < _FINE * size) & cloud.visible(_VISIBLE)
    means = cloud.means.numpy().astype(np.float64)
    flat = means @ np.stack(plane.tangents(), axis=1)
    fine &= plane.heights(means) > -_BELOW * size
    fine &= close_to(flat, flat[fine & object_mask], _REACH * size)
    points = means[fine]
    if len(points) < 1.0 / _STRAYS:
        raise UserError(
            f"plane: the object has only {len(points)} fine Gaussians, too few to find a plane; give the plane"
        )
    points = points[:: -(-len(points) // _POINTS)]
    middle = points.mean(axis=0)
    return _lowest(points - middle, up / np.linalg.norm(up), np.tan(np.radians(degrees))).moved(middle)


def remove_foot_remnants(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> Segmentation:
    """Return the segmentation with remnants of the object's foot, shadow and mirror image added to the buried
    Gaussians.

    These remnants lie near the object, below the ``plane`` or slightly above it, where there is no visible floor to
    which they could belong.
    """
    means = cloud.means.numpy()
    low = segmentation.background_mask & (plane.heights(means) < _FOOT * segmentation.size)
    low &= cloud.breadths() < _HAZE * segmentation.size
    low[low] = close_to(means[low], means[segmentation.object_mask], _FRINGE * segmentation.size)
    return replace(segmentation, buried_mask=segmentation.buried_mask | low)


def _lowest(points: np.ndarray, up: np.ndarray, reach: float) -> Plane:
    """Return the plane below the ``points`` (n, 3) over which the origin is highest. The tangent of the angle between
    its normal and ``up`` (3,) is at most ``reach``."""
    axes = np.stack(Plane(up, 0.0).tangents())
    best, step = np.zeros(2), reach / (_GRID_SIZE // 2)
    for _ in range(_ROUNDS):
        tilts = best + step * (np.indices((_GRID_SIZE, _GRID_SIZE)).reshape(2, -1).T - _GRID_SIZE // 2)
        tilts = tilts[np.hypot(*tilts.T) <= reach * (1.0 + 1e-9)]
        normals = up + tilts @ axes
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        lows = np.quantile(points @ normals.T, _STRAYS, axis=0)
        chosen = int(np.argmax(lows))
        best, step = tilts[chosen], step / (_GRID_SIZE // 4)
    return Plane(normals[chosen], -float(lows[chosen]))
