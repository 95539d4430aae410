"""Depth of a body in another part of itself: two prongs that are moved into each other."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.locomotion import penetration
from egs_warp.locomotion.penetration import depth_in_itself
from egs_warp.locomotion.world_audit import ContactShape
from tests.support.meshes import u_bar
from tests.support.props import soft_body


@pytest.mark.parametrize("overlap", [-0.02, 0.0, 0.01, 0.02])
def test_the_depth_of_prongs_in_each_other_is_their_overlap(overlap: float) -> None:
    """The prongs are moved towards each other, without rotation, by half of the gap of 0.3 m and half of the
    overlap."""
    made = soft_body(u_bar())
    shape = ContactShape.of(made.stepper.geometry, made.level_set, made.rest_positions)
    rest, tets = made.rest_positions, made.stepper.body.mesh.tets
    positions = rest.copy()
    prongs = rest[:, 2] > 0.25
    positions[prongs, 0] -= np.sign(rest[prongs, 0]) * (0.15 + 0.5 * overlap)
    points = shape.point_tets, shape.point_weights
    depth = depth_in_itself(*points, shape.gaps, tets, rest, positions, 0.02)
    # The elements between base and prongs are sheared, and their gaps are distances to first order only.
    assert depth == pytest.approx(max(overlap, 0.0), abs=5e-4)
    assert depth_in_itself(*points, shape.gaps, tets, rest, rest, 0.02) == 0.0


def test_a_body_that_bends_slightly_computes_no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only pairs of tetrahedra that map places to different parts of the body at rest need weights."""
    made = soft_body(u_bar())
    shape = ContactShape.of(made.stepper.geometry, made.level_set, made.rest_positions)
    rest, counts = made.rest_positions, []
    compute = penetration._weights_in
    monkeypatch.setattr(
        penetration, "_weights_in", lambda places, corners: counts.append(len(places)) or compute(places, corners)
    )
    bent = rest[:, [1, 2, 0]] + 0.02 * np.sin(3.0 * rest)
    depth = depth_in_itself(
        shape.point_tets, shape.point_weights, shape.gaps, made.stepper.body.mesh.tets, rest, bent, 0.02
    )
    assert depth == 0.0 and counts == [0, 0]
