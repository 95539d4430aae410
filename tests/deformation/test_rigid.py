"""Transform of a capture to the frame of its body, with shapes, sizes and colours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from tests.support.deformation_scenes import covariances


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_shapes_rotate_and_scale_with_the_frame(degree: int) -> None:
    """Covariances become s^2 A C A^T and means s A (m - o), with the axes A, origin o and scale s of the frame; the
    same colour is seen from the same side."""
    random = np.random.default_rng(3)
    count = 40
    cloud = GaussianCloud.from_numpy(
        random.normal(size=(count, 3)),
        random.normal(size=(count, 4)),
        random.uniform(-4.0, -1.0, (count, 3)),
        random.normal(size=count),
        random.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    axes = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    frame = BodyFrame(axes, np.array([0.3, -0.2, 0.5]), 1.7)
    moved = to_body_frame(cloud, frame)
    expected = 1.7**2 * axes @ covariances(cloud) @ axes.T
    np.testing.assert_allclose(covariances(moved), expected, rtol=2e-5, atol=1e-7 * np.abs(expected).max())
    means = cloud.means.numpy().astype(np.float64)
    np.testing.assert_allclose(moved.means.numpy(), frame.points(means), atol=1e-5)
    np.testing.assert_array_equal(moved.opacity_logits.numpy(), cloud.opacity_logits.numpy())
    np.testing.assert_allclose(moved.sh.numpy()[:, 0], cloud.sh.numpy()[:, 0], atol=1e-6)
    if degree:
        # The coefficients of band 1 are a vector in the order y, z, x, which rotates as directions do.
        before, after = (one.sh.numpy()[:, 1:4].astype(np.float64)[:, [2, 0, 1]] for one in (cloud, moved))
        signs = np.array([-1.0, -1.0, 1.0])[:, None]
        np.testing.assert_allclose(signs * after, np.einsum("ij,njc->nic", axes, signs * before), atol=1e-5)
