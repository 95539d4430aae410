"""Softer parts of a body: their frequency, the relation between frequency and sag, and the energy balance of the
audit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.body import SoftBody, first_frequency, make_body
from egs_warp.fem.soft_parts import (
    MIN_RELATIVE_STIFFNESS,
    bending_frequency,
    stiffness_at_nodes,
    stiffness_at_segments,
    with_soft_parts,
)
from egs_warp.geometry.body_frame import GROUND
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.meshing.protrusions import find_protrusions
from tests.support.flights import rigid_flight
from tests.support.meshes import UP, box_mesh, figure


@pytest.fixture(scope="module")
def body() -> SoftBody:
    """Create a figure with two extended arms."""
    return make_body(figure(), GROUND)


def arms(body: SoftBody) -> list[np.ndarray]:
    parts = find_protrusions(body.mesh, UP)
    return [part.nodes for part in parts if abs(body.mesh.nodes[part.tip, 0]) > 0.6]


def frequency(body: SoftBody, part: np.ndarray) -> float:
    free = np.zeros(len(body.mesh.nodes), dtype=bool)
    free[part] = True
    return first_frequency(body.assembly, body.node_mass, free)


def test_a_part_has_the_requested_frequency(body: SoftBody) -> None:
    left, right = arms(body)
    before = frequency(body, left)
    soft = with_soft_parts(body, [left, right], [0.5 * before, 2.0 * before])
    assert frequency(soft, left) == pytest.approx(0.5 * before, rel=1e-6)
    assert frequency(soft, right) == pytest.approx(frequency(body, right), rel=1e-6), "not made stiffer"
    at_nodes = stiffness_at_nodes(soft)
    np.testing.assert_allclose(at_nodes[left], 0.25, rtol=1e-6)
    assert at_nodes.max() == 1.0 and soft.young_modulus == body.young_modulus


def test_a_segment_is_as_soft_as_its_soft_end(body: SoftBody) -> None:
    """Springs in series: with one end in an arm of stiffness 0.1, the segment has 2 / (1 + 1 / 0.1). An end that two
    nodes share equally has the mean of their compliances."""
    left, _ = arms(body)
    soft = with_soft_parts(body, [left], [np.sqrt(0.1) * frequency(body, left)])
    at_nodes = stiffness_at_nodes(soft)
    inside, outside = left[np.argmin(at_nodes[left])], int(np.argmax(at_nodes))
    assert at_nodes[inside] == pytest.approx(0.1) and at_nodes[outside] == 1.0
    ends = np.zeros((3, len(at_nodes)))
    ends[0, inside], ends[1, outside], ends[2, [inside, outside]] = 1.0, 1.0, 0.5
    muscles = SimpleNamespace(end_rows=sparse.csr_matrix(ends), segments=np.array([[0, 0], [0, 1], [1, 1], [2, 2]]))
    found = stiffness_at_segments(soft, cast(Any, muscles))
    np.testing.assert_allclose(found, [0.1, 2.0 / 11.0, 1.0, 2.0 / 11.0], rtol=1e-6)


def test_a_body_without_softer_parts_stays_the_same(body: SoftBody) -> None:
    assert with_soft_parts(body, [], []) is body
    assert with_soft_parts(body, arms(body), [1e6, 1e6]) is body


def test_the_stiffness_has_a_minimum(body: SoftBody) -> None:
    left, _ = arms(body)
    relative = with_soft_parts(body, [left], [1e-6]).assembly.material.relative_stiffness
    assert relative is not None and relative.min() == MIN_RELATIVE_STIFFNESS


def test_a_beam_with_the_frequency_of_its_sag_sags_as_much() -> None:
    """For a slender horizontal cantilever, the sag is compared with that of linear statics."""
    mesh = box_mesh((20, 2, 2), (2.0, 0.2, 0.2))
    body = make_body(mesh, GROUND)
    free = mesh.nodes[:, 0] > -0.99
    stretch = first_frequency(body.assembly, body.node_mass, free) / bending_frequency(0.1, 2.0, 9.81)
    upper = body.assembly.matrix(body.assembly.hessian_entries(mesh.nodes))
    chosen = np.flatnonzero(np.repeat(free, 3))
    stiffness = (upper + sparse.triu(upper, 1).T).toarray()[np.ix_(chosen, chosen)] / stretch**2
    moved = np.zeros(3 * len(free))
    moved[chosen] = np.linalg.solve(stiffness, (body.node_mass[:, None] * body.gravity).ravel()[chosen])
    tip = mesh.nodes[:, 0] > 0.99
    assert -moved.reshape(-1, 3)[tip, 2].mean() == pytest.approx(0.1 * 2.0, rel=0.03)


def test_the_ledger_weights_elements_by_their_stiffness() -> None:
    t = rigid_flight()
    stretching = 1.0 + 0.01 * np.arange(len(t.time))[:, None, None]
    t = replace(t, positions=t.positions * stretching)
    halves = replace(t, relative_stiffness=np.full(len(t.tets), 0.5))
    whole, half = energy_balance(t), energy_balance(halves)
    np.testing.assert_allclose(half.elastic, 0.5 * whole.elastic, rtol=1e-12)
    np.testing.assert_allclose(half.damping, 0.5 * whole.damping, rtol=1e-12)
