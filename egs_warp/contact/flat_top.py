"""Flat part of the surface of a body, on which another body stood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.geometry.plane import Plane
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class FlatTop:
    """Flat part of the surface of a body, facing up."""

    __repr__ = short_repr

    plane: Plane
    """Plane of the surface."""
    is_bounded: np.ndarray
    """(n,) bool, True for the Gaussians of the body that this surface bounds from above."""
    band: float
    """Distance from the plane, m, below which the points of these Gaussians are moved up onto it."""

    def flattened(self, points: np.ndarray, gaussians: np.ndarray) -> np.ndarray:
        """Return ``points`` (p, 3) m of the Gaussians with the indices ``gaussians`` (p,), moved onto the plane if they
        are above it or closely below it and the surface bounds their Gaussian."""
        heights = self.plane.heights(points)
        is_moved = self.is_bounded[gaussians] & (heights > -self.band)
        return points - np.where(is_moved, heights, 0.0)[:, None] * self.plane.normal
