"""The frame of a body: origin under the body, z up, x and y along the body. Results in this frame do not depend on the
axes of the capture's file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.short_repr import short_repr

GROUND = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
"""Ground plane in the frame of the body."""

_REACH = 3.0
"""Standard deviation of the Gaussian weight of points about the centre, in median distances from it. The weight
prevents outliers from rotating the frame."""
_ELONGATED = 0.05
"""Second angular moment about the up direction, from 0 to 1, above which a body is elongated. The direction of a
rounder body is defined by its largest angular moment."""
_FOLDS = (1, 2, 3, 4, 5, 6)


@dataclass(frozen=True)
class BodyFrame:
    """Position, axes and scale of a body's frame in the capture. Lengths in the frame are in metres if ``scale`` is in
    metres per unit of the capture."""

    __repr__ = short_repr

    axes: np.ndarray
    """(3, 3) float64, the body's x, y and z as rows, in the axes of the capture; z is the normal of the plane."""
    origin: np.ndarray
    """(3,) float64, position on the plane under the robust centre of the body, in units of the capture."""
    scale: float
    """Length of one unit of the capture in the frame of the body, such as metres per unit."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform the capture's ``points`` (..., 3) to the body's frame."""
        return self.scale * ((np.asarray(points, float) - self.origin) @ self.axes.T)

    def capture_points(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from the frame of the body to that of the capture."""
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

    def camera(self, camera: Camera) -> Camera:
        """Transform a ``camera`` of the capture to the body's frame."""
        return replace(
            camera,
            rotation=camera.rotation @ self.axes.T,
            translation=self.scale * (camera.rotation @ self.origin + camera.translation),
            near=self.scale * camera.near,
        )

    def scaled(self, factor: float) -> BodyFrame:
        """Return the frame with lengths multiplied by ``factor``."""
        return replace(self, scale=self.scale * factor)

    def moved(self, shift: np.ndarray) -> BodyFrame:
        """Return the frame after the capture has moved by ``shift`` (3,), in units of the capture."""
        return replace(self, origin=self.origin + shift)


def upright_frame(points: np.ndarray, weights: np.ndarray, plane: Plane) -> BodyFrame:
    """Compute the frame of a body that stands on ``plane``. The frame rotates, moves and scales with the body.

    The origin is the projection of a robust centre onto the plane. The robust centre is the fixed point of a mean with
    wide Gaussian weights about this mean. The x axis is the longer principal axis within the plane. If the body is
    nearly round about the up direction, the x axis is instead defined by the strongest of the angular moments sum w r^p
    e^(i m angle), m = 1 to 6. The moment of order m defines m directions, of which the one closest to the moment of
    order 1 is used. The exponent p is m, except that it is 3 for m = 1. The unit of length is the median distance from
    the robust centre. Equal points in equal order give bitwise equal frames.

    Args:
        points: (n, 3) points of the body.
        weights: (n,) weights of the points.
        plane: the plane under the body.

    Raises:
        UserError: all points coincide.
    """
    # If all weights are zero, use equal ones; a later stage reports that no Gaussian is opaque.
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
    """Return the robust centre (3,), the median distance from it, and the weights (n,), which decrease with
    distance."""
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
    """Return the complex angular moment sum w r^p e^(i m angle) / sum w r^p of the points ``flat`` (n,), given as x +
    iy, with m = ``fold``.

    The exponent p is m, except that it is 3 for m = 1, because that moment with p = 1 vanishes about the mean.
    """
    radius = np.abs(flat)
    power = 3 if fold == 1 else fold
    powers = flat**fold * radius ** (power - fold)
    total = float((weights * radius**power).sum())
    return complex((weights * powers).sum() / total) if total > 0.0 else 0j
