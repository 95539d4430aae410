"""Detection of background from the framing of photos: photographers keep the object in the picture, so Gaussians that
are in few pictures do not belong to the object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.geometry.camera import Camera

MIN_PHOTOS, _MAX_PHOTOS = 8, 32
"""Number of photos below which framing gives no information, and number of photos above which they are sampled
evenly."""


def outside_frames(means: np.ndarray, point: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return, for each of the ``means`` (n, 3), the share (n,) of those photos showing ``point`` (3,) whose frames do
    not contain the mean; None if too few photos show ``point``."""
    showing = [camera for camera in cameras if is_in_frame(point[None], camera)[0]]
    if len(showing) < MIN_PHOTOS:
        return None
    showing = showing[:: -(-len(showing) // _MAX_PHOTOS)]
    inside = np.zeros(len(means))
    for camera in showing:
        inside += is_in_frame(means, camera)
    return 1.0 - inside / len(showing)


def is_in_frame(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mask (n,) bool of those ``points`` (n, 3) that are inside the camera's picture, even if something
    hides them."""
    across, down, depth = camera.rotation @ points.T + camera.translation[:, None]
    ahead = depth > camera.near
    depth = np.where(ahead, depth, 1.0)
    u, v = camera.cx + camera.fx * across / depth, camera.cy + camera.fy * down / depth
    return ahead & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)


def picture_radii(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (n,) of each of the ``points`` (n, 3) from the middle of the camera's picture, in units of
    half of the picture's shorter side (infinite behind the camera); and the length (n,) of this half side at the depth
    of the point, scene units."""
    across, down, depth = camera.rotation @ points.T + camera.translation[:, None]
    half = np.maximum(depth, 0.0) * min(camera.width / camera.fx, camera.height / camera.fy) / 2.0
    radii = np.where(depth > camera.near, np.hypot(across, down) / np.maximum(half, 1e-30), np.inf)
    return radii, half
