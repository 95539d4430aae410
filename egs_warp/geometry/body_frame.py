"""A body's own frame: origin under the body, z up, x and y along the body, so that the axes of a file do not affect a
result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane

GROUND = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
"""The ground in the body's own frame."""

_REACH = 3.0
"""Standard deviation, in median distances from the middle, of the Gaussian by which points are weighted. The weights
keep outliers from rotating the frame."""
_ELONGATED = 0.05
"""Second angular moment about the up direction, from 0 to 1, above which a body has a long side; the direction of a
rounder body is that of its largest moment."""
_FOLDS = (1, 2, 3, 4, 5, 6)


@dataclass(frozen=True)
class BodyFrame:
    """Position, axes and scale of a body's frame in the capture. Its lengths are metres once ``scale`` is metres per
    unit."""

    axes: np.ndarray
    """(3, 3) float64, rows are the body's x, y and z in the capture's axes; z is the plane's normal."""
    origin: np.ndarray
    """(3,) float64, capture's units, on the plane under the body's middle."""
    scale: float
    """Body-frame length of one capture unit (metres per unit, once a body has its size)."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform the capture's ``points`` (..., 3) to the body's frame."""
        return self.scale * ((np.asarray(points, float) - self.origin) @ self.axes.T)

    def capture_points(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from the body's frame to the capture's."""
        return self.origin + (np.asarray(points, float) / self.scale) @ self.axes

    def plane(self, plane: Plane) -> Plane:
        """Transform the capture's ``plane`` to the body's frame."""
        return Plane(self.axes @ plane.normal, self.scale * float(plane.heights(self.origin)))

    def height_field(self, field: HeightField) -> HeightField:
        """Transform the capture's ``field`` to the body's frame."""
        return HeightField(
            field.axes @ self.axes.T,
            self.points(field.origin),
            self.scale * field.spacing,
            self.scale * field.coefficients,
        )

    def scaled(self, factor: float) -> BodyFrame:
        """Return the frame with lengths multiplied by ``factor``."""
        return replace(self, scale=self.scale * factor)

    def moved(self, shift: np.ndarray) -> BodyFrame:
        """Return the frame after the capture has moved by ``shift`` (3,), capture's units."""
        return replace(self, origin=self.origin + shift)


def upright_frame(points: np.ndarray, weights: np.ndarray, plane: Plane) -> BodyFrame:
    """Compute the frame of a body that stands on ``plane``. It rotates, moves and scales with the body.

    The origin is the projection onto the plane of a robust middle: the fixed point of a mean with a wide Gaussian
    weight around itself. x is the longer principal axis within the plane. If the body is nearly round about the up
    direction, x follows the strongest of its angular moments sum w r^p e^(i m angle), m = 1 to 6. Among the m
    directions that this leaves, x is the one closest to the moment m = 1, for which p is 3. The unit of length is the
    median distance from the middle. The same points in the same order give the same bits.

    Args:
        points: (n, 3) points of the body.
        weights: (n,) their weights.
        plane: the plane under the body.

    Raises:
        UserError: all points coincide.
    """
    # If all weights are zero, use equal ones; the search for a body reports that nothing is opaque.
    middle, reach, near = _middle(points, weights if weights.sum() > 0.0 else np.ones(len(points)))
    first, second = orthonormal_basis(plane.normal)
    arms = (points - middle) / reach
    flat = arms @ first + 1j * (arms @ second)
    moments = {fold: _angular_moment(flat, near, fold) for fold in _FOLDS}
    fold = 2 if abs(moments[2]) > _ELONGATED else max(_FOLDS, key=lambda m: abs(moments[m]))
    directions = (np.angle(moments[fold]) + 2.0 * np.pi * np.arange(fold)) / fold
    angle = directions[int(np.argmax((moments[1] * np.exp(-1j * directions)).real))]
    x = np.cos(angle) * first + np.sin(angle) * second
    axes = np.stack([x, np.cross(plane.normal, x), plane.normal])
    return BodyFrame(axes, middle - float(plane.heights(middle)) * plane.normal, 1.0 / reach)


def _middle(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the middle (3,), the median distance from it, and the weights (n,), which decrease with distance."""
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
    """Return sum w r^p e^(i m angle) / sum w r^p of points (n,) x + iy; p is m, but 3 for m = 1, whose first moment
    vanishes."""
    radius = np.abs(flat)
    power = 3 if fold == 1 else fold
    powers = flat**fold * radius ** (power - fold)
    total = float((weights * radius**power).sum())
    return complex((weights * powers).sum() / total) if total > 0.0 else 0j
