"""Lenses: distortion compared with OpenCV and COLMAP, and undistorted photos."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import root

from egs_warp.assets import pawn
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Lens, Undistortion
from egs_warp.render import render_gaussians

POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 2))
MODELS = {
    "SIMPLE_RADIAL": {"k1": -0.12},
    "RADIAL": {"k1": -0.12, "k2": 0.03},
    "OPENCV": {"k1": -0.12, "k2": 0.03, "p1": 0.01, "p2": -0.02},
    "FULL_OPENCV": {"k1": 0.1, "k2": 0.03, "p1": 0.01, "p2": -0.02, "k3": 0.02, "k4": 0.2, "k5": 0.01, "k6": 0.03},
    "OPENCV_FISHEYE": {"k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": 0.002},
    "SIMPLE_RADIAL_FISHEYE": {"k1": 0.05},
    "RADIAL_FISHEYE": {"k1": 0.05, "k2": -0.02},
    "FISHEYE": {},
}


@pytest.mark.parametrize("model", MODELS)
def test_lenses_are_opencvs(model: str) -> None:
    numbers = MODELS[model]
    lens = Lens.named(model, numbers)
    assert lens is not None
    if "FISHEYE" in model:
        k = np.array([numbers.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")])
        expected = cv2.fisheye.distortPoints(POINTS[:, None], np.eye(3), k)[:, 0]
    else:
        k = np.array([numbers.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
        rays = np.column_stack([POINTS, np.ones(len(POINTS))])
        expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), k)[0][:, 0]
    np.testing.assert_allclose(lens.distorted(POINTS), expected, atol=1e-9)


def test_thin_prisms_and_the_fov_model_by_hand() -> None:
    """COLMAP's THIN_PRISM_FISHEYE is evaluated term by term at one point; FOV is compared with the closed form of its
    inverse."""
    numbers = {"k1": 0.1, "k2": 0.2, "p1": 0.01, "p2": 0.02, "k3": 0.03, "k4": 0.04, "sx1": 0.05, "sy1": 0.06}
    lens = Lens.named("THIN_PRISM_FISHEYE", numbers)
    assert lens is not None
    theta = np.arctan(0.5)
    u, v = theta * 0.6, theta * 0.8
    r2 = theta**2
    radial = 1 + 0.1 * r2 + 0.2 * r2**2 + 0.03 * r2**3 + 0.04 * r2**4
    x = u * radial + 2 * 0.01 * u * v + 0.02 * (r2 + 2 * u * u) + 0.05 * r2
    y = v * radial + 2 * 0.02 * u * v + 0.01 * (r2 + 2 * v * v) + 0.06 * r2
    np.testing.assert_allclose(lens.distorted(np.array([0.3, 0.4])), [x, y], atol=1e-12)
    fov = Lens.named("FOV", {"omega": 0.8})
    assert fov == Lens.named("FOV", {"omega": -0.8})
    assert fov is not None
    radius = np.linalg.norm(fov.distorted(POINTS), axis=1)
    np.testing.assert_allclose(
        np.tan(0.8 * radius) / (2 * np.tan(0.4)), np.linalg.norm(POINTS, axis=1), rtol=1e-9, atol=1e-12
    )


NEWER = {
    "SIMPLE_DIVISION": {"k": -0.15},
    "DIVISION": {"k": 0.12},
    "EUCM": {"alpha": 0.6, "beta": 1.1},
    "RAD_TAN_THIN_PRISM_FISHEYE": {
        **{"k1": 0.02, "k2": -0.05, "k3": 0.04, "k4": -0.01, "k5": 0.002, "k6": -0.0003},
        **{"p1": 0.004, "p2": -0.003, "s1": 0.002, "s2": -0.001, "s3": -0.003, "s4": 0.0015},
    },
}


def ray_of(model: str, numbers: dict[str, float], bent: np.ndarray) -> np.ndarray:
    """Return the undistorted position (2,) on the plane z = 1 for the distorted position ``bent`` (2,), as defined by
    COLMAP's ``CamFromImg``."""
    r2 = float(bent @ bent)
    if "DIVISION" in model:
        return bent / (1 + numbers["k"] * r2)
    if model == "EUCM":
        alpha, beta = numbers["alpha"], numbers["beta"]
        depth = (1 - alpha**2 * beta * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * beta * r2) + 1 - alpha)
        return bent / depth

    def residual(angle: np.ndarray) -> np.ndarray:
        theta2 = angle @ angle
        u = angle * (1 + sum(numbers[f"k{n}"] * theta2**n for n in range(1, 7)))
        p = np.array([numbers["p1"], numbers["p2"]])
        s2 = u @ u
        tangential = 2 * (p @ u) * u + p * s2
        prism = [numbers["s1"] * s2 + numbers["s2"] * s2**2, numbers["s3"] * s2 + numbers["s4"] * s2**2]
        return u + tangential + prism - bent

    found = root(residual, bent, tol=1e-13)
    theta = np.linalg.norm(found.x)
    return found.x * np.tan(theta) / theta


