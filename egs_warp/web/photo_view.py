"""Views of the page of ``egs-warp pick`` from the positions of photos, which show the capture as it was trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.pick import looked_at
from egs_warp.segmentation.framing import is_in_frame
from egs_warp.segmentation.votes import MaskedView, blending_votes

_FILL = 0.6
"""Fraction of the picture's shorter side that the object fills."""
_OUTLIERS = 0.005
"""Fraction of the object's Gaussians that are excluded at either end of each axis of the picture."""
_CUT_OFF = 0.02
"""Fraction of the object by which a photo may show less of it than the photo whose frame contains most of it."""
_TESTED = 6
"""Number of the nearest photos that are rendered to compare how much they show of the object."""
_SIDE = 160
"""Longer side of the rendered pictures, pixels."""
_MAX_FOV, _MIN_FOV = 75.0, 2.0
"""Limits of the field of view, degrees."""


def view_of_object(cloud: GaussianCloud, mask: np.ndarray, cameras: Sequence[Camera]) -> dict[str, Any] | None:
    """Return a camera (entry ``camera`` of a header, with ``distance``) at the position of the photo that shows most of
    the object ``mask`` (n,) bool of ``cloud``, turned to the object and zoomed to it; None if no photo shows it.

    Compared are the nearest photos among those whose frames contain the object: the photo that is selected shows the
    largest unhidden solid angle of it. ``cameras`` are those of the photos, in the frame of ``cloud``.
    """
    points = cloud.means.numpy()[mask].astype(np.float64)
    if not len(points):
        return None
    shares = np.array([is_in_frame(points, camera).mean() for camera in cameras])
    if not len(shares) or shares.max() == 0.0:
        return None
    middle = np.median(points, axis=0)
    least = shares.max() - _CUT_OFF
    framed = [camera for camera, share in zip(cameras, shares, strict=True) if share >= least]
    framed.sort(key=lambda camera: float(np.linalg.norm(camera.centre - middle)))
    eye = max(framed[:_TESTED], key=lambda camera: _visible_solid_angle(cloud, mask, camera)).centre
    ahead = middle - eye
    # Centre the object in the picture.
    low, high, axes = _extent(points, eye, ahead)
    ahead = ahead / np.linalg.norm(ahead) + 0.5 * (low + high) @ axes
    low, high, _ = _extent(points, eye, ahead)
    half = float(np.max(high - low)) / 2.0 / _FILL
    fov = float(np.clip(2.0 * np.degrees(np.arctan(half)), _MIN_FOV, _MAX_FOV))
    return _facts(eye, ahead, fov, float(np.linalg.norm(middle - eye)))


def view_of_photo(cameras: Sequence[Camera]) -> dict[str, Any] | None:
    """Return a camera, as ``view_of_object`` does, at the position of the photo nearest to the point at which all
    ``cameras`` look, turned to this point; None if they look at no common point."""
    middle = looked_at(cameras)
    if middle is None:
        return None
    camera = min(cameras, key=lambda one: float(np.linalg.norm(one.centre - middle)))
    ahead = middle - camera.centre
    half = min(camera.width / camera.fx, camera.height / camera.fy) / 2.0
    return _facts(camera.centre, ahead, float(2.0 * np.degrees(np.arctan(half))), float(np.linalg.norm(ahead)))


def _facts(eye: np.ndarray, ahead: np.ndarray, fov: float, distance: float) -> dict[str, Any]:
    forward = ahead / np.linalg.norm(ahead)
    return {"position": eye.tolist(), "forward": forward.tolist(), "fov": fov, "distance": distance}


def _visible_solid_angle(cloud: GaussianCloud, mask: np.ndarray, camera: Camera) -> float:
    """Return the solid angle, steradians for a small object in the middle of the picture, in which ``camera`` sees the
    object."""
    small = downscale(camera, _SIDE)
    votes = blending_votes(cloud, [MaskedView(small, np.ones((small.height, small.width), bool))])
    return float(votes.inside[mask].sum()) / (small.fx * small.fy)


def _extent(points: np.ndarray, eye: np.ndarray, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lower and the upper limit (2,) of the tangents of the angles at which an upright picture from ``eye``
    along ``ahead`` shows ``points`` (n, 3), without outliers, and the unit vectors (2, 3) of the picture to the right
    and upwards."""
    forward = ahead / np.linalg.norm(ahead)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    up = np.cross(right, forward)
    offsets = points - eye
    axes = np.stack([right, up])
    slopes = offsets @ axes.T / np.maximum(offsets @ forward, 1e-9)[:, None]
    low, high = np.quantile(slopes, [_OUTLIERS, 1.0 - _OUTLIERS], axis=0)
    return low, high, axes
