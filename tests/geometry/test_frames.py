"""Velocities of a rotation are cross products."""

import numpy as np

from egs_warp.geometry.frames import cross_matrices


def test_rotation_velocity_is_the_cross_product_with_each_axis() -> None:
    """v = w x r for any angular velocity."""
    random = np.random.default_rng(0)
    arms, spin = random.normal(size=(7, 3)), random.normal(size=3)
    np.testing.assert_allclose(cross_matrices(arms) @ spin, np.cross(spin, arms), rtol=0, atol=1e-15)
