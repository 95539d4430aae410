"""The first steps of a training run compare reduced images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.geometry.gaussians import GaussianCloud
from tests.support.training_views import ball, ring

pytest.importorskip("torch")
from egs_warp.training.finetune import Densification, FinetuneOptions, finetune, render_views
from egs_warp.training.growth import Growth
from egs_warp.training.metrics import psnr
from egs_warp.training.resolution import ResolutionSchedule


def test_images_become_finer_and_small_ones_are_not_reduced() -> None:
    cloud = GaussianCloud.from_numpy(**ball(20), device="cpu")
    large, small = (ResolutionSchedule(render_views(cloud, ring(2, side)), 100) for side in (256, 64))
    assert [large.factor(step) for step in (0, 9, 10, 29, 30, 99)] == [4, 4, 2, 2, 1, 1]
    assert large.factors == {1, 2, 4}
    assert small.factors == {1}
    assert small.factor(0) == 1
    # A schedule of zero steps has no reduced images.
    assert ResolutionSchedule(render_views(cloud, ring(1, 256)), 0).factors == {1}


def test_a_reduced_view_shows_the_same_scene() -> None:
    cloud = GaussianCloud.from_numpy(**ball(200), device="cpu")
    (view,) = render_views(cloud, ring(1, 128))
    reduced = view.reduced(2)
    assert reduced.image.shape == (64, 64, 3)
    (drawn,) = render_views(cloud, [reduced.camera])
    assert psnr(drawn.image, reduced.image) > 35.0


def test_transparent_pixels_do_not_tint_a_reduced_view() -> None:
    cloud = GaussianCloud.from_numpy(**ball(20), device="cpu")
    (view,) = render_views(cloud, ring(1, 8))
    image = np.zeros((8, 8, 3), np.float32)
    alpha = np.zeros((8, 8), np.float32)
    image[::2], alpha[::2] = 0.75, 0.5
    weight = np.ones((8, 8), np.float32)
    weight[0, 0] = 0.0
    reduced = replace(view, image=image, alpha=alpha, weight=weight).reduced(2)
    assert reduced.alpha is not None and reduced.weight is not None
    np.testing.assert_allclose(reduced.image, 0.75, atol=1e-6)
    np.testing.assert_allclose(reduced.alpha, 0.25)
    assert reduced.weight[0, 0] == 0.0
    assert reduced.weight.sum() == 15.0


def test_losses_of_different_resolutions_are_not_compared() -> None:
    growth = Growth(1, None, "cpu")
    for loss, count in ((0.2, 100), (0.3, 200), (0.4, 400)):
        for _ in range(300):
            growth.see(loss, count)
        growth.restart()
    assert growth.cap > 400


def test_growth_that_has_ended_continues_with_larger_images() -> None:
    growth = Growth(1, None, "cpu")
    limit = growth.cap
    for count in (100, 200, 400, 800):
        for _ in range(300):
            growth.see(0.2, count)
    assert growth.cap < limit
    growth.restart()
    assert growth.cap == limit


def test_a_training_that_starts_with_reduced_images_fits_the_full_ones() -> None:
    views = render_views(GaussianCloud.from_numpy(**ball(60), device="cpu"), ring(4, 128))
    start = GaussianCloud.from_numpy(**ball(60, seed=5), device="cpu")

    def error(cloud: GaussianCloud) -> float:
        drawn = render_views(cloud, [view.camera for view in views])
        return float(np.mean([np.abs(a.image - b.image).mean() for a, b in zip(drawn, views, strict=True)]))

    options = FinetuneOptions(iterations=60, densification=Densification.RELOCATION, max_gaussians=100)
    assert error(finetune(start, views, options=options).cloud) < 0.7 * error(start)
