"""Renderer compared with a slow NumPy reference, symmetries and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render import render_gaussians, render_views
from egs_warp.render.projection import project, view_from_camera
from egs_warp.render.tiles import _lists_by_counting, _lists_by_sorting, lists_fit
from tests.support.render_twin import render_twin, rotation_matrices, sh_basis

EYE = np.array([0.3, -0.4, -3.0])


def random_scene(
    count: int, *, coefficients: int = 16, seed: int = 0, log_scale: float = -2.3
) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {
        "means": random.uniform(-1, 1, (count, 3)),
        "rotations": random.normal(size=(count, 4)),
        "log_scales": random.normal(log_scale, 0.8, (count, 3)),
        "opacity_logits": random.normal(0.5, 2.0, count),
        "sh": random.normal(0, 0.4, (count, coefficients, 3)) / np.arange(1, coefficients + 1)[None, :, None],
    }


def cloud_of(values: dict[str, Any], device: str = "cpu") -> GaussianCloud:
    return GaussianCloud.from_numpy(**values, device=device)


def one_splat(**changes: object) -> dict[str, np.ndarray]:
    values: dict[str, object] = {
        "means": [[0.0, 0.0, 0.0]],
        "rotations": [[1.0, 0.0, 0.0, 0.0]],
        "log_scales": [[-1.0, -1.0, -1.0]],
        "opacity_logits": [2.0],
        "sh": [[[1.0, 0.5, -0.5]]],
        **changes,
    }
    return {name: np.array(value, dtype=np.float64) for name, value in values.items()}


def camera_of(width: int = 67, height: int = 45, **changes: float) -> Camera:
    return Camera.look_at(EYE, np.zeros(3), np.array([0, -1.0, 0]), width=width, height=height, **changes)


def assert_same(image: object, twin: dict[str, np.ndarray], *, near_cut: float = 2e-3) -> None:
    """Assert equality to rounding, except for the few pixels where a splat is at its alpha cut of 1/255."""
    for name in ("colour", "alpha", "depth"):
        got, expected = getattr(image, name).numpy(), twin[name]
        off = np.abs(got - expected) / np.maximum(1.0, np.abs(expected))
        assert off.mean() < 1e-5, name
        assert (off > 1e-4).mean() < near_cut, name
        assert off.max() < 0.02, name


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_same_picture_as_the_twin(device: str, coefficients: int) -> None:
    values = random_scene(300, coefficients=coefficients)
    camera = camera_of()
    assert_same(render_gaussians(cloud_of(values, device), camera), render_twin(values, camera))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 33), (250, 3)])
def test_sizes_that_are_no_multiple_of_a_tile(device: str, width: int, height: int) -> None:
    values = random_scene(200, seed=width)
    camera = camera_of(width, height)
    assert_same(render_gaussians(cloud_of(values, device), camera), render_twin(values, camera), near_cut=0.02)


def test_antialiased_mode_and_background_image(device: str) -> None:
    values = random_scene(300, seed=3, log_scale=-4.5)
    camera = camera_of()
    background = np.random.default_rng(1).uniform(size=(camera.height, camera.width, 3))
    image = render_gaussians(cloud_of(values, device), camera, background=background, antialiased=True)
    assert_same(image, render_twin(values, camera, background=background, antialiased=True))


def test_long_thin_splats_do_not_cancel(device: str) -> None:
    """Needles with an aspect ratio of 1000 on the screen are rendered like the reference; with the usual conic form in
    float32, all digits would be lost."""
    values = random_scene(60, seed=5)
    values["log_scales"] = np.tile([1.0, -7.0, -9.0], (60, 1))
    camera = camera_of(200, 160)
    assert_same(render_gaussians(cloud_of(values, device), camera), render_twin(values, camera), near_cut=0.02)


def test_zero_visible_gives_the_background(device: str) -> None:
    values = random_scene(20)
    values["means"] -= [0, 0, 100.0]
    image = render_gaussians(cloud_of(values, device), camera_of(), background=(0.2, 0.4, 0.6))
    np.testing.assert_allclose(image.colour.numpy(), np.broadcast_to([0.2, 0.4, 0.6], (45, 67, 3)), rtol=1e-6)
    assert not image.alpha.numpy().any()
    assert not image.depth.numpy().any()


def test_opacity_zero_and_one(device: str) -> None:
    camera = camera_of()
    for logit, centre_alpha in ((-100.0, 0.0), (100.0, 0.999)):
        values = one_splat(opacity_logits=[logit], log_scales=[[1.0, 1.0, 1.0]])
        image = render_gaussians(cloud_of(values, device), camera)
        assert_same(image, render_twin(values, camera))
        assert image.alpha.numpy()[22, 33] == pytest.approx(centre_alpha, abs=1e-3)


def test_tiny_scales_render_as_the_low_pass_filter(device: str) -> None:
    """A Gaussian of scale e^-10 covers the area of the 0.3 px low-pass: 2 pi 0.3 opacity square pixels of alpha."""
    values = one_splat(log_scales=[[-10.0] * 3], opacity_logits=[8.0])
    camera = camera_of(64, 64)
    image = render_gaussians(cloud_of(values, device), camera)
    assert_same(image, render_twin(values, camera))
    # The cutoff at 1/255 removes less than 1/255 of the total; sampling on the pixel grid adds less than 3 %.
    assert image.alpha.numpy().sum() == pytest.approx(2 * np.pi * 0.3, rel=0.05)


def test_camera_inside_a_gaussian_and_one_that_covers_the_screen(device: str) -> None:
    camera = camera_of()
    big = {"log_scales": [[3.0, 3.0, 3.0]], "opacity_logits": [0.0]}
    inside = one_splat(means=[EYE + 0.001 * camera.rotation[2]], **big)
    assert not render_gaussians(cloud_of(inside, device), camera).alpha.numpy().any(), "nearer than the near plane"
    just_ahead = one_splat(means=[EYE + 0.05 * camera.rotation[2]], **big)
    assert_same(render_gaussians(cloud_of(just_ahead, device), camera), render_twin(just_ahead, camera))
    covering = one_splat(**big)
    image = render_gaussians(cloud_of(covering, device), camera)
    assert image.alpha.numpy().min() > 0.45


def test_near_and_far_planes(device: str) -> None:
    values = random_scene(200, seed=8)
    camera = camera_of(near=2.6, far=3.4)
    image = render_gaussians(cloud_of(values, device), camera)
    assert_same(image, render_twin(values, camera))
    depth = image.depth.numpy()[image.alpha.numpy() > 0.01]
    assert 2.6 <= depth.min() < depth.max() <= 3.4


def test_median_depth_and_normal(device: str) -> None:
    values = random_scene(200, seed=11)
    camera = camera_of()
    image = render_gaussians(cloud_of(values, device), camera, geometry=True)
    twin = render_twin(values, camera)
    assert image.normal is not None and image.median_depth is not None
    assert np.abs(image.normal.numpy() - twin["normal"]).mean() < 1e-5
    # A rounding error of the transmittance can move the median to the next splat in a few pixels.
    assert (np.abs(image.median_depth.numpy() - twin["median_depth"]) > 1e-4).mean() < 2e-3
    assert (image.median_depth.numpy() > 0).mean() > 0.2


def test_tiles_left_out_show_the_background(device: str) -> None:
    cloud, camera = cloud_of(random_scene(200), device), camera_of(70, 40)
    mask = np.array([[1, 0, 1, 0, 1], [0, 1, 0, 1, 0], [1, 1, 0, 0, 1]], bool)
    pixels = np.kron(mask, np.ones((16, 16), bool))[:40, :70]
    whole = render_gaussians(cloud, camera, background=(0.1, 0.5, 0.2), geometry=True)
    part = render_gaussians(cloud, camera, background=(0.1, 0.5, 0.2), geometry=True, mask=mask)
    behind = np.array([0.1, 0.5, 0.2], np.float32)
    assert np.array_equal(part.colour.numpy(), np.where(pixels[:, :, None], whole.colour.numpy(), behind))
    assert whole.median_depth is not None and part.median_depth is not None
    assert whole.normal is not None and part.normal is not None
    assert np.array_equal(part.median_depth.numpy(), np.where(pixels, whole.median_depth.numpy(), 0.0))
    assert np.array_equal(part.normal.numpy(), np.where(pixels[:, :, None], whole.normal.numpy(), 0.0))
    assert (whole.alpha.numpy()[~pixels] > 0).any()


def test_several_cameras_and_inconsistent_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = cloud_of(random_scene(50))
    cameras = [camera_of(20, 30), camera_of(40, 10)]
    images = render_views(cloud, cameras, background=(0, 0, 0))
    for camera, image in zip(cameras, images, strict=True):
        assert np.array_equal(
            image.colour.numpy(), render_gaussians(cloud, camera, background=(0, 0, 0)).colour.numpy()
        )

    behind = [(0.1, 0.2, 0.3), np.full((10, 40, 3), 0.5)]
    for camera, back, image in zip(cameras, behind, render_views(cloud, cameras, backgrounds=behind), strict=True):
        assert np.array_equal(image.colour.numpy(), render_gaussians(cloud, camera, background=back).colour.numpy())
    with pytest.raises(UserError, match=r"^render: 1 backgrounds for 2 cameras; give one for each$"):
        render_views(cloud, cameras, backgrounds=behind[:1])
    message = "render: 2 backgrounds for 2 cameras and one background for all; give one for each"
    with pytest.raises(UserError, match=f"^{message}$"):
        render_views(cloud, cameras, backgrounds=behind, background=(0, 0, 0))

    def no_memory(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes on device 'cpu'")

    monkeypatch.setattr("egs_warp.render.compositing.build_tile_lists", no_memory)
    with pytest.raises(
        UserError, match=r"^render: 50 Gaussians at 20 x 30 do not fit into the memory of cpu; render a"
    ):
        render_gaussians(cloud, cameras[0])


@pytest.mark.cuda
def test_a_full_gpu_reports_an_error_and_recovers() -> None:
    """The 240 million pairs of tiles and Gaussians would need 8 GB, of which only 600 MB are free."""
    torch = pytest.importorskip("torch")
    values = random_scene(200_000, coefficients=1, log_scale=3.0)
    values["opacity_logits"][:] = 2.0
    values["means"] += [0.0, 0.0, 3.0]
    cloud, camera = cloud_of(values, "cuda:0"), camera_of(640, 480)
    free, _ = torch.cuda.mem_get_info()
    hog = torch.empty(free - 600_000_000, dtype=torch.uint8, device="cuda")
    with pytest.raises(
        UserError, match=r"^render: 200000 Gaussians at 640 x 480 do not fit into the memory of cuda:0; "
    ):
        render_gaussians(cloud, camera)
    del hog
    torch.cuda.empty_cache()
    small = random_scene(300)
    assert_same(render_gaussians(cloud_of(small, "cuda:0"), camera_of()), render_twin(small, camera_of()))


def test_rotating_the_object_equals_rotating_the_camera(device: str) -> None:
    values = random_scene(300, coefficients=1, seed=4)
    camera = camera_of()
    turn = rotation_matrices(np.array([[0.8, 0.3, -0.4, 0.2]]))[0]
    w, x, y, z = np.array([0.8, 0.3, -0.4, 0.2]) / np.linalg.norm([0.8, 0.3, -0.4, 0.2])
    left_product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    turned = values | {"means": values["means"] @ turn.T, "rotations": values["rotations"] @ left_product.T}
    turned_camera = Camera(**{**camera.__dict__, "rotation": camera.rotation @ turn.T})
    one, other = (
        render_gaussians(cloud_of(values, device), camera),
        render_gaussians(cloud_of(turned, device), turned_camera),
    )
    off = np.abs(one.colour.numpy() - other.colour.numpy())
    assert off.mean() < 1e-5
    assert (off > 1e-4).mean() < 2e-3


def test_depth_of_a_half_opaque_plane_is_the_planes_depth(device: str) -> None:
    """Eq. (18): the depth of flat, half-opaque splats in the plane z = 0, viewed obliquely, is that of the plane."""
    grid = np.stack(np.meshgrid(np.arange(-4, 4, 0.05), np.arange(-4, 4, 0.05)), -1).reshape(-1, 2)
    count = len(grid)
    values = {
        "means": np.column_stack([grid, np.zeros(count)]),
        "rotations": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.tile(np.log([0.03, 0.03, 1e-4]), (count, 1)),
        "opacity_logits": np.full(count, -1.0),
        "sh": np.zeros((count, 1, 3)),
    }
    camera = Camera.look_at(np.array([0.5, -1.5, 3.0]), np.zeros(3), np.array([0, 0, 1.0]), width=64, height=48)
    image = render_gaussians(cloud_of(values, device), camera)
    alpha, depth = image.alpha.numpy(), image.depth.numpy()
    py, px = np.mgrid[:48, :64] + 0.5
    rays = (
        np.stack([(px - camera.cx) / camera.fx, (py - camera.cy) / camera.fy, np.ones_like(px)], -1) @ camera.rotation
    )
    expected = -camera.centre[2] / rays[..., 2]
    assert 0.3 < alpha.mean() < 0.8
    np.testing.assert_allclose(depth, expected, rtol=4e-3)


def test_sh_signs_follow_the_inria_convention(device: str) -> None:
    """Each coefficient alone gives the expected colour in a known direction."""
    camera = camera_of(9, 9)
    direction = (-EYE / np.linalg.norm(EYE))[None]
    basis = sh_basis(direction)[0]
    for k in range(16):
        sh = np.zeros((1, 16, 3))
        sh[0, k] = 0.5
        values = one_splat(sh=sh, opacity_logits=[100.0], log_scales=[[3.0] * 3])
        centre = render_gaussians(cloud_of(values, device), camera, background=(0, 0, 0)).colour.numpy()[4, 4, 0]
        assert centre == pytest.approx(max(0.5 + 0.5 * basis[k], 0) * 0.999, abs=2e-4), k


def test_threads_and_repeats_change_no_bit() -> None:
    values = random_scene(400, seed=6)
    cloud, camera = cloud_of(values), camera_of(150, 130)
    first = render_gaussians(cloud, camera, threads=1)
    for threads in (1, 2, 3):
        again = render_gaussians(cloud, camera, threads=threads)
        for name in ("colour", "alpha", "depth"):
            assert np.array_equal(getattr(first, name).numpy(), getattr(again, name).numpy())


@pytest.mark.cuda
def test_cuda_repeats_change_no_bit_and_match_the_cpu() -> None:
    values = random_scene(2000, seed=6)
    camera = camera_of(150, 130)
    first, again = (render_gaussians(cloud_of(values, "cuda:0"), camera) for _ in range(2))
    assert np.array_equal(first.colour.numpy(), again.colour.numpy())
    cpu = render_gaussians(cloud_of(values), camera)
    assert_same(first, {name: getattr(cpu, name).numpy() for name in ("colour", "alpha", "depth")})


def test_non_finite_gaussians_are_rejected_by_name(device: str) -> None:
    for name in ("means", "rotations", "log_scales", "opacity_logits", "sh"):
        cloud = cloud_of(random_scene(10), device)
        values = getattr(cloud, name).numpy()
        values[7] = np.nan
        broken = GaussianCloud(
            **{**cloud.__dict__, name: wp.array(values, dtype=getattr(cloud, name).dtype, device=device)}
        )
        with pytest.raises(UserError, match=f"^render: {name} of Gaussian 7 is not finite; repair or remove it$"):
            render_gaussians(broken, camera_of())


def test_impossible_cameras_and_backgrounds_are_refused() -> None:
    cloud = cloud_of(one_splat())
    with pytest.raises(UserError, match="width 0: give a whole number of at least 1"):
        render_gaussians(cloud, Camera(**{**camera_of().__dict__, "width": 0}))
    with pytest.raises(UserError, match=r"near 2\.0: give a distance below far, 1"):
        render_gaussians(cloud, camera_of(near=2.0, far=1.0))
    with pytest.raises(UserError, match="fx nan: give a number above 0"):
        render_gaussians(cloud, Camera(**{**camera_of().__dict__, "fx": float("nan")}))
    with pytest.raises(UserError, match=r"an image of 45 x 67 x 3, not shape \(3, 3\)"):
        render_gaussians(cloud, camera_of(), background=np.ones((3, 3)))


@pytest.mark.parametrize("spread", [1.0, 1e-5])
def test_sorted_lists_equal_counted_ones(spread: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sorting (GPU) and counting (CPU) give the same Gaussians in the same order for each tile; Gaussians of equal
    depth are ordered by index. With a spread of 1e-5, hundreds of Gaussians of each tile share the leading depth bits
    of the key.
    """
    values = random_scene(3000, coefficients=1, seed=12)
    camera = camera_of(200, 150)
    local = values["means"] * [1.0, 1.0, spread] + [0.0, 0.0, 3.0]
    local[::3, 2] = 3.0
    values["means"] = (local - camera.translation) @ camera.rotation
    cloud, view = cloud_of(values), view_from_camera(camera)
    projected = project(cloud, view, antialiased=False, threads=1)
    tiles = 13 * 10
    counted = [_lists_by_counting(projected, view, tiles, threads) for threads in (1, 2, 3)]
    pairs = projected.slot_count
    # Three cases: no guess of the capacity, a guess that is large enough, and a guess that is too small.
    monkeypatch.setattr("egs_warp.render.tiles._expected", {"cpu": pairs})
    guessed = _lists_by_sorting(projected, view, tiles, guess=True)
    assert lists_fit(guessed, projected) and len(guessed.gaussian_from_intersection) > pairs
    lists = [_lists_by_sorting(projected, view, tiles), guessed, *counted]
    monkeypatch.setattr("egs_warp.render.tiles._expected", {"cpu": pairs // 2})
    missed = _lists_by_sorting(projected, view, tiles, guess=True)
    assert not lists_fit(missed, projected) and (missed.tile_start.numpy() == 0).all()
    assert len(_lists_by_sorting(projected, view, tiles, guess=True).gaussian_from_intersection) >= pairs
    assert lists[0].tile_start.numpy()[-1] == pairs > 10_000
    for other in lists[1:]:
        assert np.array_equal(lists[0].tile_start.numpy(), other.tile_start.numpy())
        for name in ("gaussian_from_intersection", "slot_from_intersection"):
            assert np.array_equal(getattr(lists[0], name).numpy()[:pairs], getattr(other, name).numpy()[:pairs])
    order = np.asarray(lists[0].gaussian_from_intersection.numpy()[:pairs], np.int32)
    depth = projected.colour_depth.numpy()[order, 3]
    inner = np.setdiff1d(np.arange(1, pairs), np.asarray(lists[0].tile_start.numpy(), np.int64))
    assert (depth[inner] >= depth[inner - 1]).all()
