"""Measures of an inpainted floor besides PSNR: detail, similarity after a blur, and the shifted true floor."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from scipy import ndimage

from egs_warp.training.metrics import psnr
from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def measures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("floor_measures")


def disc(size: int, radius: float) -> np.ndarray:
    y, x = np.indices((size, size)) - size / 2 + 0.5
    return x**2 + y**2 < radius**2


def noise(size: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(size, size, 3))


def test_detail_is_one_for_independent_noise_and_small_after_a_blur(measures: ModuleType) -> None:
    """Two images of white noise have the same gradient energy; pixels outside the mask do not count."""
    truth, mask = noise(96, 0), disc(96, 36)
    assert measures.gradient_energy(noise(96, 1), truth, mask) == pytest.approx(1.0, abs=0.05)
    blurred = ndimage.gaussian_filter(truth, (2.0, 2.0, 0.0))
    assert measures.gradient_energy(blurred, truth, mask) < 0.1
    assert measures.gradient_energy(np.where(mask[..., None], truth, 0.0), truth, mask) == 1.0


def test_psnr_prefers_the_blurred_image_and_coarse_psnr_does_not(measures: ModuleType) -> None:
    """Compare an independent noise image and a constant image of the mean colour with the true noise.

    The independent noise has twice the squared error of the mean colour, so its PSNR is 3.01 dB lower. After a blur it
    agrees with the truth, while a wrong colour still differs.
    """
    truth, other, mask = noise(128, 0), noise(128, 1), disc(128, 50)
    mean = np.full_like(truth, 0.5)
    assert psnr(mean[mask], truth[mask]) - psnr(other[mask], truth[mask]) == pytest.approx(3.01, abs=0.1)
    assert measures.coarse_psnr(other, truth, mask) > 25.0
    assert measures.coarse_psnr(mean + 0.2, truth, mask) == pytest.approx(-20 * np.log10(0.2), abs=0.1)
    outside = np.where(mask[..., None], other, 7.0)
    assert measures.coarse_psnr(outside, truth, mask) == measures.coarse_psnr(other, truth, mask)


def test_shifted_true_floor_finds_its_period_and_no_more(measures: ModuleType) -> None:
    """Score shifted floors of stripes and of noise.

    A striped floor shifted by whole periods equals itself. Two independent noise images have a squared error of 1/6,
    which is 7.8 dB. A floor without known surroundings has no score.
    """
    hole, known = disc(120, 15), np.ones((120, 120), bool)
    stripes = np.repeat((np.arange(120) // 3 % 2)[None, :, None].astype(float), 120, axis=0).repeat(3, axis=2)
    best = max(one for one, _ in measures.moved_floor_scores(stripes, known, hole))
    assert best > 60.0
    scores = np.array(measures.moved_floor_scores(noise(120, 0), known, hole))
    assert len(scores) == 72
    assert scores[:, 0].mean() == pytest.approx(10 * np.log10(6.0), abs=0.2)
    assert measures.moved_floor_scores(stripes, hole, hole) == []
