"""Training loop, which recovers a known cloud, leaves fixed values unchanged, and is deterministic."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from tests.support.render_twin import rotation_matrices
from tests.support.training_views import ball, ring

torch = pytest.importorskip("torch")
from egs_warp.render import render_gaussians  # noqa: E402
from egs_warp.training.finetune import Densification, FinetuneOptions, finetune, render_views  # noqa: E402
from egs_warp.training.gaussian_tensors import MIN_LOG_SCALE  # noqa: E402
from egs_warp.training.metrics import psnr, ssim  # noqa: E402
from egs_warp.training.relocation import Population  # noqa: E402
from egs_warp.training.training_view import TrainingView  # noqa: E402


def mean_psnr(cloud: GaussianCloud, views: list[TrainingView]) -> float:
    return float(
        np.mean([psnr(np.clip(render_gaussians(cloud, v.camera).colour.numpy(), 0, 1), v.image) for v in views])
    )


def test_a_disturbed_capture_is_restored_from_its_own_renders() -> None:
    values = ball()
    views = render_views(GaussianCloud.from_numpy(**values, device="cpu"), ring())
    random = np.random.default_rng(1)
    disturbed = values | {
        "sh": values["sh"] + random.normal(0, 0.4, values["sh"].shape),
        "log_scales": values["log_scales"] + random.normal(0, 0.3, values["log_scales"].shape),
    }
    cloud = GaussianCloud.from_numpy(**disturbed, device="cpu")
    result = finetune(cloud, views, options=FinetuneOptions(iterations=150))
    assert mean_psnr(result.cloud, views) > mean_psnr(cloud, views) + 8.0
    assert result.losses[-20:].mean() < 0.4 * result.losses[:20].mean()
    np.testing.assert_allclose(np.linalg.norm(result.cloud.rotations.numpy(), axis=1), 1.0, atol=1e-6)


def test_training_repeats_to_the_bit() -> None:
    values = ball(60)
    views = render_views(GaussianCloud.from_numpy(**values, device="cpu"), ring(3, 32))
    options = FinetuneOptions(iterations=130, densification=Densification.RELOCATION, max_gaussians=80, seed=3)
    start = GaussianCloud.from_numpy(**ball(60, seed=5), device="cpu")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        first, second = (finetune(start, views, options=options) for _ in range(2))
    finally:
        torch.set_num_threads(threads)
    assert np.array_equal(first.losses, second.losses)
    assert np.array_equal(first.cloud.means.numpy(), second.cloud.means.numpy())
    assert 60 < first.cloud.count <= 80


def test_only_the_trainable_change_and_scales_stay_above_their_floor() -> None:
    values = ball(50)
    values["log_scales"][:, 2] = -14.0
    cloud = GaussianCloud.from_numpy(**values, device="cpu")
    views = render_views(GaussianCloud.from_numpy(**ball(50, seed=2), device="cpu"), ring(2))
    trainable = np.arange(50) < 20
    result = finetune(cloud, views, options=FinetuneOptions(iterations=10), trainable=trainable).cloud
    moved = np.any(result.means.numpy() != cloud.means.numpy(), axis=1)
    assert moved[:20].mean() > 0.9
    assert not moved[20:].any()
    assert np.array_equal(result.sh.numpy()[20:], cloud.sh.numpy()[20:])
    assert result.log_scales.numpy().min() >= MIN_LOG_SCALE


def test_an_extra_loss_and_pixel_weights_count() -> None:
    """If all pixels have zero weight, only the additional loss moves the means, which go towards the plane y = 0."""
    cloud = GaussianCloud.from_numpy(**ball(40), device="cpu")
    camera = ring(1)[0]
    blank = np.zeros((camera.height, camera.width), dtype=np.float32)
    view = TrainingView(camera, np.zeros((*blank.shape, 3), dtype=np.float32), weight=blank)
    options = FinetuneOptions(iterations=60)
    still = finetune(cloud, [view], options=options).cloud
    assert np.array_equal(still.means.numpy(), cloud.means.numpy())
    pulled = finetune(cloud, [view], options=options, extra_loss=lambda t: t.means[:, 1].abs().mean()).cloud
    assert np.abs(pulled.means.numpy()[:, 1]).mean() < np.abs(cloud.means.numpy()[:, 1]).mean()
    assert np.array_equal(pulled.means.numpy()[:, [0, 2]], cloud.means.numpy()[:, [0, 2]])


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_relocated_copies_look_like_the_original(copies: int) -> None:
    """Together, copies at the same position have the peak and the line integral of the original Gaussian."""
    opacity, scale = 0.8, 0.3
    tensors = {
        "means": torch.zeros(1, 3),
        "rotations": torch.tensor([[1.0, 0, 0, 0]]),
        "log_scales": torch.full((1, 3), float(np.log(scale))),
        "opacity_logits": torch.logit(torch.tensor([opacity])),
        "sh_band_0": torch.zeros(1, 1, 3),
        "sh_rest": torch.zeros(1, 0, 3),
    }
    population = Population(tensors, dict.fromkeys(tensors, 1e-3), extent=1.0, generator=torch.Generator())
    population._share(torch.zeros(copies, dtype=torch.long))
    number = copies + 1
    new = float(torch.sigmoid(tensors["opacity_logits"])[0])
    x = np.linspace(-3, 3, 20001)
    one = opacity * np.exp(-0.5 * (x / scale) ** 2)
    together = 1 - (1 - new * np.exp(-0.5 * (x / np.exp(float(tensors["log_scales"][0, 0]))) ** 2)) ** number
    assert together.max() == pytest.approx(opacity, rel=1e-4)
    assert together.sum() == pytest.approx(one.sum(), rel=1e-3)


def test_ssim_equals_scikit_images() -> None:
    """SSIM is the published index with a Gaussian window of sigma 1.5 and zeros outside the image, which scikit-image
    gets as padding.
    """
    from skimage.metrics import structural_similarity

    random = np.random.default_rng(0)
    a = random.uniform(size=(48, 56, 3)).astype(np.float32)
    b = np.clip(a + random.normal(0, 0.2, a.shape), 0, 1).astype(np.float32)
    rim = 6
    framed = [np.pad(image.astype(np.float64), ((rim, rim), (rim, rim), (0, 0))) for image in (a, b)]
    index = structural_similarity(
        *framed,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )[1]
    expected = index[rim:-rim, rim:-rim].mean()
    assert 0.5 < expected < 0.95
    assert float(ssim(torch.tensor(a), torch.tensor(b))) == pytest.approx(expected, abs=2e-6)
    assert float(ssim(torch.tensor(a).double(), torch.tensor(b).double())) == pytest.approx(expected, abs=2e-6)
    assert float(ssim(torch.tensor(a), torch.tensor(a))) == pytest.approx(1.0, abs=1e-6)


def test_the_noise_of_mcmc_has_the_covariance_of_the_shape_squared() -> None:
    """As in Kheradmand et al. 2024, the means move by 5e5 rate sigmoid(-100 (o - 0.005)) Sigma times a normal
    deviate."""
    count, rate, scales, turn = 40_000, 1e-7, np.array([0.8, 0.3, 0.1]), np.array([0.7, 0.2, -0.5, 0.4])
    opacities = np.array([0.001, 0.005, 0.02])
    tensors = {
        "means": torch.zeros(3 * count, 3),
        "rotations": torch.tensor(turn, dtype=torch.float32).repeat(3 * count, 1),
        "log_scales": torch.tensor(np.log(scales), dtype=torch.float32).repeat(3 * count, 1),
        "opacity_logits": torch.tensor(np.log(opacities / (1 - opacities)), dtype=torch.float32).repeat_interleave(
            count
        ),
    }
    population = Population(
        tensors, dict.fromkeys(tensors, rate), extent=1.0, generator=torch.Generator().manual_seed(1)
    )
    population.jitter(rate)
    axes = rotation_matrices(turn[None])[0]
    shape = axes @ np.diag(scales**2) @ axes.T
    for moved, opacity in zip(tensors["means"].numpy().astype(float).reshape(3, count, 3), opacities, strict=True):
        size = 5e5 * rate / (1 + np.exp(100 * (opacity - 0.005)))
        # In units of the Gaussian's shape, each component of the noise has the variance 1. The tolerance is four times
        # the sampling error, 1 / sqrt(count / 2).
        unit = moved @ np.linalg.inv(size * shape)
        np.testing.assert_allclose(unit.T @ unit / count, np.eye(3), atol=4 * np.sqrt(2 / count))


def test_bad_views_are_named() -> None:
    cloud = GaussianCloud.from_numpy(**ball(10), device="cpu")
    camera = ring(1)[0]
    image = np.zeros((40, 40, 3), dtype=np.float32)
    with pytest.raises(UserError, match="finetune: there are no views"):
        finetune(cloud, [])
    with pytest.raises(UserError, match=r"image of view 1 has shape \(8, 8, 3\), expected \(40, 40, 3\); resize"):
        finetune(cloud, [TrainingView(camera, image), TrainingView(camera, image[:8, :8])])
    with pytest.raises(UserError, match="image of view 0 has 4800 values that are not finite; correct it"):
        finetune(cloud, [TrainingView(camera, np.full_like(image, np.nan))])
    with pytest.raises(UserError, match=r"trainable has shape \(3,\), expected \(10,\)"):
        finetune(cloud, [TrainingView(camera, image)], trainable=np.ones(3, bool))
    with pytest.raises(UserError, match="give either trainable or a densification"):
        finetune(
            cloud,
            [TrainingView(camera, image)],
            trainable=np.ones(10, bool),
            options=FinetuneOptions(densification=Densification.RELOCATION),
        )


@pytest.mark.data
@pytest.mark.slow
def test_photos_become_a_capture(data_dir: Path) -> None:
    from egs_warp.pipelines.train_capture import train

    result = train(
        data_dir / "posed" / "lego", iterations=400, max_gaussians=6000, max_side=80, sh_degree=0, device="cpu"
    )
    held_out, trained_on = result.mean_score(held_out=True), result.mean_score(held_out=False)
    assert held_out is not None and trained_on is not None
    assert held_out.psnr > 23.0
    assert len(result.views) == len(result.scores) == 100
    assert sum(score.held_out for score in result.scores) == 13


def test_impossible_training_is_refused(tmp_path: Path) -> None:
    from egs_warp.pipelines.train_capture import train

    with pytest.raises(UserError, match="train: iterations=0, max_gaussians=50000, sh_degree=3; give at least 1"):
        train(tmp_path, iterations=0)
    (tmp_path / "transforms.json").write_text(
        '{"camera_angle_x": 0.7, "w": 8, "h": 8, "frames": [{"file_path": "r_0.png", '
        '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,3],[0,0,0,1]]}]}'
    )
    with pytest.raises(UserError, match=r"none of its 1 photos can be used; the first: r_0.png: the photo is not"):
        train(tmp_path)


@pytest.mark.example
def test_the_example_gives_the_pawn_its_colours_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    script = Path(__file__).parents[2] / "examples" / "finetune.py"
    monkeypatch.setattr("sys.argv", [str(script), "--out", str(tmp_path), "--steps", "12", "--size", "48"])
    runpy.run_path(str(script), run_name="__main__")
    quality = [float(line.split()[-2]) for line in capsys.readouterr().out.splitlines() if line.endswith("dB")]
    as_it_was, colours_lost, trained = quality
    assert as_it_was > 60.0
    assert trained > colours_lost + 1.0
    assert (tmp_path / "finetune.png").is_file()
