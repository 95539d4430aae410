"""Settling of a body: its unloaded shape is chosen so that its weight deforms it into the captured shape."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.locomotion.settling import SHAPE_TOLERANCE, _anderson_iterate, settle, settle_as_captured
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import box_mesh
from tests.support.stances import FORWARD


@pytest.fixture(scope="module")
def soft_column() -> CoarseCreature:
    """Create a column that leans by 0.2 of its height and is twice as soft as the default."""
    mesh = box_mesh((2, 2, 4), (0.5, 0.5, 1.0))
    mesh.nodes[:, 0] += 0.2 * mesh.nodes[:, 2]
    return coarse_creature(mesh, forward=FORWARD, sag=0.1, settle_first=False)


def test_the_resting_body_has_the_captured_shape(soft_column: CoarseCreature) -> None:
    body = soft_column.stepper.body
    sagged = settle(soft_column.stepper)
    assert np.linalg.norm(sagged.positions - body.mesh.nodes, axis=1).max() > 0.05 * body.height
    stepper, start, error = settle_as_captured(soft_column.stepper, sagged)
    assert error <= SHAPE_TOLERANCE
    assert np.linalg.norm(start.positions - body.mesh.nodes, axis=1).max() <= SHAPE_TOLERANCE * body.height
    np.testing.assert_array_equal(stepper.body.mesh.nodes, body.mesh.nodes)
    np.testing.assert_array_equal(stepper.body.node_mass, body.node_mass)
    assert not np.array_equal(stepper.body.assembly.mesh.nodes, body.mesh.nodes)


def test_the_forces_on_the_captured_shape_balance(soft_column: CoarseCreature) -> None:
    """Elastic force and weight balance at each node above the base; the sum over all nodes is the weight of the body,
    which the contact carries at the base."""
    stepper, start, _ = settle_as_captured(soft_column.stepper, settle(soft_column.stepper))
    body = stepper.body
    force = -body.assembly.gradient(start.positions) + body.node_mass[:, None] * body.gravity
    is_free = body.mesh.nodes[:, 2] > 0.1 * body.height
    assert np.abs(force[is_free]).max() < 1e-3 * body.weight
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, -body.weight], atol=1e-9 * body.weight)
    np.testing.assert_allclose(body.assembly.gradient(body.assembly.mesh.nodes), 0.0, atol=1e-9 * body.weight)


def test_anderson_acceleration_solves_a_diverging_linear_iteration() -> None:
    """The plain iteration x <- x - A x diverges because A has an eigenvalue above 2; with acceleration, a problem of
    two unknowns is solved in three iterations."""
    matrix = np.array([[3.0, 0.4], [0.1, 0.5]])
    points = [np.array([[1.0, 1.0]])]
    residuals = [points[0] @ matrix.T]
    for _ in range(3):
        points.append(_anderson_iterate(points[-3:], residuals[-3:]))
        residuals.append(points[-1] @ matrix.T)
    np.testing.assert_allclose(points[-1], 0.0, atol=1e-12)
