"""A body's own frame: its origin under the body, z up, x and y along the body itself, so that no file's axes enter a
result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane

GROUND = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
"""What a body stands on, in its own frame."""

_REACH = 3.0
"""Of the median distance from the middle: how far a point counts (the width of a Gaussian), lest strays turn the
frame.
"""
_ELONGATED = 0.05
"""Second moment about up, of 1, from which a body has a long side; a rounder one is faced by what it has most of."""
_FOLDS = (1, 2, 3, 4, 5, 6)


@dataclass(frozen=True)
class BodyFrame:
    """Where a body's frame lies in the capture. Lengths of the body's frame are metres, or whatever its scale makes
    them.
    """

    axes: np.ndarray
    """(3, 3) float64: rows are the body's x, y and z in the capture's axes; z is the plane's normal."""
    origin: np.ndarray
    """(3,) float64, capture's units: on the plane, under the body's middle."""
    scale: float
    """Lengths of the body's frame for one of the capture's unit (metres per unit, once a body has its size)."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """The capture's ``points`` (..., 3) in the body's frame."""
        return self.scale * ((np.asarray(points, float) - self.origin) @ self.axes.T)

    def capture_points(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the body's frame in the capture's."""
        return self.origin + (np.asarray(points, float) / self.scale) @ self.axes

    def plane(self, plane: Plane) -> Plane:
        """The capture's ``plane`` in the body's frame."""
        return Plane(self.axes @ plane.normal, self.scale * float(plane.heights(self.origin)))

    def height_field(self, field: HeightField) -> HeightField:
        """The capture's ``field`` in the body's frame."""
        return HeightField(
            field.axes @ self.axes.T,
            self.points(field.origin),
            self.scale * field.spacing,
            self.scale * field.coefficients,
        )

    def scaled(self, factor: float) -> BodyFrame:
        """The frame whose lengths are ``factor`` times as many."""
        return replace(self, scale=self.scale * factor)

    def moved(self, shift: np.ndarray) -> BodyFrame:
        """The frame of the body after the capture has moved by ``shift`` (3,), capture's units."""
        return replace(self, origin=self.origin + shift)


def upright_frame(points: np.ndarray, weights: np.ndarray, plane: Plane) -> BodyFrame:
    """Frame of a body of ``points`` (n, 3) with ``weights`` (n,) that stands on ``plane``; it turns, moves and grows
    with it.

    The origin is the foot of a robust middle (the fixed point of a mean under a wide Gaussian about itself). x is the
    long principal axis about up; a body as good as round about up faces along the strongest of its angular moments
    sum w r^p e^(i m angle), m = 1 to 6. Of the ways that this leaves, x is that of the third moments (m = 1).
    One length is the median distance from the middle. The same points in the same order give the same bits.

    Raises ``UserError`` if all of the points are in one place.
    """
    # Without any opacity the frame is as good as the points; what is wrong with them is said by who looks for a body.
    middle, reach, near = _middle(points, weights if weights.sum() > 0.0 else np.ones(len(points)))
    first, second = orthonormal_basis(plane.normal)
    arms = (points - middle) / reach
    flat = arms @ first + 1j * (arms @ second)
    moments = {fold: _angular_moment(flat, near, fold) for fold in _FOLDS}
    fold = 2 if abs(moments[2]) > _ELONGATED else max(_FOLDS, key=lambda m: abs(moments[m]))
    ways = (np.angle(moments[fold]) + 2.0 * np.pi * np.arange(fold)) / fold
    angle = ways[int(np.argmax((moments[1] * np.exp(-1j * ways)).real))]
    x = np.cos(angle) * first + np.sin(angle) * second
    axes = np.stack([x, np.cross(plane.normal, x), plane.normal])
    return BodyFrame(axes, middle - float(plane.heights(middle)) * plane.normal, 1.0 / reach)


def _middle(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Middle (3,), median distance from it, and the weights (n,) with which points count, less the further they are."""
    middle = np.median(points, axis=0)
    for _ in range(60):
        distance = np.sqrt(((points - middle) ** 2).sum(axis=1))
        reach = float(np.median(distance)) or float(distance.mean())
        if not reach > 0.0:
            raise UserError(
                f"object: all of its {len(points)} Gaussians are at one point, so it has no volume;"
                " choose another object"
            )
        near = weights * np.exp(-0.5 * (distance / (_REACH * reach)) ** 2)
        before, middle = middle, (near[:, None] * points).sum(axis=0) / near.sum()
        if np.abs(middle - before).max() <= 1e-13 * reach:
            break
    return middle, reach, near


def _angular_moment(flat: np.ndarray, weights: np.ndarray, fold: int) -> complex:
    """Sum w r^p e^(i m angle) / sum w r^p of points (n,) x + iy; p is m, but 3 for m = 1, whose first moment is
    nothing.
    """
    radius = np.abs(flat)
    power = 3 if fold == 1 else fold
    turned = flat**fold * radius ** (power - fold)
    total = float((weights * radius**power).sum())
    return complex((weights * turned).sum() / total) if total > 0.0 else 0j
