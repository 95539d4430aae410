"""Lenses that bend straight lines, as camera calibration describes them, and photos straightened from them.

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
"""Samples along a radius on which the polynomial is checked to grow."""


@dataclass(frozen=True)
class Lens:
    """Where a lens puts what a pinhole would see at (x, y) on the plane z = 1; the defaults bend nothing."""

    fisheye: bool = False
    """Polynomials are in the angle from the optical axis, not in its tangent."""
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1 to k4, of r^2, r^4, r^6, r^8."""
    rational: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of r^2, r^4, r^6 in the denominator (OpenCV's k4 to k6)."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1, p2."""
    thin_prism: tuple[float, float] = (0.0, 0.0)
    """Of r^2 along x and y."""
    field_of_view: float = 0.0
    """Radians; the FOV model of Devernay and Faugeras where above 0."""

    @classmethod
    def named(cls, model: str, numbers: Mapping[str, float]) -> Lens | None:
        """The lens of COLMAP's ``model`` with its distortion parameters by name; None where it bends nothing."""
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
        """Whether a photo differs from a pinhole's."""
        numbers = (*self.radial, *self.rational, *self.tangential, *self.thin_prism, self.field_of_view)
        return self.fisheye or any(number != 0 for number in numbers)

    def distorted(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) where the lens puts the ``points`` (..., 2) of the plane z = 1."""
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
        """Radius on the plane z = 1, at most ``limit``, up to which the polynomial grows: beyond, it folds back."""
        radii = np.linspace(0.0, limit, _RADII + 1)
        along = self.distorted(np.stack([radii, np.zeros_like(radii)], axis=-1))[:, 0]
        falls = np.flatnonzero(np.diff(along) <= 0)
        return float(radii[falls[0]]) if len(falls) else limit


@dataclass(frozen=True)
class Undistortion:
    """The way from a photo to the pinhole photo of the same size and intrinsics."""

    source: np.ndarray
    """(H, W, 2) float32: column and row in the photo, pixel centres at +0.5."""
    known: np.ndarray
    """(H, W) bool: the photo has it."""

    @classmethod
    def of(cls, camera: Camera, lens: Lens) -> Undistortion:
        """For photos of ``camera``'s size and intrinsics taken through ``lens``."""
        return _straightening(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, lens)

    def picture(self, pixels: np.ndarray) -> np.ndarray:
        """The ``pixels`` (H, W) or (H, W, 3) of a photo straightened, in their type; zero where nothing is known."""
        return self._moved(pixels, cv2.INTER_LINEAR)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """(H, W) bool of the photo's ``mask`` (H, W) bool."""
        return self._moved(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0

    def _moved(self, pixels: np.ndarray, how: int) -> np.ndarray:
        # OpenCV counts from the first pixel's centre.
        where = self.source - np.float32(0.5)
        return cv2.remap(pixels, where[..., 0], where[..., 1], how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    def pixel(self, u: float, v: float) -> tuple[float, float]:
        """Where the straightened photo shows what the photo shows at (u, v): the nearest pixel's centre."""
        off = np.abs(self.source - np.array([u, v], np.float32)).sum(axis=-1)
        row, column = divmod(int(np.argmin(off)), off.shape[1])
        return column + 0.5, row + 0.5


@lru_cache(maxsize=2)
def _straightening(width: int, height: int, fx: float, fy: float, cx: float, cy: float, lens: Lens) -> Undistortion:
    # Most photos of a set share their camera.
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy], axis=-1)
    radius = np.linalg.norm(rays, axis=-1)
    bent = lens.distorted(rays) * [fx, fy] + [cx, cy]
    inside = ((bent > 0.5) & (bent < [width - 0.5, height - 0.5])).all(axis=-1)
    known = inside & (radius < lens.valid_radius(1.01 * float(radius.max())))
    return Undistortion(np.where(known[..., None], bent, -1e4).astype(np.float32), known)
