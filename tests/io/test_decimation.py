"""Decimation, which preserves the mean, the spread and the colour of a capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.decimation import decimated
from tests.support.captures import assert_same_bits, make_cloud


def test_a_pair_becomes_the_gaussian_with_its_moments() -> None:
    """Two Gaussians of equal weight are one unit apart along x, so the variance of their means, 1/4, is added to their
    own variance."""
    pair = GaussianCloud.from_numpy(
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        np.log(np.tile([0.3, 0.3, 0.1], (2, 1))),
        np.zeros(2),
        np.array([[[0.0, 0.2, 0.4]], [[1.0, 0.2, 0.0]]]),
    )
    merged, moved = decimated(pair, 1)
    np.testing.assert_allclose(merged.means.numpy(), [[0.5, 0.0, 0.0]], atol=1e-6)
    expected = np.sqrt([0.1**2, 0.3**2, 0.3**2 + 0.25])
    np.testing.assert_allclose(np.sort(np.exp(merged.log_scales.numpy()[0])), expected, rtol=1e-5)
    np.testing.assert_allclose(merged.sh.numpy(), [[[0.5, 0.2, 0.2]]], atol=1e-6)
    # The opacity is twice the weight of one Gaussian, 0.5 x 0.3 x 0.3, divided by the larger area.
    np.testing.assert_allclose(merged.opacities(), [2.0 * 0.5 * 0.09 / (expected[1] * expected[2])], rtol=1e-5)
    assert moved == pytest.approx(0.5)


def test_the_result_has_the_number_and_the_moments() -> None:
    cloud = make_cloud(2000, 1)
    # The Gaussians are so faint that no merged Gaussian would need an opacity above 1.
    faint = wp.array(cloud.opacity_logits.numpy() - 8.0, dtype=wp.float32, device="cpu")
    cloud = replace(cloud, opacity_logits=faint)
    fewer, moved = decimated(cloud, 300)
    assert fewer.count == 300 and fewer.sh_degree == 1

    def weights(part: GaussianCloud) -> np.ndarray:
        scales = np.sort(np.exp(part.log_scales.numpy().astype(float)), axis=1)
        return part.opacities() * scales[:, 1] * scales[:, 2]

    for before, after in ((cloud.means, fewer.means), (cloud.sh, fewer.sh)):
        mean = np.average(before.numpy().reshape(2000, -1), axis=0, weights=weights(cloud))
        np.testing.assert_allclose(
            np.average(after.numpy().reshape(300, -1), axis=0, weights=weights(fewer)), mean, atol=2e-3
        )
    assert 0.0 < moved < 1.0
    same, nothing = decimated(cloud, 2000)
    assert_same_bits(same, cloud)
    assert nothing == 0.0
