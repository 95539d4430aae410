"""Lens distortion models of camera calibration, and the undistortion of photos.

Models: https://colmap.github.io/cameras.html; polynomials as in OpenCV's ``calib3d``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from egs_warp.geometry.camera import Camera

_RADII = 512
"""Number of samples along a radius on which the polynomial is checked to increase."""


@dataclass(frozen=True)
class Lens:
    """Map from points (x, y) of a pinhole's plane z = 1 to their distorted position. The defaults are a pinhole."""

    fisheye: bool = False
    """True if the distortion polynomials take the angle from the optical axis, not its tangent."""
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Coefficients k1 to k4 of r^2, r^4, r^6, r^8."""
    rational: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Coefficients of r^2, r^4, r^6 in the denominator (OpenCV's k4 to k6)."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """Coefficients p1, p2."""
    thin_prism: tuple[float, float] = (0.0, 0.0)
    """Coefficients of r^2 along x and y."""
    field_of_view: float = 0.0
    """Angle in rad of the FOV model of Devernay and Faugeras, used if above 0."""

    @classmethod
    def named(cls, model: str, numbers: Mapping[str, float]) -> Lens | None:
        """Create the lens of COLMAP's ``model`` from its distortion parameters by name; None if it has no
        distortion."""
        fisheye = "FISHEYE" in model

        def of(*names: str) -> tuple:
            return tuple(float(numbers.get(name, 0.0)) for name in names)

        lens = cls(
            fisheye=fisheye,
            radial=(*of("k1", "k2", "k3"), 0.0) if model == "FULL_OPENCV" else of("k1", "k2", "k3", "k4"),
            rational=of("k4", "k5", "k6") if model == "FULL_OPENCV" else (0.0, 0.0, 0.0),
            tangential=of("p1", "p2"),
            thin_prism=of("sx1", "sy1"),
            field_of_view=float(numbers.get("omega", 0.0)),
        )
        return lens if lens.is_distorted else None

    @property
    def is_distorted(self) -> bool:
        """True if a photo differs from a pinhole's."""
        numbers = (*self.radial, *self.rational, *self.tangential, *self.thin_prism, self.field_of_view)
        return self.fisheye or any(number != 0 for number in numbers)

    def distorted(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) distorted positions of ``points`` (..., 2) on the plane z = 1."""
        points = np.asarray(points, dtype=float)
        if self.field_of_view > 0:
            radius = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
            return points / radius * np.arctan(2 * radius * np.tan(self.field_of_view / 2)) / self.field_of_view
        if self.fisheye:
            radius = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
            points = points / radius * np.arctan(radius)
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        k1, k2, k3, k4 = self.radial
        k5, k6, k7 = self.rational
        p1, p2 = self.tangential
        s1, s2 = self.thin_prism
        gain = (1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))) / (1 + r2 * (k5 + r2 * (k6 + r2 * k7)))
        return np.stack(
            [
                x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2,
                y * gain + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + s2 * r2,
            ],
            axis=-1,
        )

    def valid_radius(self, limit: float) -> float:
        """Return the radius on the plane z = 1, at most ``limit``, up to which the polynomial increases. Beyond it, the
        image folds back."""
        radii = np.linspace(0.0, limit, _RADII + 1)
        along = self.distorted(np.stack([radii, np.zeros_like(radii)], axis=-1))[:, 0]
        falls = np.flatnonzero(np.diff(along) <= 0)
        return float(radii[falls[0]]) if len(falls) else limit


@dataclass(frozen=True)
class Undistortion:
    """Map from a photo to the pinhole photo of the same size and intrinsics."""

    source: np.ndarray
    """(H, W, 2) float32, column and row in the photo, pixel centres at +0.5."""
    known: np.ndarray
    """(H, W) bool, True where the photo shows the pixel."""

    @classmethod
    def of(cls, camera: Camera, lens: Lens) -> Undistortion:
        """Create the map for photos of ``camera``'s size and intrinsics taken through ``lens``."""
        return _undistortion(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, lens)

    def picture(self, pixels: np.ndarray) -> np.ndarray:
        """Undistort the ``pixels`` (H, W) or (H, W, 3) of a photo, in their type; zero where the photo shows
        nothing."""
        return self._remap(pixels, cv2.INTER_LINEAR)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Undistort the ``mask`` (H, W) bool of a photo."""
        return self._remap(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0

    def _remap(self, pixels: np.ndarray, interpolation: int) -> np.ndarray:
        # OpenCV counts from the centre of the first pixel.
        position = self.source - np.float32(0.5)
        return cv2.remap(
            pixels, position[..., 0], position[..., 1], interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )

    def pixel(self, u: float, v: float) -> tuple[float, float]:
        """Return the undistorted position of the photo's pixel (u, v): the centre of the nearest pixel."""
        off = np.abs(self.source - np.array([u, v], np.float32)).sum(axis=-1)
        row, column = divmod(int(np.argmin(off)), off.shape[1])
        return column + 0.5, row + 0.5


@lru_cache(maxsize=2)
def _undistortion(width: int, height: int, fx: float, fy: float, cx: float, cy: float, lens: Lens) -> Undistortion:
    # Most photos of a set share their camera.
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy], axis=-1)
    radius = np.linalg.norm(rays, axis=-1)
    distorted = lens.distorted(rays) * [fx, fy] + [cx, cy]
    inside = ((distorted > 0.5) & (distorted < [width - 0.5, height - 0.5])).all(axis=-1)
    known = inside & (radius < lens.valid_radius(1.01 * float(radius.max())))
    return Undistortion(np.where(known[..., None], distorted, -1e4).astype(np.float32), known)