@pytest.mark.parametrize("model", NEWER)
def test_newer_lenses_of_colmap(model: str) -> None:
    """An independent inverse recovers the undistorted points. At the centre, the distortion is the identity to first
    order; it is invertible up to the radius 0.8."""
    lens = Lens.named(model, NEWER[model])
    assert lens is not None
    bent = lens.distorted(POINTS)
    assert np.abs(bent - POINTS).max() > 0.02
    np.testing.assert_allclose([ray_of(model, NEWER[model], one) for one in bent], POINTS, atol=1e-9)
    step = 1e-6
    forward = (lens.distorted(np.eye(2) * step) - lens.distorted(-np.eye(2) * step)) / (2 * step)
    np.testing.assert_allclose(forward, np.eye(2), atol=1e-6)
    # The Jacobian of the inverse is the inverse of the Jacobian.
    there = np.array(
        [(lens.distorted(POINTS[0] + e) - lens.distorted(POINTS[0] - e)) / (2 * step) for e in np.eye(2) * step]
    )
    back = np.array(
        [
            (ray_of(model, NEWER[model], bent[0] + e) - ray_of(model, NEWER[model], bent[0] - e)) / (2 * step)
            for e in np.eye(2) * step
        ]
    )
    np.testing.assert_allclose(there @ back, np.eye(2), atol=1e-6)
    assert lens.valid_radius(0.8) == 0.8


def test_ranges_of_newer_lenses() -> None:
    """The division model with k > 0 ends at the radius 1 / (2 sqrt(k)); EUCM is a pinhole for alpha = 0."""
    division = Lens.named("SIMPLE_DIVISION", {"k": 0.25})
    assert division is not None and division.valid_radius(3.0) == pytest.approx(1.0, abs=0.01)
    assert Lens.named("DIVISION", {"k": 0.0}) is None
    assert Lens.named("EUCM", {"alpha": 0.0, "beta": 1.3}) is None
    for numbers in ({"alpha": 1.2, "beta": 1.0}, {"alpha": 0.5, "beta": 0.0}):
        with pytest.raises(ValueError, match="is not from 0 to 1, or beta"):
            Lens.named("EUCM", numbers)


def test_a_lens_that_bends_nothing_is_none() -> None:
    assert Lens.named("OPENCV", {"k1": 0.0, "p2": 0.0}) is None
    assert Lens.named("PINHOLE", {}) is None


