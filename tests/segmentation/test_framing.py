"""Framing of photos: which points they show, and how far from the middle."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.segmentation.framing import outside_frames, picture_radii

UP = np.array([0.0, 0.0, 1.0])


def photos(count: int, target: float = 0.0) -> list[Camera]:
    """Return cameras in an arc that look at the position ``target`` on the x axis."""
    middle = np.array([target, 0.0, 0.5])
    angles = np.radians(np.linspace(-140.0, -40.0, count))
    eyes = [middle + 3.0 * np.array([np.cos(angle), np.sin(angle), 0.3]) for angle in angles]
    return [Camera.look_at(eye, middle, UP, width=64, height=48, vertical_fov_degrees=30.0) for eye in eyes]


def test_only_photos_of_the_point_count() -> None:
    """The fraction of the frames that do not contain a point is defined for eight or more photos, and other photos do
    not change it."""
    middle, points = np.array([0.0, 0.0, 0.5]), np.array([[0.0, 0.0, 0.5], [3.0, 0.0, 0.5]])
    assert outside_frames(points, middle, photos(7)) is None
    shares = outside_frames(points, middle, photos(9))
    assert shares is not None and shares.tolist() == [0.0, 1.0]
    again = outside_frames(points, middle, [*photos(9), *photos(30, target=9.0)])
    assert again is not None
    np.testing.assert_array_equal(again, shares)


def test_radii_are_in_units_of_half_the_shorter_side() -> None:
    """At distance 2 with a vertical field of view of 90 degrees, half of the height of a picture is 2."""
    camera = Camera.look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3), UP, width=64, height=48, vertical_fov_degrees=90.0)
    radii, half = picture_radii(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [1.0, 0.0, 0.0], [0.0, -3.0, 0.0]]), camera)
    np.testing.assert_allclose(radii, [0.0, 1.0, 0.5, np.inf], atol=1e-9)
    np.testing.assert_allclose(half, [2.0, 2.0, 2.0, 0.0], atol=1e-9)
