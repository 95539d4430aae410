"""Gaussians that straddle the plane: their extent, their part above the plane, and the loss that clears the plane (Eq.
20, 21)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.clearance import (
    ExtentMeasure,
    StraddlingOptions,
    StraddlingPolicy,
    _in_pictures,
    _subdivided,
    clear_plane,
    foot_ring,
    half_space,
    plane_extents,
    views_above,
)
from tests.support.scenes import FLOOR, round_ones, shell

PLANE = Plane.from_coefficients(0.3, -0.5, 0.8, 0.1)


def cloud_near(plane: Plane, device: str, count: int = 60, seed: int = 0, lowest: float = 0.0) -> GaussianCloud:
    random = np.random.default_rng(seed)
    means = random.uniform(-1.0, 1.0, (count, 3))
    means += (random.uniform(lowest, 0.3, count) - plane.heights(means))[:, None] * plane.normal
    return GaussianCloud.from_numpy(
        means,
        random.normal(size=(count, 4)),
        random.uniform(-4.0, -1.5, (count, 3)),
        random.uniform(-1.0, 3.0, count),
        random.normal(size=(count, 1, 3)),
        device=device,
    )


def covariances(cloud: GaussianCloud) -> np.ndarray:
    turns = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]].astype(np.float64)).as_matrix()
    axes = turns * np.exp(cloud.log_scales.numpy().astype(np.float64))[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_reach_is_that_of_the_six_tips_or_of_the_whole_ellipsoid(device: str) -> None:
    """Eq. (20): the extent is the height of the farthest axis tip. The extent of the whole ellipsoid is larger by a
    factor of at most sqrt(3)."""
    cloud = cloud_near(PLANE, device)
    turns = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    arms = turns * np.exp(cloud.log_scales.numpy())[:, None, :]
    tips = 3.0 * np.abs(np.einsum("nij,i->nj", arms, PLANE.normal)).max(axis=1)
    heights, reach = plane_extents(cloud, PLANE, ExtentMeasure.AXIS_TIPS)
    np.testing.assert_allclose(heights, PLANE.heights(cloud.means.numpy()), atol=1e-5)
    np.testing.assert_allclose(reach, tips, rtol=1e-4)
    _, whole = plane_extents(cloud, PLANE)
    expected = 3.0 * np.sqrt(np.einsum("i,nij,j->n", PLANE.normal, covariances(cloud), PLANE.normal))
    np.testing.assert_allclose(whole, expected, rtol=1e-4)
    assert ((whole > reach * 0.9999) & (whole < np.sqrt(3.0) * reach * 1.0001)).all()


def test_half_above_has_the_moments_of_the_cut_normal_distribution(device: str) -> None:
    """The moments along N equal the moments of SciPy's truncated normal distribution; the moments across N follow from
    them by linear regression."""
    cloud = cloud_near(PLANE, device)
    chosen = np.arange(cloud.count) % 3 != 0
    half = half_space(cloud, PLANE, chosen)
    sigma0, sigma1 = covariances(cloud), covariances(half)
    means0, means1 = cloud.means.numpy().astype(np.float64), half.means.numpy().astype(np.float64)
    n = PLANE.normal
    for k in np.flatnonzero(chosen):
        spread = np.sqrt(n @ sigma0[k] @ n)
        t = -PLANE.heights(means0[k]) / spread
        hazard = norm.pdf(t) / norm.sf(t)
        along = sigma0[k] @ n / spread
        np.testing.assert_allclose(means1[k], means0[k] + hazard * along, atol=2e-5)
        expected = sigma0[k] - hazard * (hazard - t) * np.outer(along, along)
        np.testing.assert_allclose(sigma1[k], expected, atol=3e-5 * np.trace(sigma0[k]) + 1e-9)
        assert PLANE.heights(means1[k]) > 0.0
        # Viewed along the plane, the new Gaussian has the mass of the part above the plane, unless its peak would
        # exceed the original peak.
        mass = half.opacities()[k] * np.sqrt(n @ sigma1[k] @ n)
        share = min(norm.sf(t), np.sqrt(n @ sigma1[k] @ n) / spread)
        assert mass == pytest.approx(cloud.opacities()[k] * spread * share, rel=1e-3)
    np.testing.assert_array_equal(means1[~chosen], means0[~chosen])
    assert (half.opacities()[chosen] <= cloud.opacities()[chosen] + 1e-5).all()


def test_far_above_the_plane_the_half_is_the_whole(device: str) -> None:
    cloud = cloud_near(PLANE, device)
    far = Plane(PLANE.normal, PLANE.offset + 50.0)
    half = half_space(cloud, far, np.ones(cloud.count, bool))
    np.testing.assert_allclose(half.means.numpy(), cloud.means.numpy(), atol=1e-6)
    np.testing.assert_allclose(covariances(half), covariances(cloud), rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(half.opacities(), cloud.opacities(), atol=1e-5)


def test_far_below_the_plane_the_half_lies_on_it(device: str) -> None:
    """The mean of a normal distribution beyond t standard deviations is less than 1 / t standard deviations beyond that
    limit (Gordon 1941)."""
    cloud = cloud_near(PLANE, device)
    means, spread = (
        cloud.means.numpy(),
        np.sqrt(np.einsum("i,nij,j->n", PLANE.normal, covariances(cloud), PLANE.normal)),
    )
    t = np.linspace(6.5, 30.0, cloud.count)
    sunk = GaussianCloud.from_numpy(
        means - (PLANE.heights(means) + t * spread)[:, None] * PLANE.normal,
        cloud.rotations.numpy(),
        cloud.log_scales.numpy(),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
        device=device,
    )
    half = half_space(sunk, PLANE, np.ones(cloud.count, bool))
    assert (np.abs(PLANE.heights(half.means.numpy())) < spread / t).all()
    assert np.isfinite(half.opacity_logits.numpy()).all() and half.opacities().max() < 1e-3


def test_straddling_gaussians_are_split_in_three(device: str) -> None:
    """A Gaussian is split along the axis that extends farthest through the plane. The three children together have the
    mean and covariance of the parent, and none is more opaque. A Gaussian that does not reach the plane is unchanged,
    and a child below the plane is removed.
    """
    first, second = PLANE.tangents()
    turn = Rotation.from_matrix(np.stack([second, PLANE.normal, first], axis=1)).as_quat()[[3, 0, 1, 2]]
    foot = -PLANE.offset * PLANE.normal
    heights = np.array([0.15, 0.05, 0.5])
    cloud = GaussianCloud.from_numpy(
        foot + heights[:, None] * PLANE.normal,
        np.tile(turn, (3, 1)),
        np.tile(np.log([0.03, 0.1, 0.02]), (3, 1)),
        np.array([12.0, 1.0, 2.0]),
        np.zeros((3, 1, 3)),
        device=device,
    )
    # Two of the Gaussians extend through the plane by 0.3.
    assert _subdivided(cloud, PLANE, ExtentMeasure.ELLIPSOID, 0.31, 100) is cloud
    split = _subdivided(cloud, PLANE, ExtentMeasure.ELLIPSOID, 0.29, 100)
    np.testing.assert_allclose(PLANE.heights(split.means.numpy()), [0.5, 0.05, 0.15, 0.25, 0.05, 0.15], atol=1e-5)
    np.testing.assert_allclose(covariances(split)[0], covariances(cloud)[2], atol=1e-8)
    arms = split.means.numpy()[1:4].astype(np.float64) - cloud.means.numpy()[0]
    spread = covariances(split)[1:4] + arms[:, :, None] * arms[:, None, :]
    np.testing.assert_allclose(np.einsum("k,kij->ij", [0.25, 0.5, 0.25], spread), covariances(cloud)[0], atol=1e-7)
    opacities = split.opacities()
    assert opacities[0] == pytest.approx(cloud.opacities()[2])
    for child, parent in zip(range(1, 6), [0, 0, 0, 1, 1], strict=True):
        assert 0.0 < opacities[child] < cloud.opacities()[parent]


def tall_object(count: int = 600, straddling: float = 0.05) -> GaussianCloud:
    """Return an object of height 1 on the floor. The fraction ``straddling`` of its Gaussians straddles the floor, with
    extents of 0.03 to 0.3 of the height, as measured in a capture of a bedroom; most of them are tilted."""
    random = np.random.default_rng(5)
    low = round(straddling * count)
    means = random.uniform([-0.3, -0.3, 0.2], [0.3, 0.3, 1.0], (count, 3))
    means[:low, 2] = random.uniform(0.001, 0.02, low)
    scales = np.full((count, 3), np.log(0.02))
    scales[:low] = np.log(random.uniform(0.01, 0.1, (low, 3)))
    return GaussianCloud.from_numpy(
        means,
        random.normal(size=(count, 4)),
        scales,
        np.full(count, 3.0),
        random.uniform(-1.0, 1.0, (count, 1, 3)),
    )


def test_subdivision_starts_with_the_farthest_extents_and_is_bounded() -> None:
    """Without a limit, five rounds multiply the straddling Gaussians by more than 20; with a limit, those with the
    largest extents are split first."""
    cloud = tall_object()
    heights, extent = plane_extents(cloud, FLOOR)
    crossing = np.flatnonzero(np.abs(heights) < extent)
    assert 25 <= len(crossing) <= 35
    first = _subdivided(cloud, FLOOR, ExtentMeasure.ELLIPSOID, 0.006, cloud.count + 3)
    assert cloud.count < first.count <= cloud.count + 2
    sizes = [one.log_scales.numpy().sum(axis=1) for one in (cloud, first)]
    missing = cloud.means.numpy()[~np.isin(*sizes)]
    np.testing.assert_array_equal(missing, cloud.means.numpy()[[crossing[np.argmax(extent[crossing])]]])
    free, bounded = cloud, cloud
    for _ in range(5):
        free = _subdivided(free, FLOOR, ExtentMeasure.ELLIPSOID, 0.006, 1 << 30)
        bounded = _subdivided(bounded, FLOOR, ExtentMeasure.ELLIPSOID, 0.006, 750)
    assert free.count > cloud.count + 20 * len(crossing)
    assert 740 <= bounded.count <= 750


@pytest.mark.parametrize("straddling", [0.05, 1.0])
def test_clearing_is_finite_and_keeps_the_number_of_gaussians(straddling: float) -> None:
    """The limit also holds if all Gaussians straddle the plane, as in a carpet, and some of them are extremely thin."""
    pytest.importorskip("torch")
    cloud = tall_object(straddling=straddling)
    scales = cloud.log_scales.numpy().copy()
    scales[::7, 1] = -12.0
    cloud = replace(cloud, log_scales=wp.array(scales, dtype=wp.vec3, device="cpu"))
    cameras = foot_ring(cloud, FLOOR, size=48)[::6]
    options = StraddlingOptions(iterations=12)
    cleared = clear_plane(cloud, FLOOR, StraddlingPolicy.FINETUNE, cameras=cameras, options=options)
    assert 0.9 * cloud.count <= cleared.count <= (1.0 + options.max_growth) * cloud.count
    for name in ("means", "rotations", "log_scales", "opacity_logits", "sh"):
        assert np.isfinite(getattr(cleared, name).numpy()).all()
    assert (FLOOR.heights(cleared.means.numpy()) > 0.0).all()


def test_an_object_that_training_moves_below_the_plane_is_split(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    cloud = tall_object()
    below = replace(cloud, means=wp.array(cloud.means.numpy() - [0.0, 0.0, 2.0], dtype=wp.vec3, device="cpu"))
    monkeypatch.setattr("egs_warp.segmentation.clearance._finetuned", lambda *_: below)
    cleared, split = (
        clear_plane(cloud, FLOOR, method, cameras=foot_ring(cloud, FLOOR, size=16)[:1])
        for method in (StraddlingPolicy.FINETUNE, StraddlingPolicy.SPLIT)
    )
    for name in ("means", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(cleared, name).numpy(), getattr(split, name).numpy())


def test_views_are_cropped_to_the_foot() -> None:
    """A crop contains the same pixels of the foot as the whole image. Views that do not show the foot are removed if
    others show it."""
    pytest.importorskip("torch")
    from egs_warp.segmentation.clearance import _cropped

    cloud = tall_object()
    foot = cloud.subset(cloud.means.numpy()[:, 2] < 0.1)
    eye, up = np.array([0.5, -6.0, 0.4]), np.array([0.0, 0.0, 1.0])
    cameras = [Camera.look_at(eye, np.array([0.0, y, 0.4]), up, width=320, height=240) for y in (0.0, -12.0)]
    views = views_above(foot, FLOOR, cameras)
    (crop,) = _cropped(views, foot)
    assert crop.image.shape[0] * crop.image.shape[1] < 0.2 * views[0].image.shape[0] * views[0].image.shape[1]
    (again,) = views_above(foot, FLOOR, [crop.camera])
    assert again.alpha is not None and crop.alpha is not None and views[0].alpha is not None
    np.testing.assert_allclose(crop.alpha, again.alpha, atol=2e-3)
    assert crop.alpha.sum() == pytest.approx(views[0].alpha.sum(), rel=1e-3)
    assert _cropped(views[1:], foot) == views[1:]


def test_gaussians_outside_all_pictures() -> None:
    """Occluded Gaussians count as inside an image; Gaussians beside and behind the camera do not."""
    eye, up = np.array([0.0, -4.0, 0.0]), np.array([0.0, 0.0, 1.0])
    camera = Camera.look_at(eye, np.zeros(3), up, width=32, height=32)
    cloud = round_ones(np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [9.0, 0.0, 0.0], [0.0, -9.0, 0.0]]), 0.2)
    np.testing.assert_array_equal(_in_pictures(cloud, [camera]), [True, True, False, False])
    assert not _in_pictures(cloud, []).any()


def test_foot_cameras_are_low_and_centred_on_the_foot() -> None:
    """The cameras look at a column of radius 0.3 away from the origin. They are less than 30 degrees above the plane,
    and the foot is in the centre of each image and fills most of it."""
    turns, levels = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False), np.linspace(0.0, 1.0, 40))
    angle, height = turns.ravel(), levels.ravel()
    means = np.column_stack([5.0 + 0.3 * np.cos(angle), -3.0 + 0.3 * np.sin(angle), height])
    column = GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (4000, 1)),
        np.full((4000, 3), -4.0),
        np.zeros(4000),
        np.zeros((4000, 1, 3)),
    )
    foot = means[height < 0.05]
    for camera in foot_ring(column, Plane(np.array([0.0, 0.0, 1.0]), 0.0)):
        away = camera.centre - [5.0, -3.0, 0.0]
        assert 0.0 < np.degrees(np.arctan2(away[2], np.hypot(away[0], away[1]))) < 30.0
        seen = (foot - camera.centre) @ camera.rotation.T
        aside = camera.fx * seen[:, 0] / seen[:, 2] / (0.5 * camera.width)
        assert abs(aside.max() + aside.min()) < 0.05 and 0.6 < aside.max() < 1.0


@pytest.mark.parametrize("above", [True, False])
def test_a_camera_below_the_plane_ignores_what_it_sees_through_it(above: bool) -> None:
    """For a camera above the plane, all pixels of a ball over the floor have weight; for a camera below the plane, only
    empty pixels have weight."""
    pytest.importorskip("torch")
    ball = round_ones(shell() + [0.0, 0.0, 0.2], 0.04)
    eye = np.array([2.0, 0.0, 2.0 if above else -2.0])
    camera = Camera.look_at(eye, np.array([0.0, 0.0, 0.7]), np.array([0.0, 0.0, 1.0]), width=48, height=48)
    (view,) = views_above(ball, FLOOR, [camera])
    assert view.alpha is not None and view.weight is not None
    shown = view.alpha > 0.0
    assert 0.1 < shown.mean() < 0.9
    assert (view.weight[shown] == float(above)).all() and (view.weight[~shown] == 1.0).all()


def test_flat_splats_survive_the_cut() -> None:
    """Scales down to e^-10 would be lost in a float32 covariance."""
    values = cloud_near(PLANE, "cpu")
    scales = values.log_scales.numpy().copy()
    scales[:, 1] = -10.0
    flat = GaussianCloud.from_numpy(
        values.means.numpy(), values.rotations.numpy(), scales, values.opacity_logits.numpy(), values.sh.numpy()
    )
    half = half_space(flat, PLANE, np.ones(flat.count, bool))
    thin = np.sort(half.log_scales.numpy(), axis=1)[:, 0]
    assert np.isfinite(half.log_scales.numpy()).all()
    assert (np.abs(thin + 10.0) < 1.2).all()


def test_removing_leaves_nothing_across_the_plane() -> None:
    cloud = cloud_near(PLANE, "cpu")
    heights, reach = plane_extents(clear_plane(cloud, PLANE, StraddlingPolicy.REMOVE), PLANE)
    assert (np.abs(heights) >= reach).all()
    assert clear_plane(cloud, PLANE, StraddlingPolicy.NONE) is cloud


def test_an_object_that_clearing_leaves_empty_is_an_error_of_that_stage() -> None:
    cloud = cloud_near(PLANE, "cpu")
    heights, reach = plane_extents(cloud, PLANE)
    straddling = cloud.subset(np.abs(heights) < reach)
    message = rf"^clear: none of the object's {straddling.count} Gaussians is left: all of them straddle the plane and"
    with pytest.raises(UserError, match=message):
        clear_plane(straddling, PLANE, StraddlingPolicy.REMOVE)
    below = cloud_near(PLANE.moved(-2.0 * PLANE.normal), "cpu")
    with pytest.raises(UserError, match=r"^clear: none .* after splitting all of their means lie below the plane"):
        _subdivided(
            replace(below, log_scales=wp.zeros(below.count, dtype=wp.vec3, device="cpu")),
            PLANE,
            ExtentMeasure.ELLIPSOID,
            0.0,
            1000,
        )


def test_loss_is_the_sum_over_straddling_gaussians() -> None:
    """Eq. (21): the loss is the sum of max(eta_seg - abs(d0), 0) over Gaussians on both sides of the plane; its
    gradients equal finite differences.
    """
    torch = pytest.importorskip("torch")
    from egs_warp.segmentation.clearance import straddling_loss
    from egs_warp.training.gaussian_tensors import GaussianTensors

    cloud = cloud_near(PLANE, "cpu", count=20, lowest=-0.2)
    names = {"means": "means", "rotations": "rotations", "log_scales": "log_scales", "opacity_logits": "opacity_logits"}
    leaves = {
        name: torch.tensor(getattr(cloud, field).numpy().astype(np.float64), requires_grad=True)
        for name, field in names.items()
    }
    rest = {"sh_band_0": torch.zeros(20, 1, 3), "sh_rest": torch.zeros(20, 0, 3)}
    normal, near = torch.tensor(PLANE.normal), torch.arange(20)
    for reach in ExtentMeasure:
        heights, eta = plane_extents(cloud, PLANE, reach)
        expected = np.maximum(eta - np.abs(heights), 0.0).sum()
        loss = straddling_loss(GaussianTensors(**leaves, **rest), near, normal, PLANE.offset, reach)
        assert float(loss.detach()) == pytest.approx(expected, rel=1e-4)
        straddling = eta > np.abs(heights)
        assert (straddling & (heights > 0.0)).any() and (straddling & (heights < 0.0)).any()
        inputs = [leaves[name] for name in ("means", "rotations", "log_scales")]

        def value(means: Any, rotations: Any, log_scales: Any, reach: ExtentMeasure = reach) -> Any:
            tensors = GaussianTensors(means, rotations, log_scales, leaves["opacity_logits"], **rest)
            return straddling_loss(tensors, near, normal, PLANE.offset, reach)

        assert torch.autograd.gradcheck(value, inputs, eps=1e-7, atol=1e-4)


def test_finetuning_clears_the_plane_and_keeps_the_appearance() -> None:
    """Eq. (20), (21): for a small ball on its plane, training reduces the loss by at least 65 % and moves straddling
    Gaussians up; all others are unchanged, and the image stays the same."""
    pytest.importorskip("torch")
    from egs_warp.geometry.camera import Camera
    from egs_warp.render import render_gaussians
    from egs_warp.training.metrics import psnr

    random = np.random.default_rng(2)
    floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    points = random.normal(size=(400, 3))
    points = 0.5 * points / np.linalg.norm(points, axis=1, keepdims=True) + [0.0, 0.0, 0.45]
    points = points[points[:, 2] > 0.0]
    ball = GaussianCloud.from_numpy(
        points,
        random.normal(size=(len(points), 4)),
        np.full((len(points), 3), -2.9),
        np.full(len(points), 3.0),
        random.uniform(-0.8, 0.8, (len(points), 1, 3)),
    )
    before, eta = plane_extents(ball, floor)
    crossing = float(np.maximum(eta - np.abs(before), 0.0).sum())
    assert (np.abs(before) < eta).sum() > 20
    cameras = foot_ring(ball, floor, size=72)[::3]
    options = StraddlingOptions(iterations=120, subdivisions=0, weight=3.0)
    tuned = clear_plane(ball, floor, StraddlingPolicy.FINETUNE, cameras=cameras, options=options)
    hasty = replace(options, iterations=3)
    cut, left = (
        clear_plane(ball, floor, StraddlingPolicy.FINETUNE, cameras=cameras, options=replace(hasty, cut_rest=cut_rest))
        for cut_rest in (True, False)
    )
    # The cut replaces the Gaussians that still straddle the plane after the training.
    heights, reach = plane_extents(left, floor)
    straddles = np.abs(heights) < reach
    assert np.array_equal(cut.means.numpy()[~straddles], left.means.numpy()[~straddles])
    assert (floor.heights(cut.means.numpy())[straddles] > floor.heights(left.means.numpy())[straddles]).mean() > 0.9
    after, eta = plane_extents(tuned, floor)
    assert float(np.maximum(eta - np.abs(after), 0.0).sum()) < 0.35 * crossing
    assert (after > 0.0).all()
    camera = Camera.look_at(np.array([0.3, -3.0, 1.0]), np.array([0.0, 0.0, 0.5]), floor.normal, width=96, height=96)
    view = views_above(ball, floor, [camera])[0]
    pictures = [render_gaussians(one, camera, background=(0.0, 0.0, 0.0)).colour.numpy() for one in (ball, tuned)]
    assert view.weight is not None
    counted = view.weight[..., None] > 0
    assert psnr(np.where(counted, pictures[0], 0.0), np.where(counted, pictures[1], 0.0)) > 30.0
