"""Velocities of a rotation as cross products."""

import numpy as np

from egs_warp.geometry.frames import cross_matrices


def test_rotation_velocity_is_the_cross_product_with_each_axis() -> None:
    """The velocities are v = w x r for any angular velocity w."""
    random = np.random.default_rng(0)
    arms, spin = random.normal(size=(7, 3)), random.normal(size=3)
    np.testing.assert_allclose(cross_matrices(arms) @ spin, np.cross(spin, arms), rtol=0, atol=1e-15)
