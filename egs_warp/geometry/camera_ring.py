"""Cameras on rings around an object, for captures without cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.plane import Plane

ELEVATIONS = (12.0, 30.0, 52.0)
"""Elevations of the rings above the plane, degrees."""


def ring_camera(
    direction: np.ndarray, centre: np.ndarray, radius: float, up: np.ndarray, *, size: int, vertical_fov_degrees: float
) -> Camera:
    """Return a camera whose view contains the ball of ``radius`` around ``centre`` (3,). ``direction`` (3,) points from
    the centre to the camera; ``size`` is the width and height of the image, pixels."""
    distance = radius / np.sin(np.radians(vertical_fov_degrees / 2.0))
    eye = centre + distance * direction / np.linalg.norm(direction)
    return Camera.look_at(
        eye, centre, up, width=size, height=size, vertical_fov_degrees=vertical_fov_degrees, near=0.01 * distance
    )


def ring_cameras(
    plane: Plane,
    centre: np.ndarray,
    radius: float,
    *,
    count: int = 18,
    elevations: Sequence[float] = ELEVATIONS,
    size: int = 384,
    vertical_fov_degrees: float = 40.0,
    margin: float = 1.25,
) -> list[Camera]:
    """Return ``count`` cameras on rings above ``plane`` whose views contain the ball of ``radius`` around ``centre``
    (3,), enlarged by the factor ``margin``.

    The elevations alternate, so that neighbours differ in both angles. ``size`` is the width and height of each image,
    pixels.
    """
    first, second = plane.tangents()
    distance = margin * radius / np.sin(np.radians(vertical_fov_degrees / 2.0))
    cameras = []
    for number in range(count):
        azimuth = 2.0 * np.pi * number / count
        elevation = np.radians(elevations[number % len(elevations)])
        level = np.cos(azimuth) * first + np.sin(azimuth) * second
        eye = centre + distance * (np.cos(elevation) * level + np.sin(elevation) * plane.normal)
        cameras.append(
            Camera.look_at(
                eye,
                centre,
                plane.normal,
                width=size,
                height=size,
                vertical_fov_degrees=vertical_fov_degrees,
                near=0.02 * distance,
            )
        )
    return cameras
