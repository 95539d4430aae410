"""Rows of the objectives, compared with finite differences of the quantities that the objectives are named after."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, make_body
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import (
    WORLD,
    BodyPart,
    Coordinates,
    centre_of_mass_velocity,
    deformation_velocities,
    no_slip_contacts,
    node_velocities,
    part_angular_momentum,
    part_angular_velocity,
    part_nodes,
    part_shape,
    part_velocity,
)
from tests.support.meshes import block_mesh

BODY = make_body(block_mesh(), Plane(np.array([0.0, 0.0, 1.0]), 0.0), device="cpu")
HEIGHTS = BODY.mesh.nodes[:, 2]
PARTS = [BodyPart.whole(BODY), BodyPart.base(BODY, HEIGHTS), BodyPart.head(BODY, HEIGHTS)]
TURNED = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
FRAMES = [WORLD, Coordinates(TURNED, False), Coordinates(TURNED, True)]
NEAR = 1e-6
by_part = pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
by_frame = pytest.mark.parametrize("frame", FRAMES, ids=["world", "turned", "centre of mass"])


def shaken_state(seed: int = 3) -> BodyState:
    """Return the state of a bent body in motion."""
    rng = np.random.default_rng(seed)
    nodes = BODY.mesh.nodes
    return BodyState(nodes + 0.02 * rng.standard_normal(nodes.shape), rng.standard_normal(nodes.shape))


def rate_of(quantity: Callable[[np.ndarray], Any], state: BodyState, velocities: np.ndarray) -> np.ndarray:
    """Return the time derivative of ``quantity`` of the positions by a central difference along ``velocities`` (N, 3),
    m/s."""
    return (quantity(state.positions + NEAR * velocities) - quantity(state.positions - NEAR * velocities)) / (2 * NEAR)


def test_centre_of_mass_rows_are_the_rate_of_the_centre_of_mass() -> None:
    """The rows give the time derivative of the centre of mass, which is computed by a central difference along v."""
    rng = np.random.default_rng(0)
    x, v, h = BODY.mesh.nodes, rng.standard_normal(BODY.mesh.nodes.shape), 1e-3
    objective = centre_of_mass_velocity(BODY, np.array([1.0, 2.0, 3.0]), 0.7)
    rate = (BODY.centre_of_mass(x + h * v) - BODY.centre_of_mass(x - h * v)) / (2 * h)
    assert np.allclose(objective.rows @ v.ravel(), rate, atol=1e-10)
    assert objective.target.tolist() == [1.0, 2.0, 3.0] and objective.weight == 0.7


def test_node_rows_measure_the_mass_weighted_distance_from_the_target() -> None:
    """The squared error |rows v - target|^2 equals sum m_i |v_i - target_i|^2 / m, and its gradient equals finite
    differences."""
    rng = np.random.default_rng(1)
    v, target, along = rng.standard_normal((3, *BODY.mesh.nodes.shape))
    objective = node_velocities(BODY, target, 1.0)

    def cost(velocities: np.ndarray) -> float:
        return float(((objective.rows @ velocities.ravel() - objective.target) ** 2).sum())

    assert cost(v) == pytest.approx((BODY.node_mass[:, None] * (v - target) ** 2).sum() / BODY.mass)
    gradient = 2.0 * objective.rows.T @ (objective.rows @ v.ravel() - objective.target)
    slope = (cost(v + 1e-4 * along) - cost(v - 1e-4 * along)) / 2e-4
    assert slope == pytest.approx(gradient @ along.ravel(), rel=1e-8)


def test_strain_rows_measure_only_uniform_strain() -> None:
    """The objective of an affine motion is the mean square velocity of its non-rigid part; a rigid motion and a motion
    without uniform strain give zero."""
    rng = np.random.default_rng(4)
    state = shaken_state()
    target = rng.standard_normal(state.positions.shape)
    objective = deformation_velocities(BODY, state.positions, target, 0.3)
    assert objective.target.shape == (6,) and objective.weight == 0.3
    arms = state.positions - BODY.centre_of_mass(state.positions)
    mass = BODY.node_mass[:, None] / BODY.mass

    def square(velocities: np.ndarray) -> float:
        return float(((objective.rows @ velocities.ravel()) ** 2).sum())

    rigid = rng.standard_normal(3) + np.cross(rng.standard_normal(3), arms)
    assert square(rigid) < 1e-20
    affine = arms @ rng.standard_normal((3, 3)).T
    spin = np.linalg.solve(
        BODY.inertia(state.positions), (BODY.node_mass[:, None] * np.cross(arms, affine)).sum(axis=0)
    )
    strained = affine - np.cross(spin, arms)
    assert square(affine + rigid) == pytest.approx((mass * strained**2).sum(), rel=1e-10)
    assert np.allclose(objective.target, objective.rows @ target.ravel())
    # A motion that is orthogonal to all affine motions in the mass inner product gives zero.
    modes = np.eye(9).reshape(9, 3, 3)
    spanned = np.stack([(arms @ mode).ravel() for mode in modes] + [np.tile(a, len(arms)) for a in np.eye(3)], axis=1)
    weight = np.repeat(mass.ravel(), 3)
    fit = np.linalg.solve(spanned.T @ (weight[:, None] * spanned), spanned.T @ (weight * target.ravel()))
    assert square((target.ravel() - spanned @ fit).reshape(-1, 3)) < 1e-20


def place(part: BodyPart, frame: Coordinates, positions: np.ndarray) -> np.ndarray:
    """Return the centre of a part, computed as the objectives do."""
    origin = BODY.centre_of_mass(positions) if frame.relative else 0.0
    return frame.axes @ (part.centre(positions) - origin)


@by_part
@by_frame
def test_part_rows_are_the_rate_of_the_part_s_centre(part: BodyPart, frame: Coordinates) -> None:
    """The rows of a velocity objective equal finite differences."""
    state = shaken_state()
    v = np.random.default_rng(4).standard_normal(state.positions.shape)
    rate = rate_of(lambda x: place(part, frame, x), state, v)
    asked = np.array([0.1, 0.2, 0.3])
    velocity = part_velocity(BODY, part, asked, 2.0, frame)
    assert np.allclose(velocity.rows @ v.ravel(), rate, atol=1e-8)
    assert velocity.target.tolist() == asked.tolist() and velocity.weight == 2.0


@by_part
@by_frame
def test_momentum_rows_measure_the_angular_momentum(part: BodyPart, frame: Coordinates) -> None:
    """The rows give the sum of m (x - c) x (v - v_c) over the part, about the centre of the part or of the body, scaled
    to m/s; a rigid rotation gives the inertia times omega.
    """
    state = shaken_state()
    v = np.random.default_rng(5).standard_normal(state.positions.shape)
    origin = BODY.centre_of_mass if frame.relative else part.centre
    arms, speeds = ((x - origin(x))[part.nodes] for x in (state.positions, v))
    momentum = frame.axes @ (part.masses[:, None] * np.cross(arms, speeds)).sum(axis=0)
    objective = part_angular_momentum(BODY, part, state, momentum, 1.0, frame)
    assert np.allclose(objective.rows @ v.ravel(), objective.target, atol=1e-10)
    if not frame.relative:
        turn = np.array([0.4, -0.2, 0.7])
        rigid = np.cross(turn, state.positions) + [1.0, 2.0, 3.0]
        asked = part_angular_momentum(BODY, part, state, frame.axes @ part.inertia(state.positions) @ turn, 1.0, frame)
        assert np.allclose(asked.rows @ rigid.ravel(), asked.target, atol=1e-10)


@by_part
def test_rotation_rows_are_the_rate_of_the_best_fit_rotation(part: BodyPart) -> None:
    """In a rigid velocity field, the rows give the rate of the part's best-fit rotation (Kabsch), which is the angular
    velocity."""
    state = shaken_state()
    turn = np.array([0.4, -0.2, 0.7])
    rigid = np.cross(turn, state.positions) + [1.0, 2.0, 3.0]

    def rotation(positions: np.ndarray) -> np.ndarray:
        arms, rest = (x[part.nodes] - part.centre(x) for x in (positions, state.positions))
        return Rotation.align_vectors(arms, rest, weights=part.masses)[0].as_rotvec()

    objective = part_angular_velocity(BODY, part, state, TURNED @ turn, 1.0, Coordinates(TURNED, False))
    assert np.allclose(rate_of(rotation, state, rigid), turn, atol=1e-6)
    assert np.allclose(objective.rows @ rigid.ravel(), objective.target, atol=1e-10)


def test_slip_costs_its_square_times_the_load() -> None:
    """The squared error is the load times the squared slip, on a sloped contact plane. Motion along the normal does not
    contribute."""
    floor = Plane(np.array([0.1, -0.2, 1.0]) / np.sqrt(1.05), 0.3)
    nodes = BODY.mesh.nodes
    embedding = embed_points(BODY.mesh, nodes[nodes[:, 2] == 0.0], device="cpu")
    geometry = ContactGeometry(BODY.mesh, (floor,), 0.8, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    contacts = ContactDetector(geometry, device="cpu").contact_set(np.arange(4), nodes)
    loads = np.array([0.5, 0.2, 0.0, 0.3])
    objective = no_slip_contacts(contacts, loads, 7.0)
    assert objective.weight == 7.0 and not objective.target.any()
    v = np.random.default_rng(9).standard_normal(nodes.shape)
    moved = np.einsum("cw,cwi->ci", contacts.weights, v[contacts.nodes])
    slid = moved - np.outer(moved @ floor.normal, floor.normal)
    gap = objective.rows @ v.ravel()
    assert gap @ gap == pytest.approx(loads @ (slid**2).sum(axis=1))


def test_shape_rows_of_a_part_are_free_of_translation() -> None:
    """The squared error is the mass-weighted mean of |v - target|^2 over the part's nodes after the best translation,
    so only a part that moves as ``target`` up to a translation has none."""
    part, rng = PARTS[2], np.random.default_rng(7)
    v, target = rng.standard_normal(BODY.mesh.nodes.shape), rng.standard_normal((len(part.nodes), 3))
    objective, shares = part_shape(BODY, part, target, 1.0), part.masses / part.masses.sum()
    error = v[part.nodes] - target - shares @ (v[part.nodes] - target)
    gap = objective.rows @ v.ravel() - objective.target
    assert gap @ gap == pytest.approx((shares[:, None] * error**2).sum())
    v[part.nodes] = target + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(objective.rows @ v.ravel(), objective.target, atol=1e-12)


def test_node_rows_of_a_part_are_a_mean_square() -> None:
    """The squared error |rows v - target|^2 is the mean of |v - target|^2 over the part's nodes."""
    part = PARTS[2]
    v = np.random.default_rng(7).standard_normal(BODY.mesh.nodes.shape)
    target = np.random.default_rng(8).standard_normal((len(part.nodes), 3))
    objective = part_nodes(BODY, part, target, 1.0)
    gap = objective.rows @ v.ravel() - objective.target
    assert gap @ gap == pytest.approx(((v[part.nodes] - target) ** 2).sum(axis=1).mean())
