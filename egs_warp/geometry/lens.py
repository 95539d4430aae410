"""Lens distortion models of calibrated cameras, and the undistortion of photos.

Models: https://colmap.github.io/cameras.html; polynomials as in OpenCV's ``calib3d``; FOV from Devernay and Faugeras
(2001), division from Fitzgibbon (2001), EUCM from Khomutenko, Garcia and Martinet (2016), and the fisheye with radial,
tangential and thin prism terms from Project Aria (Fisheye624).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from egs_warp.geometry.camera import Camera

_RADII = 512
"""Number of samples along a radius on which the polynomial is checked to increase."""


@dataclass(frozen=True)
class Lens:
    """Map from points (x, y) on the plane z = 1 of a pinhole camera to their distorted positions. The default is the
    identity."""

    fisheye: bool = False
    """True if the argument of the distortion polynomials is the angle from the optical axis, not its tangent."""
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Coefficients k1 to k4 of r^2, r^4, r^6, r^8."""
    rational: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Coefficients of r^2, r^4, r^6 in the denominator (OpenCV's k4 to k6)."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """Coefficients p1 and p2 of the tangential distortion."""
    thin_prism: tuple[float, float] = (0.0, 0.0)
    """Coefficients of r^2 of the thin prism terms along x and y."""
    field_of_view: float = 0.0
    """Angle in rad of the FOV model, used if above 0."""
    division: float = 0.0
    """Coefficient k of the division model: the undistorted position is the distorted one divided by 1 + k r^2, where r
    is the distorted radius."""
    unified: tuple[float, float] = (0.0, 1.0)
    """Parameters alpha and beta of the enhanced unified camera model (EUCM)."""
    high_radial: tuple[float, float] = (0.0, 0.0)
    """Coefficients of r^10 and r^12 of the radial polynomial."""
    high_thin_prism: tuple[float, float] = (0.0, 0.0)
    """Coefficients of r^4 of the thin prism terms along x and y."""
    is_chained: bool = False
    """True if tangential and thin prism terms apply to the radially distorted position, as in Fisheye624."""

    @classmethod
    def named(cls, model: str, numbers: Mapping[str, float]) -> Lens | None:
        """Create the lens of COLMAP's ``model`` from its distortion parameters by name; None if it has no distortion.

        Raises ``ValueError`` for parameters outside the range of the model.
        """
        fisheye = "FISHEYE" in model

        def of(*names: str) -> tuple:
            return tuple(float(numbers.get(name, 0.0)) for name in names)

        if model == "RAD_TAN_THIN_PRISM_FISHEYE":
            # Fisheye624 names the tangential coefficients in the order opposite to OpenCV's.
            return cls(
                fisheye=True,
                radial=of("k1", "k2", "k3", "k4"),
                high_radial=of("k5", "k6"),
                tangential=of("p2", "p1"),
                thin_prism=of("s1", "s3"),
                high_thin_prism=of("s2", "s4"),
                is_chained=True,
            )
        if model == "EUCM":
            alpha, beta = float(numbers.get("alpha", 0.0)), float(numbers.get("beta", 1.0))
            if not (0.0 <= alpha <= 1.0 and beta > 0.0):
                raise ValueError(f"alpha {alpha:g} is not from 0 to 1, or beta {beta:g} is not positive")
            return cls(unified=(alpha, beta)) if alpha > 0.0 else None
        lens = cls(
            fisheye=fisheye,
            radial=(*of("k1", "k2", "k3"), 0.0) if model == "FULL_OPENCV" else of("k1", "k2", "k3", "k4"),
            rational=of("k4", "k5", "k6") if model == "FULL_OPENCV" else (0.0, 0.0, 0.0),
            tangential=of("p1", "p2"),
            thin_prism=of("sx1", "sy1"),
            # The model is an even function of omega.
            field_of_view=abs(float(numbers.get("omega", 0.0))),
            division=float(numbers.get("k", 0.0)),
        )
        return lens if lens.is_distorted else None

    @property
    def is_distorted(self) -> bool:
        """True if the map differs from the identity, which represents a pinhole camera."""
        return replace(self, unified=(self.unified[0], 1.0)) != Lens()

    def distorted(self, points: np.ndarray) -> np.ndarray:
        """Return the distorted positions (..., 2) of ``points`` (..., 2) on the plane z = 1."""
        points = np.asarray(points, dtype=float)
        if self.field_of_view > 0:
            radius = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
            return points / radius * np.arctan(2 * radius * np.tan(self.field_of_view / 2)) / self.field_of_view
        if self.division != 0.0:
            # Use the smaller root of k r r_d^2 - r_d + r = 0. Beyond the last radius with a root, the image folds back.
            root = 1.0 - 4.0 * self.division * (points**2).sum(axis=-1, keepdims=True)
            return np.where(root >= 0.0, 2.0 * points / (1.0 + np.sqrt(np.maximum(root, 0.0))), 0.0)
        alpha, beta = self.unified
        if alpha > 0.0:
            distance = np.sqrt(beta * (points**2).sum(axis=-1, keepdims=True) + 1.0)
            return points / (alpha * distance + 1.0 - alpha)
        if self.fisheye:
            radius = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
            points = points / radius * np.arctan(radius)
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        k1, k2, k3, k4 = self.radial
        k5, k6, k7 = self.rational
        p1, p2 = self.tangential
        s1, s2 = self.thin_prism
        k8, k9 = self.high_radial
        t1, t2 = self.high_thin_prism
        gain = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * (k8 + r2 * k9)))))
        gain = gain / (1 + r2 * (k5 + r2 * (k6 + r2 * k7)))
        radial_x, radial_y = x * gain, y * gain
        if self.is_chained:
            x, y = radial_x, radial_y
            r2 = x * x + y * y
        return np.stack(
            [
                radial_x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * t1),
                radial_y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + r2 * (s2 + r2 * t2),
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
    """(H, W) bool, True for pixels inside the view of the photo."""

    @classmethod
    def of(cls, camera: Camera, lens: Lens) -> Undistortion:
        """Create the map for photos of ``camera``'s size and intrinsics taken through ``lens``."""
        return _undistortion(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, lens)

    def picture(self, pixels: np.ndarray) -> np.ndarray:
        """Return the undistorted ``pixels`` (H, W) or (H, W, 3) of a photo, of the same type; zero outside the photo's
        view."""
        return self._remap(pixels, cv2.INTER_LINEAR)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Undistort the ``mask`` (H, W) bool of a photo."""
        return self._remap(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0

    def _remap(self, pixels: np.ndarray, interpolation: int) -> np.ndarray:
        # In OpenCV, the centre of the first pixel is at 0.
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
    # The map is cached, because most photos of a data set share their camera.
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy], axis=-1)
    radius = np.linalg.norm(rays, axis=-1)
    distorted = lens.distorted(rays) * [fx, fy] + [cx, cy]
    inside = ((distorted > 0.5) & (distorted < [width - 0.5, height - 0.5])).all(axis=-1)
    known = inside & (radius < lens.valid_radius(1.01 * float(radius.max())))
    return Undistortion(np.where(known[..., None], distorted, -1e4).astype(np.float32), known)
