"""Captures of boxes."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.assets.box import box_cloud
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import SH_BAND_0


def test_box_is_covered_by_flat_gaussians() -> None:
    """Each side has one Gaussian for each square of the spacing, flat along the normal of the side, and the paint gets
    points relative to the middle of the box."""
    size, spacing = np.array([0.6, 0.4, 0.2]), 0.1

    def paint(points: np.ndarray) -> np.ndarray:
        return 0.5 + points / 2.0

    cloud = box_cloud((0.6, 0.4, 0.2), paint, spacing=spacing, device="cpu")
    means, scales = cloud.means.numpy(), np.exp(cloud.log_scales.numpy())
    middle = means - [0.0, 0.0, 0.1]
    on_side = np.isclose(np.abs(middle), 0.5 * size, atol=1e-6)
    assert (on_side.sum(axis=1) == 1).all()
    assert on_side.sum(axis=0).tolist() == [2 * 4 * 2, 2 * 6 * 2, 2 * 6 * 4]
    np.testing.assert_allclose(scales, np.where(on_side, 0.05 * spacing, 0.6 * spacing), rtol=1e-5)
    np.testing.assert_allclose(cloud.sh.numpy()[:, 0], middle / 2.0 / SH_BAND_0, atol=1e-6)
    assert len(np.unique(means.round(4), axis=0)) == cloud.count


def test_edges_that_are_no_multiples_of_the_spacing_are_covered_evenly() -> None:
    cloud = box_cloud((0.03, 0.05, 0.04), lambda points: (0.5, 0.5, 0.5), spacing=0.02, device="cpu")
    middle, scales = cloud.means.numpy() - [0.0, 0.0, 0.02], np.exp(cloud.log_scales.numpy())
    top = middle[:, 2] > 0.0199
    np.testing.assert_allclose(np.unique(middle[top, 0]), [-0.0075, 0.0075], atol=1e-8)
    np.testing.assert_allclose(np.unique(middle[top, 1]), [-0.05 / 3.0, 0.0, 0.05 / 3.0], atol=1e-8)
    np.testing.assert_allclose(scales[top], np.tile([0.6 * 0.015, 0.6 * 0.05 / 3.0, 0.001], (6, 1)), rtol=1e-5)


def test_one_colour() -> None:
    cloud = box_cloud((0.2, 0.2, 0.2), lambda points: (1.0, 0.5, 0.0), spacing=0.1, device="cpu")
    np.testing.assert_allclose(cloud.sh.numpy()[:, 0] * SH_BAND_0, np.tile([0.5, 0.0, -0.5], (24, 1)), atol=1e-6)


@pytest.mark.parametrize("spacing", [0.0, 0.3])
def test_spacing_that_does_not_fit(spacing: float) -> None:
    with pytest.raises(
        UserError, match=f"spacing {spacing}: choose a positive spacing of at most the smallest edge, 0.2 m"
    ):
        box_cloud((0.6, 0.4, 0.2), lambda points: (0.5, 0.5, 0.5), spacing=spacing, device="cpu")
