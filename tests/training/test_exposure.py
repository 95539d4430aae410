"""Training with real photos: estimation of exposures, exclusion of outlier views, and growth that ends when it has no
benefit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from egs_warp.geometry.gaussians import GaussianCloud
from tests.support.training_views import ball, ring

torch = pytest.importorskip("torch")
from egs_warp.training.finetune import FinetuneOptions, finetune, render_views  # noqa: E402
from egs_warp.training.growth import Growth  # noqa: E402
from egs_warp.training.metrics import match_tone  # noqa: E402
from egs_warp.training.outlier_views import is_outlier  # noqa: E402
from egs_warp.training.relocation import Population, _growth_factor  # noqa: E402


@pytest.mark.slow
def test_exposures_are_recovered_up_to_their_mean() -> None:
    """Six views of one ball have gains from 0.7 to 1.2 and a warm or cold tint. The estimated tones agree with the
    gains up to the mean gain, and the loss is at least 40 % lower than without tones."""
    random = np.random.default_rng(0)
    cloud = GaussianCloud.from_numpy(**ball(), device="cpu")
    gains = np.linspace(0.7, 1.2, 6)[:, None] * (1 + 0.1 * random.uniform(-1, 1, (6, 3)))
    views = [
        replace(view, image=(view.image * gain).astype(np.float32))
        for view, gain in zip(render_views(cloud, ring(), background=(0.0, 0.0, 0.0)), gains, strict=True)
    ]
    options = FinetuneOptions(iterations=360, background=(0.0, 0.0, 0.0), fit_exposure=True)
    result = finetune(cloud, views, options=options)
    assert result.tones is not None
    np.testing.assert_allclose(result.tones.mean(axis=0), np.eye(3, 4), atol=1e-5)
    # The effects of the tones on grey are compared.
    found = result.tones[:, :, :3].sum(axis=2)
    expected = gains / gains.mean(axis=0)
    assert np.abs(found - expected).max() < 0.16
    assert np.abs(found - expected).mean() < 0.3 * np.abs(expected - 1).mean()
    without = finetune(cloud, views, options=replace(options, fit_exposure=False))
    assert result.losses[-30:].mean() < 0.6 * without.losses[-30:].mean()


def test_an_affine_tone_is_removed_before_judging() -> None:
    random = np.random.default_rng(1)
    picture = random.uniform(size=(20, 30, 3)).astype(np.float32)
    mixing = np.eye(3) + 0.1 * random.normal(size=(3, 3))
    known = np.zeros((20, 30), bool)
    known[:, 5:] = True
    photo = (picture @ mixing + 0.07).astype(np.float32)
    photo[~known] = 9.0
    np.testing.assert_allclose(match_tone(photo, picture, known)[known], photo[known], atol=1e-5)


def test_a_loss_far_above_the_others_is_an_outlier() -> None:
    losses = np.random.default_rng(2).uniform(0.02, 0.035, 40)
    assert not is_outlier(losses).any()
    losses[7] = 0.15
    assert np.flatnonzero(is_outlier(losses)).tolist() == [7]
    # A few photos, or a gradual increase of the loss, are not enough to call a photo an outlier.
    assert not is_outlier(losses[5:11]).any()
    assert not is_outlier(np.geomspace(0.02, 0.1, 40)).any()


@pytest.mark.parametrize("requested", [None, 5000])
def test_growth_ends_without_benefit(requested: int | None) -> None:
    gaining, idle = Growth(10, requested, "cpu"), Growth(10, requested, "cpu")
    room = idle.cap
    for step in range(3000):
        count = int(1000 * 1.0005**step)
        gaining.see(1000.0 / count, count)
        idle.see(0.1, count)
    assert gaining.cap == room >= 5000
    assert idle.cap < 2000
    idle.restart()
    assert idle.cap == room


def test_regularization_and_jitter_equal_their_formulas() -> None:
    """The regularisation adds the derivatives of the mean opacity and the mean scale to the gradients; the jitter of a
    faint Gaussian is proportional to Sigma times a normal deviate."""
    count = 4000
    values = {
        "means": torch.zeros(count, 3),
        "rotations": torch.tensor([[0.9, 0.1, -0.3, 0.2]]).repeat(count, 1),
        "log_scales": torch.log(torch.tensor([[0.3, 0.1, 0.02]])).repeat(count, 1),
        "opacity_logits": torch.full((count,), -9.0),
        "sh_band_0": torch.zeros(count, 1, 3),
        "sh_rest": torch.zeros(count, 0, 3),
    }
    tensors = {name: value.clone().requires_grad_() for name, value in values.items()}
    generator = torch.Generator().manual_seed(0)
    population = Population(tensors, dict.fromkeys(tensors, 1e-4), extent=2.0, generator=generator)
    loss = 0.01 * (torch.sigmoid(tensors["opacity_logits"]).mean() + torch.exp(tensors["log_scales"]).mean() / 2.0)
    loss.backward()
    wanted = {name: tensors[name].grad.clone() for name in ("opacity_logits", "log_scales")}
    for name in wanted:
        tensors[name].grad.zero_()
    population.add_regularization()
    for name, gradient in wanted.items():
        torch.testing.assert_close(tensors[name].grad, gradient)
    with torch.no_grad():
        population.jitter(2e-4)
    w, x, y, z = (values["rotations"][0] / values["rotations"][0].norm()).tolist()
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    sigma = turn @ np.diag([0.09, 0.01, 0.0004]) @ turn.T
    gate = 1 / (1 + np.exp(100 * (1 / (1 + np.exp(9.0)) - 0.005)))
    # The scale of the noise is 5e5 times the learning rate of the means (1e-4 times the extent of 2), divided by the
    # squared extent, because covariances scale with it.
    size = 5e5 * 2e-4 / 4.0 * gate
    moved = tensors["means"].detach().numpy().astype(float)
    np.testing.assert_allclose(np.cov(moved.T), size**2 * sigma @ sigma, atol=0.08 * (size * 0.09) ** 2)


def test_the_number_of_gaussians_grows_by_the_same_factor_in_short_trainings() -> None:
    def grown(steps: int) -> float:
        """Return the factor by which the number of Gaussians grows in a training run that no cap limits."""
        return math.prod(_growth_factor(steps) for step in range(steps) if Population.is_relocation_due(step, steps))

    assert grown(7000) == pytest.approx(1.05**56)
    for steps in (1300, 2500, 5000):
        assert 0.9 < math.log(grown(steps)) / math.log(grown(7000)) < 1.05
    assert _growth_factor(30_000) == 1.05
