"""Objectives: their rows against differences of the quantity they name."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.body import make_body
from egs_warp.objectives import centre_of_mass_velocity, node_velocities
from egs_warp.plane import Plane
from tests.meshes import block_mesh

BODY = make_body(block_mesh(), Plane(np.array([0.0, 0.0, 1.0]), 0.0), device="cpu")


def test_centre_of_mass_rows_are_the_rate_of_the_centre_of_mass() -> None:
    """Rows v = d(com)/dt by a difference of positions moved along v."""
    rng = np.random.default_rng(0)
    x, v, h = BODY.mesh.nodes, rng.standard_normal(BODY.mesh.nodes.shape), 1e-3
    objective = centre_of_mass_velocity(BODY, np.array([1.0, 2.0, 3.0]), 0.7)
    rate = (BODY.centre_of_mass(x + h * v) - BODY.centre_of_mass(x - h * v)) / (2 * h)
    assert np.allclose(objective.rows @ v.ravel(), rate, atol=1e-10)
    assert objective.target.tolist() == [1.0, 2.0, 3.0] and objective.weight == 0.7


def test_node_rows_measure_the_mass_weighted_distance_from_the_target() -> None:
    """|rows v - target|^2 = sum m_i |v_i - target_i|^2 / m, its gradient by differences."""
    rng = np.random.default_rng(1)
    v, target, along = rng.standard_normal((3, *BODY.mesh.nodes.shape))
    objective = node_velocities(BODY, target, 1.0)

    def cost(velocities: np.ndarray) -> float:
        return float(((objective.rows @ velocities.ravel() - objective.target) ** 2).sum())

    assert cost(v) == pytest.approx((BODY.node_mass[:, None] * (v - target) ** 2).sum() / BODY.mass)
    gradient = 2.0 * objective.rows.T @ (objective.rows @ v.ravel() - objective.target)
    slope = (cost(v + 1e-4 * along) - cost(v - 1e-4 * along)) / 2e-4
    assert slope == pytest.approx(gradient @ along.ravel(), rel=1e-8)
