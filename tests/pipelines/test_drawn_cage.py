"""Cage of a prop for display, whose surface resembles the prop and moves affinely with its tetrahedron."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.pipelines.drawn_cage import DrawnCage
from tests.support.props import box_body

SIZE = (0.8, 0.6, 0.4)


def _shape(*, soft: bool = False) -> tuple[ContactShape, DrawnCage]:
    body = box_body(SIZE, soft=soft)
    shape = ContactShape.of(body.stepper.geometry, body.level_set, body.rest_positions)
    return shape, DrawnCage.of(body.stepper.body.mesh, shape)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def test_surface_of_a_prop_is_its_zero_set() -> None:
    shape, cage = _shape()
    vertices = cage.nodes[4:]
    assert np.abs(shape.level_set.evaluate(vertices)[0]).max() < 0.02
    assert _volume(cage.nodes, cage.surface) == pytest.approx(np.prod(SIZE), rel=0.1)
    matrix, shift = np.array([[0.9, 0.2, 0.0], [-0.1, 1.1, 0.3], [0.0, 0.1, 1.0]]), np.array([1.0, 2.0, 3.0])
    moved = cage.positions(cage.nodes[:4] @ matrix.T + shift)
    np.testing.assert_allclose(moved, cage.nodes @ matrix.T + shift, atol=1e-12)
    assert cage.positions(np.stack([cage.nodes[:4]] * 3)).shape == (3, len(cage.nodes), 3)


def test_a_prop_too_thin_for_the_lattice_has_the_hull_of_its_contact_points() -> None:
    shape, _ = _shape()
    thin = replace(shape, coefficients=np.abs(shape.coefficients) + 1.0)
    cage = DrawnCage.of(box_body(SIZE).stepper.body.mesh, thin)
    assert _volume(cage.nodes, cage.surface) == pytest.approx(np.prod(SIZE), rel=1e-9)


def test_a_soft_body_keeps_its_cage() -> None:
    _, cage = _shape(soft=True)
    assert len(cage.weights) == 0 and cage.positions(cage.nodes) is cage.nodes
