"""Uneven ground: heights over a plane, smooth enough to have a normal everywhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from egs_warp.errors import UserError
from egs_warp.geometry.plane import Plane
from egs_warp.short_repr import short_repr

_BOUNDARY = "mirror"
_NEWTON_STEPS = 8
_DAMAGED = "ground: its height field is damaged; make it again with egs-warp segment"
_MAX_NODES = 1 << 22
"""Maximum number of nodes of a grid."""


@dataclass(frozen=True)
class HeightField:
    """A biquadratic B-spline over a square grid, with continuous heights and normals.

    Outside the grid, the height is that of the nearest point of its edge. Lengths are in the units of the frame of
    ``axes`` and ``origin``.
    """

    __repr__ = short_repr

    axes: np.ndarray
    """(3, 3) right-handed unit vectors as rows: directions of increasing column, of increasing row, and of height."""
    origin: np.ndarray
    """(3,) position of node (0, 0) at height 0."""
    spacing: float
    """Distance between nodes."""
    coefficients: np.ndarray
    """(rows, columns) float64, coefficients of the spline."""

    @classmethod
    def through(cls, axes: np.ndarray, origin: np.ndarray, spacing: float, heights: np.ndarray) -> HeightField:
        """Create the height field with ``heights`` (rows, columns) at its nodes."""
        return cls(axes, origin, spacing, ndimage.spline_filter(heights, order=2, output=np.float64, mode=_BOUNDARY))

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit normal of the reference plane."""
        return self.axes[2]

    @property
    def plane(self) -> Plane:
        """The reference plane, from which heights are measured."""
        return Plane(self.axes[2], -float(self.axes[2] @ self.origin))

    def tangents(self) -> tuple[np.ndarray, np.ndarray]:
        """Return two unit vectors (3,) that span the reference plane."""
        return self.axes[0], self.axes[1]

    def ground_height(self, points: np.ndarray) -> np.ndarray:
        """Return the height (...,) of the ground over the reference plane at the projections of ``points`` (..., 3)."""
        return self._spline(np.asarray(points, float))[0]

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Return the height (...,) of ``points`` (..., 3) over the ground, along the plane's normal; positive above."""
        points = np.asarray(points, float)
        return (points - self.origin) @ self.axes[2] - self._spline(points)[0]

    def gaps(self, points: np.ndarray) -> np.ndarray:
        """Return the distance (...,) of ``points`` (..., 3) from the tangent plane of the ground under them; negative
        below.

        On the ground it is zero and its gradient is the normal. Elsewhere, it equals the distance from the ground to
        first order.
        """
        points = np.asarray(points, float)
        height, (first, second) = self._spline(points)
        return ((points - self.origin) @ self.axes[2] - height) / np.sqrt(1.0 + first**2 + second**2)

    def frames(self, points: np.ndarray) -> np.ndarray:
        """Return right-handed orthonormal frames (n, 3, 3) as rows: the ground's normal under ``points`` (n, 3) and two
        tangents. They vary continuously."""
        _, (first, second) = self._spline(np.asarray(points, float))
        zero, one = np.zeros_like(first), np.ones_like(first)
        normal = np.stack([-first, -second, one], axis=1) / np.sqrt(1.0 + first**2 + second**2)[:, None]
        along = np.stack([one, zero, first], axis=1) / np.sqrt(1.0 + first**2)[:, None]
        return np.stack([normal, along, np.cross(normal, along)], axis=1) @ self.axes

    def distance_along(self, point: np.ndarray, up: np.ndarray) -> float:
        """Return the distance from ``point`` (3,) to the ground along the direction ``up`` (3,), computed by Newton's
        method."""
        distance = 0.0
        for _ in range(_NEWTON_STEPS):
            last = distance
            distance -= float(self.heights(point + distance * up)) / float(up @ self.axes[2])
            if distance == last:
                break
        return distance

    def flatten(self, points: np.ndarray) -> np.ndarray:
        """Move ``points`` (n, 3) along the plane's normal so that their heights over the plane equal their former
        heights over the ground."""
        return points - self.ground_height(points)[:, None] * self.axes[2]

    def unflatten(self, points: np.ndarray) -> np.ndarray:
        """Apply the inverse of ``flatten``."""
        return points + self.ground_height(points)[:, None] * self.axes[2]

    def nodes(self) -> np.ndarray:
        """Return the positions (rows, columns, 3) of the nodes on the ground."""
        at = np.stack(np.meshgrid(*(np.arange(count) for count in self.coefficients.shape[::-1])), axis=-1)
        flat = self.origin + self.spacing * (at @ self.axes[:2])
        return flat + self._spline(flat)[0][..., None] * self.axes[2]

    def scaled(self, factor: float) -> HeightField:
        """Return the same ground with all lengths multiplied by ``factor``."""
        return replace(
            self,
            origin=factor * self.origin,
            spacing=factor * self.spacing,
            coefficients=factor * self.coefficients,
        )

    def moved(self, shift: np.ndarray) -> HeightField:
        """Return the same ground moved by ``shift`` (3,)."""
        return replace(self, origin=self.origin + shift)

    def coarser(self, spacing: float) -> HeightField:
        """Return the ground smoothed to a node ``spacing``, or this field if it is already as coarse. Features narrower
        than two spacings lose most of their height."""
        if spacing <= self.spacing:
            return self
        ratio = spacing / self.spacing
        heights = (self.nodes() - self.origin) @ self.axes[2]
        # The standard deviation of the blur is half a spacing: features with a wavelength of two spacings keep 30 % of
        # their height, and features with a wavelength of four spacings keep 74 %.
        smooth = np.asarray(ndimage.gaussian_filter(heights, 0.5 * ratio, mode="nearest"))
        rows, columns = (max(int(np.ceil((count - 1) / ratio)) + 1, 3) for count in heights.shape)
        at = np.stack(np.meshgrid(ratio * np.arange(rows), ratio * np.arange(columns), indexing="ij"))
        sampled = ndimage.map_coordinates(smooth, at, order=1, mode="nearest")
        return HeightField.through(self.axes, self.origin, spacing, sampled)

    def _spline(self, points: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the height (...,) of the ground at ``points`` (..., 3), and its slopes (...,) along both tangents."""
        away = (points - self.origin) / self.spacing
        (column, across), (row, along) = (_weights(away @ axis) for axis in self.axes[:2])
        rows, columns = self.coefficients.shape
        height, first, second = (np.zeros(away.shape[:-1]) for _ in range(3))
        for j in range(3):
            for i in range(3):
                c = self.coefficients[np.clip(row + j - 1, 0, rows - 1), np.clip(column + i - 1, 0, columns - 1)]
                height += along[0][j] * across[0][i] * c
                first += along[0][j] * across[1][i] * c
                second += along[1][j] * across[0][i] * c
        return height, (first / self.spacing, second / self.spacing)


def check_grid(field: HeightField) -> None:
    """Raise ``UserError`` for an invalid field: too small or large, not finite, or with skewed axes."""
    if field.coefficients.ndim != 2:
        raise UserError(_DAMAGED)
    rows, columns = field.coefficients.shape
    finite = np.isfinite(field.coefficients).all() and np.isfinite(field.origin).all() and 0.0 < field.spacing < np.inf
    square = np.abs(field.axes @ field.axes.T - np.eye(3)).max() < 1e-6 if np.isfinite(field.axes).all() else False
    if not (min(rows, columns) >= 3 and rows * columns <= _MAX_NODES and finite and square):
        raise UserError(_DAMAGED)


def _weights(place: np.ndarray) -> tuple[np.ndarray, tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]]:
    """Return the index of the node nearest to each coordinate ``place``, which is in units of the spacing; the weights
    of this node's predecessor, of itself and of its successor; and the derivatives of these weights."""
    nearest = np.floor(place + 0.5)
    f = place - nearest
    weights = (0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2)
    # Far from the grid, the value of the index does not matter, but it must be a valid integer.
    return np.clip(nearest, -2.0, 1e9).astype(np.int64), (weights, (f - 0.5, -2.0 * f, f + 0.5))
