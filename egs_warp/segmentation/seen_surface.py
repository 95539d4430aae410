"""Visible surfaces in a picture, computed from the heights of splats, because depth alone would place floors too high.

The depth of a splat is the depth of its mean. Where splats of a floor overlap, the nearer splat hides the others, so
the depth in a pixel is usually the depth of a mean that is nearer than the floor at that pixel. At this depth, the
pixel's ray is still above the floor, by a fraction of a splat's size. The height of the splat at which half of the
light is absorbed has no such bias: it is the same for all overlapping splats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.render.rasteriser import render_gaussians

_OPAQUE = 0.9


@dataclass(frozen=True)
class SeenSurface:
    """Surface at which half of the light is absorbed, for each pixel of a picture."""

    camera: Camera
    depth: np.ndarray
    """(H, W) float64, z-depth of the mean of the splat at the surface, scene units; 0 where there is none."""
    middles: np.ndarray
    """(H, W, 3) float64, mean of that splat, scene units; undefined where there is none."""
    opaque: np.ndarray
    """(H, W) bool, True where hardly any light passes through."""

    @classmethod
    def of(cls, cloud: GaussianCloud, camera: Camera) -> SeenSurface:
        """Compute the surface of ``cloud`` in the picture of ``camera``."""
        image = render_gaussians(cloud, camera, geometry=True)
        assert image.median_depth is not None and image.median_gaussian is not None
        # Use the median depth: some light passes through the floor, so the expected depth would be averaged with depths
        # below it.
        middles = cloud.means.numpy().astype(np.float64)[np.asarray(image.median_gaussian.numpy(), np.int64)]
        depth = image.median_depth.numpy().astype(np.float64)
        return cls(camera, depth, middles, (image.alpha.numpy() > _OPAQUE) & (depth > 0.0))

    def depth_over(self, plane: Plane) -> np.ndarray:
        """Return the z-depth (H, W) at which each pixel's ray reaches the height, over ``plane``, of the surface seen
        in the pixel; 0 where the ray does not reach this height.

        ``plane`` must only be roughly parallel to the surface: the error is its tilt times the width of a splat.
        """
        slope = camera_rays(self.camera) @ plane.normal
        fall = float(plane.heights(self.camera.centre)) - plane.heights(self.middles)
        down = (self.depth > 0.0) & (slope < 0.0) & (fall > 0.0)
        return np.where(down, fall / np.where(down, -slope, 1.0), 0.0)

    def points(self, plane: Plane, chosen: np.ndarray) -> np.ndarray:
        """Return the points (n, 3) of the ``chosen`` (H, W) bool pixels at the depths of ``depth_over``, where these
        depths are positive."""
        depth = self.depth_over(plane)
        valid = chosen & (depth > 0.0)
        return self.camera.centre + depth[valid][:, None] * camera_rays(self.camera)[valid]
