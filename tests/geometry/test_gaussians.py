"""Selection of Gaussians that are hidden below a plane, and of the most visible ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import GaussianCloud, cut_at, hidden_below, most_visible
from egs_warp.geometry.plane import Plane


def test_what_lies_below_a_plane_is_hidden_and_stays_in_its_place() -> None:
    heights = np.array([0.5, -0.5, -0.005, 0.0, -0.02])
    cloud = GaussianCloud.from_numpy(
        np.column_stack([np.zeros((5, 2)), heights + 1.0]),
        np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
        np.full((5, 3), -5.0),
        np.full(5, 2.0),
        np.zeros((5, 1, 3)),
    )
    hidden = hidden_below(cloud, Plane(np.eye(3)[2], -1.0), margin=0.01)
    np.testing.assert_array_equal(hidden.opacities() < 1.0 / 255.0, [False, True, False, False, True])
    np.testing.assert_array_equal(hidden.means.numpy(), cloud.means.numpy())
    assert hidden_below(cloud, Plane(np.eye(3)[2], 0.5), margin=0.01) is cloud


def test_gaussians_that_reach_far_below_a_plane_are_hidden() -> None:
    """A Gaussian is hidden if at least a third of its mass is below the plane. A Gaussian with its mean on the plane is
    hidden if it is upright, but not if it lies in the plane.
    """
    half = np.sqrt(0.5)
    cloud = GaussianCloud.from_numpy(
        np.column_stack([np.zeros((4, 2)), [0.0, 0.0, 0.04, 0.08]]),
        np.array([[1.0, 0.0, 0.0, 0.0], [half, 0.0, half, 0.0], [half, 0.0, half, 0.0], [half, 0.0, half, 0.0]]),
        np.tile(np.log([0.15, 0.01, 0.01]), (4, 1)),
        np.full(4, 2.0),
        np.zeros((4, 1, 3)),
    )
    hidden = hidden_below(cloud, Plane(np.eye(3)[2], 0.0), margin=0.01)
    np.testing.assert_array_equal(hidden.opacities() < 1.0 / 255.0, [False, True, True, False])


def test_a_cut_gaussian_has_the_moments_of_its_part_above_the_plane() -> None:
    """Results are compared with 400,000 samples; Gaussians away from the plane keep their bits."""
    plane = Plane(np.array([0.0, 0.6, 0.8]), -0.1)
    rotation = Rotation.from_rotvec([0.3, -0.8, 0.5])
    quaternion = rotation.as_quat()[[3, 0, 1, 2]]
    scales = np.array([0.3, 0.05, 0.12])
    means = np.array([[0.1, 0.05, 0.2], [0.0, 0.0, 5.0], [0.0, 0.0, -5.0]])
    cloud = GaussianCloud.from_numpy(
        means, np.tile(quaternion, (3, 1)), np.tile(np.log(scales), (3, 1)), np.full(3, 1.0), np.zeros((3, 1, 3))
    )
    cut = cut_at(cloud, plane)
    np.testing.assert_array_equal(cut.means.numpy()[1:], cloud.means.numpy()[1:])
    np.testing.assert_array_equal(cut.opacity_logits.numpy()[1:], cloud.opacity_logits.numpy()[1:])
    samples = means[0] + (np.random.default_rng(0).normal(size=(400_000, 3)) * scales) @ rotation.as_matrix().T
    above = samples[plane.heights(samples) > 0.0]
    assert 0.1 < len(above) / len(samples) < 0.9
    np.testing.assert_allclose(cut.means.numpy()[0], above.mean(axis=0), atol=1e-3)
    axes = Rotation.from_quat(cut.rotations.numpy()[0, [1, 2, 3, 0]]).as_matrix() * np.exp(cut.log_scales.numpy()[0])
    np.testing.assert_allclose(axes @ axes.T, np.cov(above.T), atol=2e-4)
    assert cut.opacities()[0] / cloud.opacities()[0] == pytest.approx(len(above) / len(samples), abs=3e-3)
    assert cut_at(cloud, Plane(plane.normal, 2.0)) is cloud


def test_the_most_visible_are_wide_and_opaque_and_keep_their_order() -> None:
    """Visibility is opacity times area, so a long needle counts as much as a small disc. A logit of -800 gives the
    opacity 0 without overflow."""
    scales = np.log([[0.3, 0.3, 0.01], [0.4, 0.4, 0.01], [9.0, 0.01, 0.01], [0.5, 0.5, 0.5], [1.0, 1.0, 1.0]])
    cloud = GaussianCloud.from_numpy(
        np.arange(15.0).reshape(5, 3),
        np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
        scales,
        np.array([9.0, 9.0, 9.0, -1.0, -800.0]),
        np.zeros((5, 1, 3)),
    )
    assert most_visible(cloud, 3).means.numpy()[:, 0].tolist() == [0.0, 3.0, 6.0]
    assert most_visible(cloud, 4).means.numpy()[:, 0].tolist() == [0.0, 3.0, 6.0, 9.0]
    assert most_visible(cloud, 5) is cloud


def test_the_visible_gaussians_have_at_least_half_of_the_total_opacity() -> None:
    def visible(opacities: list[float], opacity: float) -> list[bool]:
        values, count = np.array(opacities), len(opacities)
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        logits = np.log(values / (1.0 - values))
        cloud = GaussianCloud.from_numpy(
            np.zeros((count, 3)), turns, np.zeros((count, 3)), logits, np.zeros((count, 1, 3))
        )
        return cloud.visible(opacity).tolist()

    assert visible([0.9, 0.2, 0.5, 0.31], 0.3) == [True, False, True, True]
    assert visible([0.02, 0.04, 0.05, 0.03, 0.06], 0.3) == [False, False, True, False, True]
    assert visible([0.02, 0.04, 0.05, 0.03, 0.06], 0.035) == [False, True, True, False, True]
