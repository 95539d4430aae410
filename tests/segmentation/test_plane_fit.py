"""Fit of the plane to rendered depth: closed forms, outliers, several views and error messages."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.plane_fit import PlaneView, _gather, _reweighted, _tukey, fit_plane, plane_depth

TRUTH = Plane.from_coefficients(0.2, -0.9, 0.3, 0.4)


def camera_over(plane: Plane, azimuth: float, *, elevation: float = 0.6, width: int = 120, height: int = 90) -> Camera:
    first, second = plane.tangents()
    target = -plane.offset * plane.normal
    level = np.cos(azimuth) * first + np.sin(azimuth) * second
    eye = target + 3.0 * (np.cos(elevation) * level + np.sin(elevation) * plane.normal)
    return Camera.look_at(eye, target, plane.normal, width=width, height=height)


def spoiled_view(plane: Plane, azimuth: float, seed: int) -> PlaneView:
    """Return a view with 1 % noise in all depths, of which 30 % are wrong."""
    random = np.random.default_rng(seed)
    camera = camera_over(plane, azimuth)
    depth = plane_depth(plane, camera)
    mask = (depth > 0.0) & (depth < 12.0)
    wrong = mask & (random.random(depth.shape) < 0.3)
    depth = np.where(wrong, depth * random.uniform(0.3, 1.5, depth.shape), depth)
    return PlaneView(camera, depth * (1.0 + 0.01 * random.normal(size=depth.shape)), mask)


def angle(a: Plane, b: Plane) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a.normal, b.normal)), a.normal @ b.normal)))


def test_plane_measures_height_towards_the_objects_side() -> None:
    """Eq. (1): N.x + d is the signed distance to the plane, positive on the side to which N points, in any unit."""
    plane = Plane.from_coefficients(0.0, 0.0, -2.0, 3.0)
    np.testing.assert_allclose(plane.normal, [0.0, 0.0, -1.0])
    np.testing.assert_allclose(plane.heights(np.array([[5.0, 1.0, 1.5], [0.0, 0.0, 0.5]])), [0.0, 1.0])
    np.testing.assert_allclose(plane.scaled(10.0).heights(np.array([0.0, 0.0, 5.0])), 10.0)
    first, second = plane.tangents()
    np.testing.assert_allclose(np.cross(first, second), plane.normal, atol=1e-12)


def test_depth_puts_every_pixel_on_the_plane() -> None:
    """Eq. (18): the point at depth D_p along each pixel's ray is on the plane; rays are scaled to a z-depth of 1, and
    sky pixels have no depth."""
    camera = camera_over(TRUTH, 0.3, elevation=0.1)
    depth, rays = plane_depth(TRUTH, camera), camera_rays(camera)
    np.testing.assert_allclose(rays @ camera.rotation[2], 1.0, atol=1e-12)
    hit = depth > 0.0
    assert 0.2 < hit.mean() < 0.9, "the horizon must be in the picture"
    np.testing.assert_allclose(TRUTH.heights((camera.centre + depth[..., None] * rays)[hit]), 0.0, atol=1e-9)
    assert (rays[~hit] @ TRUTH.normal > 0.0).all()


@pytest.mark.parametrize("azimuth", [0.0, 1.0, 2.5])
@pytest.mark.parametrize("paper_start", [False, True])
def test_one_view_with_outliers_and_noise(azimuth: float, paper_start: bool) -> None:
    """Eq. (18), (19): the error is at most 0.1 degree and 0.1 % of the extent, also from the paper's start (look
    direction, d = 0)."""
    view = spoiled_view(TRUTH, azimuth, seed=3)
    start = Plane(view.camera.rotation[2], 0.0) if paper_start else None
    fit = fit_plane([view], start=start)
    assert angle(fit.plane, TRUTH) < 0.1
    extent = 4.0
    assert abs(float(fit.plane.heights(-TRUTH.offset * TRUTH.normal))) < 1e-3 * extent
    assert fit.plane.heights(view.camera.centre) > 0.0
    assert 0.008 < fit.noise < 0.012
    assert 0.6 < fit.inlier_share < 0.75


def test_exact_depth_gives_the_exact_plane() -> None:
    """Eq. (19): without noise, the plane is exact to rounding."""
    camera = camera_over(TRUTH, 0.7)
    depth = plane_depth(TRUTH, camera)
    fit = fit_plane([PlaneView(camera, depth, depth > 0.0)])
    assert angle(fit.plane, TRUTH) < 1e-5
    assert abs(fit.plane.offset - TRUTH.offset) < 1e-6


def test_weights_of_one_over_the_residual_reject_outliers() -> None:
    """Weights of 1 / abs(residual) turn least squares into least absolute residuals: if a fifth of the depths are too
    small and the others exact, the plane is still exact."""
    camera = camera_over(TRUTH, 0.7)
    depth = plane_depth(TRUTH, camera)
    mask = (depth > 0.0) & (depth < 12.0)
    wrong = np.random.default_rng(0).random(depth.shape) < 0.2
    pixels = _gather([PlaneView(camera, np.where(wrong, 0.6 * depth, depth), mask)], np.random.default_rng(0))
    found = _reweighted(pixels, Plane(camera.rotation[2], 0.0))
    assert angle(found, TRUTH) < 0.01
    assert abs(found.offset - TRUTH.offset) < 1e-3


def test_several_views_are_fitted_together() -> None:
    """Eq. (19): the fit to three noisy views has a smaller error than the mean error of fits to single views."""
    views = [spoiled_view(TRUTH, azimuth, seed) for seed, azimuth in enumerate((0.0, 2.0, 4.0))]
    alone = [angle(fit_plane([view]).plane, TRUTH) for view in views]
    assert angle(fit_plane(views).plane, TRUTH) < np.mean(alone)


def test_views_that_cannot_be_fitted_are_reported() -> None:
    camera = camera_over(TRUTH, 0.0)
    depth = plane_depth(TRUTH, camera)
    with pytest.raises(
        UserError, match=r"mask of view 0 has \(50, 40\) pixels, but the picture of its camera has \(120, 90\)"
    ):
        fit_plane([PlaneView(camera, depth, np.ones((40, 50), bool))])
    with pytest.raises(UserError, match="only 0 pixels inside the masks have a depth, fewer than 30"):
        fit_plane([PlaneView(camera, np.zeros_like(depth), np.ones_like(depth, bool))])
    with pytest.raises(UserError, match="there are no views"):
        fit_plane([])
    noise = np.random.default_rng(0).uniform(0.5, 20.0, depth.shape)
    with pytest.raises(UserError, match=r"plane: none fits the masks: the best one leaves depth errors of [3-9]\d %"):
        fit_plane([PlaneView(camera, noise, np.ones_like(depth, bool))])
    # A few wide splats exactly on one plane, and haze everywhere else: their residual is zero, and no other plane fits.
    random = np.random.default_rng(0)
    steps = depth * np.where(random.uniform(size=depth.shape) < 0.35, 1.0, random.uniform(0.7, 1.3, depth.shape))
    with pytest.raises(UserError, match=r"the best one explains only 3\d % of the pixels"):
        fit_plane([PlaneView(camera, steps, np.ones_like(depth, bool))])


def test_the_loss_of_outliers_has_its_derivatives() -> None:
    """The first and second derivatives of Tukey's biweight with respect to z equal finite differences, inside and
    outside the cutoff.
    """
    z, step = np.array([0.05, 0.3, 0.6, 0.9, 1.2, 5.0]), 1e-5
    low, at, high = _tukey(z - step), _tukey(z), _tukey(z + step)
    np.testing.assert_allclose((high[0] - low[0]) / (2.0 * step), at[1], atol=1e-8)
    np.testing.assert_allclose((high[1] - low[1]) / (2.0 * step), at[2], atol=1e-8)
    assert at[0, -1] == pytest.approx(1.0 / 3.0) and at[0, 0] == pytest.approx(0.05, rel=0.06)