def photographed(picture: np.ndarray, pinhole: Camera, taken: Camera, lens: Lens) -> np.ndarray:
    """Return the photo that the camera ``taken`` with ``lens`` makes of a scene whose image by the camera ``pinhole``,
    at the same position, is ``picture``."""
    columns, rows = np.meshgrid(np.arange(taken.width) + 0.5, np.arange(taken.height) + 0.5)
    wanted = np.stack([(columns - taken.cx) / taken.fx, (rows - taken.cy) / taken.fy], axis=-1)
    rays = wanted.copy()
    for _ in range(60):
        rays += wanted - lens.distorted(rays)
    at = rays * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy] - 0.5
    where = at.astype(np.float32)
    return cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize(
    ("model", "numbers"),
    [
        ("SIMPLE_RADIAL", {"k1": -0.25}),
        ("OPENCV", {"k1": 0.2, "k2": 0.05, "p1": 0.02, "p2": -0.01}),
        ("OPENCV_FISHEYE", {"k1": 0.05, "k2": -0.02, "k3": 0.0, "k4": 0.0}),
    ],
)
def test_a_photo_through_a_lens_is_undistorted(model: str, numbers: dict[str, float]) -> None:
    """An image that is distorted and then undistorted equals the original image; without undistortion, the error is
    more than three times as large."""
    lens = Lens.named(model, numbers)
    assert lens is not None
    size = 192
    camera = Camera.look_at(
        np.array([0.0, 1.2, 2.2]), np.array([0.0, 0.5, 0.0]), np.array([0.0, 1.0, 0.0]), width=size, height=size
    )
    # The image is finer and wider than the photo, so that distorting it loses little.
    fine = replace(
        camera, width=4 * size, height=4 * size, fx=2 * camera.fx, fy=2 * camera.fy, cx=2 * size, cy=2 * size
    )
    cloud = pawn(gaussian_count=3000, device="cpu").cloud
    picture = render_gaussians(cloud, fine).colour.numpy()
    straight = photographed(picture, fine, camera, Lens())
    bent = photographed(picture, fine, camera, lens)
    way = Undistortion.of(camera, lens)
    back = way.picture(bent)
    inner = way.known & (np.abs(straight - 1).sum(axis=2) > 0.05)
    assert inner.mean() > 0.05
    error, unbent = (np.abs(one - straight)[inner].mean() for one in (back, bent))
    assert error < 0.02
    assert unbent > 3 * error
    assert not back[~way.known].any()


def test_pixels_outside_the_lens_are_unknown_and_clicks_are_mapped() -> None:
    """With a pincushion lens, the corners of the pinhole image are unknown; with a barrel lens, all pixels are
    known."""
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0, np.eye(3), np.zeros(3))
    wide = Undistortion.of(camera, Lens(radial=(0.3, 0.0, 0.0, 0.0)))
    assert not wide.known[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert wide.known[20, 30]
    lens = Lens(radial=(-0.1, 0.0, 0.0, 0.0))
    barrel = Undistortion.of(camera, lens)
    assert barrel.known.all()
    ray = np.array([0.3, -0.2])
    u, v = lens.distorted(ray) * 50.0 + [30.0, 20.0]
    np.testing.assert_allclose(barrel.pixel(u, v), ray * 50.0 + [30.0, 20.0], atol=0.6)


def test_the_folded_range_of_a_polynomial_is_unknown() -> None:
    """Beyond r = 1 / sqrt(1.5), the distorted radius r - 0.5 r^3 decreases, so pixels there are unknown."""
    lens = Lens(radial=(-0.5, 0.0, 0.0, 0.0))
    assert lens.valid_radius(3.0) == pytest.approx(1 / np.sqrt(1.5), abs=0.01)
    camera = Camera(200, 200, 50.0, 50.0, 100.0, 100.0, np.eye(3), np.zeros(3))
    known = Undistortion.of(camera, lens).known
    rows, columns = np.mgrid[:200, :200] + 0.5
    radius = np.hypot(columns - 100, rows - 100) / 50
    assert not known[radius > 0.83].any()
    assert known[radius < 0.8].all()


def test_masks_stay_masks() -> None:
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0, np.eye(3), np.zeros(3))
    way = Undistortion.of(camera, Lens(radial=(0.3, 0.0, 0.0, 0.0)))
    mask = np.zeros((40, 60), bool)
    mask[:, 30:] = True
    moved = way.mask(mask)
    assert moved.dtype == bool
    assert moved[20, 31:55].all() and not moved[:, :29].any()
