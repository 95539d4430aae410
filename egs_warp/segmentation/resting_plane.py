"""The plane under an object whose ground no view tells: a body at rest lies as low as it can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.connectivity import close_to
from egs_warp.segmentation.object_spec import Segmentation

_FINE, _VISIBLE = 0.03, 0.05
"""Of the object's size, across, and of opacity: a thing has texture, and Gaussians as small; haze about it has none.
Those of a mouse's plain heel are up to 0.03 across, those of the desk's haze from 0.045 on."""
_REACH = 0.05
"""Of the object's size: so far beyond its outline it may be wider than what is known of it."""
_BELOW = 0.25
"""Of the object's size: so far below the plane that is known to be wrong it may reach."""
_STRAYS = 0.005
"""Share of the Gaussians that may lie below: mirror images in a glossy table, and strays."""
_FRINGE, _FOOT, _HAZE = 0.1, 0.05, 0.1
"""Of the object's size: what is so near to it, no higher above its plane, and no wider is a shred of it."""
_POINTS = 4000
"""That are looked at; of more, only so many, evenly."""
_ROUNDS, _ACROSS = 4, 15
"""Of ever narrower searches, and directions tried across each."""


def resting_plane(
    cloud: GaussianCloud, thing: np.ndarray, plane: Plane, up: np.ndarray, *, degrees: float, size: float
) -> Plane:
    """The plane on which the object rests, within ``degrees`` of ``up`` (3,), by its own lowest parts.

    ``thing`` (n,) bool is what is known of it, of ``size`` (scene units), over a ``plane`` that may cut through it. Of
    all planes that carry it, this is the one over which its middle lies lowest: its potential energy is least (a body
    that stands on a facet of its hull). Only fine Gaussians count; haze on which nothing can be matched has none.

    Raises ``UserError`` where there are too few of them.
    """
    fine = (cloud.breadths() < _FINE * size) & (cloud.opacities() > _VISIBLE)
    means = cloud.means.numpy().astype(np.float64)
    flat = means @ np.stack(plane.tangents(), axis=1)
    fine &= plane.heights(means) > -_BELOW * size
    fine &= close_to(flat, flat[fine & thing], _REACH * size)
    points = means[fine]
    if len(points) < 1.0 / _STRAYS:
        raise UserError(f"plane: the object has only {len(points)} fine Gaussians, which tell no plane; give the plane")
    points = points[:: -(-len(points) // _POINTS)]
    middle = points.mean(axis=0)
    return _lowest(points - middle, up / np.linalg.norm(up), np.tan(np.radians(degrees))).moved(middle)


def remove_foot_remnants(cloud: GaussianCloud, plane: Plane, found: Segmentation) -> Segmentation:
    """``found``, and with what is buried the shreds of the object's foot, of its shadow and its mirror image that lie
    about it below the ``plane`` or hardly above: no floor is there that they could be part of."""
    means = cloud.means.numpy()
    low = found.background_mask & (plane.heights(means) < _FOOT * found.size)
    low &= cloud.breadths() < _HAZE * found.size
    low[low] = close_to(means[low], means[found.object_mask], _FRINGE * found.size)
    return replace(found, buried_mask=found.buried_mask | low)


def _lowest(points: np.ndarray, up: np.ndarray, reach: float) -> Plane:
    """That over which the origin lies lowest; the tangent of its angle with ``up`` is at most ``reach``."""
    axes = np.stack(Plane(up, 0.0).tangents())
    best, step = np.zeros(2), reach / (_ACROSS // 2)
    for _ in range(_ROUNDS):
        tried = best + step * (np.indices((_ACROSS, _ACROSS)).reshape(2, -1).T - _ACROSS // 2)
        tried = tried[np.hypot(*tried.T) <= reach * (1.0 + 1e-9)]
        normals = up + tried @ axes
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        lows = np.quantile(points @ normals.T, _STRAYS, axis=0)
        chosen = int(np.argmax(lows))
        best, step = tried[chosen], step / (_ACROSS // 4)
    return Plane(normals[chosen], -float(lows[chosen]))
