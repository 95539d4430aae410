"""Where a picture shows a surface, by the heights of its splats: their depths alone put floors too high.

A splat's depth is that of its middle. Of a floor's neighbours the nearer one hides the other, so that a pixel's depth
is that of a place nearer than its own: along the ray this is above the floor, by a share of a splat. The height of the
splat that stops half of the light is not changed by which of them that is.
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
    """What stops half of the light in each pixel of a picture."""

    camera: Camera
    depth: np.ndarray
    """(H, W) float64 z-depth of its middle, scene units; 0 where nothing does."""
    middles: np.ndarray
    """(H, W, 3) float64 its middle; of no meaning where nothing does."""
    opaque: np.ndarray
    """(H, W) bool: hardly any light passes."""

    @classmethod
    def of(cls, cloud: GaussianCloud, camera: Camera) -> SeenSurface:
        """Of ``cloud`` through ``camera``."""
        image = render_gaussians(cloud, camera, geometry=True)
        assert image.median_depth is not None and image.median_gaussian is not None
        # Not the mean: of what a floor lets through of the depths below, that gets a share.
        middles = cloud.means.numpy().astype(np.float64)[np.asarray(image.median_gaussian.numpy(), np.int64)]
        depth = image.median_depth.numpy().astype(np.float64)
        return cls(camera, depth, middles, (image.alpha.numpy() > _OPAQUE) & (depth > 0.0))

    def depth_over(self, plane: Plane) -> np.ndarray:
        """(H, W) z-depth at which each pixel's ray comes down to the height over ``plane`` of what it shows; 0 where it
        shows nothing, or does not come down.

        ``plane`` need only be roughly along the surface: a tilt counts with the width of a splat.
        """
        slope = camera_rays(self.camera) @ plane.normal
        fall = float(plane.heights(self.camera.centre)) - plane.heights(self.middles)
        down = (self.depth > 0.0) & (slope < 0.0) & (fall > 0.0)
        return np.where(down, fall / np.where(down, -slope, 1.0), 0.0)

    def points(self, plane: Plane, chosen: np.ndarray) -> np.ndarray:
        """(n, 3) of the ``chosen`` (H, W) bool pixels, by ``depth_over``, those that come down."""
        depth = self.depth_over(plane)
        held = chosen & (depth > 0.0)
        return self.camera.centre + depth[held][:, None] * camera_rays(self.camera)[held]
