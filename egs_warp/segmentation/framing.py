"""Background found from the framing of photos: photographers keep the object in the picture, so Gaussians that few
photos contain do not belong to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.object_spec import ObjectSpec

_MIN_PHOTOS, _MAX_PHOTOS = 8, 32
"""Number of photos below which framing gives no information, and number above which photos are sampled evenly."""
_MIN_OUTSIDE = 0.9
"""Minimum share of the photos of the object whose frames do not contain a Gaussian for it to be background. For a bear
on a duvet, shares from 0.5 to 0.9 give the same object; a large share keeps objects that were photographed in parts."""
_HITS, _SOLID = 8, 0.3
"""Number of Gaussians next to a point that represent a click there, and their minimum opacity."""


def with_framing(cloud: GaussianCloud, spec: ObjectSpec, cameras: Sequence[Camera]) -> ObjectSpec:
    """Return ``spec`` with a click beside the object that hits all background known from the framing of the photos.

    The photos of the object are those whose frame contains its point. Nothing is added if there are few photos or no
    such background, or if ``spec`` has a box or masks, which are more precise.

    Args:
        cloud: the capture.
        spec: the user's description of the object.
        cameras: cameras of the photos.
    """
    if spec.point is None or spec.masks:
        return spec
    means = cloud.means.numpy().astype(np.float64)
    outside = outside_frames(means, spec.point, cameras)
    background = np.zeros(len(means), bool) if outside is None else outside >= _MIN_OUTSIDE
    if not background.any():
        return spec
    clicks = spec.clicks
    if not any(click.inside for click in clicks):
        solid = np.flatnonzero((cloud.opacities() > _SOLID) & ~background)
        if len(solid) == 0:
            return spec
        nearest = KDTree(means[solid]).query(spec.point, k=min(_HITS, len(solid)))[1]
        clicks = (Click(spec.point, solid[np.ravel(nearest)]), *clicks)
    wanted = np.concatenate([click.hits for click in clicks if click.inside])
    return replace(
        spec, clicks=(*clicks, Click(spec.point, np.setdiff1d(np.flatnonzero(background), wanted), inside=False))
    )


def outside_frames(means: np.ndarray, point: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return (n,), for each of the ``means`` (n, 3) the share of the photos of ``point`` (3,) whose frames do not
    contain it; None if too few photos show ``point``."""
    showing = [camera for camera in cameras if _in_frame(point[None], camera)[0]]
    if len(showing) < _MIN_PHOTOS:
        return None
    showing = showing[:: -(-len(showing) // _MAX_PHOTOS)]
    inside = np.zeros(len(means))
    for camera in showing:
        inside += _in_frame(means, camera)
    return 1.0 - inside / len(showing)


def _in_frame(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (n,) bool, True for ``points`` (n, 3) inside the camera's picture, even if something hides them."""
    across, down, depth = camera.rotation @ points.T + camera.translation[:, None]
    ahead = depth > camera.near
    depth = np.where(ahead, depth, 1.0)
    u, v = camera.cx + camera.fx * across / depth, camera.cy + camera.fy * down / depth
    return ahead & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
