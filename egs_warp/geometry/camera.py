"""Pinhole camera in OpenCV axes: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, TypeAlias

import numpy as np

from egs_warp.checked_calls import Finite, Positive, PositiveCount, Range, checked_constructor, checked_method
from egs_warp.errors import ArgumentError
from egs_warp.short_repr import short_repr

_ORTHONORMAL = 1e-3
"""Maximum deviation of the products of the rows of a rotation from those of orthonormal ones."""
_PARALLEL = 1e-9
"""Sine of the angle below which two directions are parallel."""
_BISECTIONS = 50
"""Number of bisections that centre a camera. Each halves the error of the position of its eye."""
FILMED_FROM = (0.82, -0.57, 0.27)
"""Direction from a body to the camera of its film: components ahead, left and up. It is 35 degrees from the facing
direction, so the camera sees a three-quarter view of the face, and a path ahead is not foreshortened to a point."""


_Far: TypeAlias = Annotated[float, Range(0.0, above=True, infinite=True)]
"""A distance above 0; infinity draws everything in front of the camera."""


@checked_constructor
@dataclass(frozen=True)
class Camera:
    """World-to-camera pose ``[rotation | translation]`` and intrinsics in pixels."""

    __repr__ = short_repr

    width: PositiveCount
    height: PositiveCount
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    rotation: Annotated[np.ndarray, 3, 3]
    """(3, 3) float64, rotation from world to camera axes."""
    translation: Annotated[np.ndarray, 3]
    """(3,) float64, translation from world to camera, world units."""
    near: Positive = 0.01
    far: _Far = 1e6

    def __post_init__(self) -> None:
        if self.near >= self.far:
            raise ArgumentError("near", f"give a distance below far, {self.far:g}", value=self.near)
        if not has_orthonormal_rows(self.rotation):
            raise ArgumentError("rotation", "its rows are not orthonormal; give the axes x, y, z of the camera")

    @property
    def centre(self) -> np.ndarray:
        """(3,) position of the camera centre, world units."""
        return -self.rotation.T @ self.translation

    @classmethod
    @checked_method
    def look_at(
        cls,
        eye: Annotated[np.ndarray, 3],
        target: Annotated[np.ndarray, 3],
        up: Annotated[np.ndarray, 3],
        *,
        width: PositiveCount,
        height: PositiveCount,
        vertical_fov_degrees: Annotated[float, Range(0.01, 179.0)] = 40.0,
        near: Positive = 0.01,
        far: _Far = 1e6,
    ) -> Camera:
        """Create a camera at ``eye`` (3,) with its optical axis towards ``target`` (3,); ``up`` (3,), which must not be
        parallel to the axis, points up in the image.

        Raises ``ArgumentError`` if the axis or the right side of the image is undefined.
        """
        forward = np.asarray(target, float) - np.asarray(eye, float)
        if not forward.any():
            raise ArgumentError("target", "it equals eye; give the point that the camera looks at")
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, float))
        if np.linalg.norm(right) <= _PARALLEL * np.linalg.norm(up):
            raise ArgumentError("up", "it is parallel to the direction from eye to target; give another direction")
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        focal = 0.5 * height / np.tan(np.radians(vertical_fov_degrees) / 2.0)
        return cls(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=width / 2.0,
            cy=height / 2.0,
            rotation=rotation,
            translation=-rotation @ np.asarray(eye, float),
            near=near,
            far=far,
        )


def has_orthonormal_rows(rotation: np.ndarray) -> bool:
    """Return True if the rows of ``rotation`` (3, 3) are orthonormal to within three digits."""
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() <= _ORTHONORMAL)


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """Return the same view with both sides divided by ``factor``, rounded down to at least one pixel."""
    return replace(
        camera,
        width=max(camera.width // factor, 1),
        height=max(camera.height // factor, 1),
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
    )


def downscale(camera: Camera, side: int) -> Camera:
    """Return the same view with both sides divided by the smallest integer that makes them at most ``side`` pixels."""
    factor = -(-max(camera.width, camera.height) // side)
    return camera if factor <= 1 else reduced_camera(camera, factor)


def fitted_camera(camera: Camera, points: np.ndarray, *, sides: float, top: float, bottom: float) -> Camera:
    """Return ``camera`` moved, without rotation, to the nearest position from which it shows all ``points`` (n, 3), in
    the middle between the margins of the picture.

    A point at depth d in front of the eye is within the margins if each of its two lateral offsets lies between fixed
    slopes times d. Each margin is thus linear in the position of the eye, so the nearest position can be computed
    exactly.

    Args:
        camera: rotation and intrinsics; its principal point is in the picture.
        points: (n, 3), world units.
        sides, top, bottom: maximum extent of the points from the principal point towards the left and right, top, and
            bottom edges, as a fraction of the distance to the edge.
    """
    across, down, along = camera.rotation @ points.T
    centre, slopes = [], []
    for values, focal, before, after in (
        (across, camera.fx, sides * camera.cx, sides * (camera.width - camera.cx)),
        (down, camera.fy, top * camera.cy, bottom * (camera.height - camera.cy)),
    ):
        least, most = before / focal, after / focal
        # For an eye at lateral position e and depth z, (values - e) must lie between least * (along - z) and most *
        # (along - z).
        slopes.append((least, most))
        centre.append(((values - most * along).max(), (values + least * along).min()))
    depth = min((high - low) / (least + most) for (low, high), (least, most) in zip(centre, slopes, strict=True))
    eye = [
        _centred(values, along - depth, low + most * depth, high - least * depth, most - least)
        for values, (low, high), (least, most) in zip((across, down), centre, slopes, strict=True)
    ]
    return replace(camera, translation=-np.array([*eye, depth]), near=0.01 * float(along.mean() - depth))


def _centred(values: np.ndarray, depths: np.ndarray, low: float, high: float, sum_of_slopes: float) -> float:
    """Return the position e of the eye along an image axis, between ``low`` and ``high``, at which the smallest and the
    largest slope (values - e) / depths have the sum ``sum_of_slopes``.

    The points then have equal distances from both margins in the picture. In the middle between ``low`` and ``high``
    they have not, because equal offsets of the eye move near points further in the picture than far ones.
    """
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        slopes = (values - middle) / depths
        # Both slopes decrease with the position of the eye.
        if slopes.min() + slopes.max() > sum_of_slopes:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def camera_rays(camera: Camera) -> np.ndarray:
    """Return the rays (H, W, 3) r = R^T K^-1 [u, v, 1] of Eq. (18) in world axes, with z-depth 1."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    return rays @ camera.rotation
