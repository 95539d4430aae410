"""Protrusions of simple bodies, which are arms and tails, but not legs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.protrusions import find_protrusions
from tests.support.meshes import UP, carved, coarse_stool, column, figure


def dog() -> TetMesh:
    """Create a trunk on four legs with a tail that hangs behind it."""

    def keep(c: np.ndarray) -> np.ndarray:
        (x, y), z = c[:, :2].T, c[:, 2]
        trunk = (z > 0.4) & (np.abs(x) < 0.4)
        legs = (np.abs(x) > 0.2) & (np.abs(x) < 0.4) & (np.abs(y) > 0.1)
        tail = (x > 0.7) & (z > 0.2) & (np.abs(y) < 0.1) | (x > 0.4) & (z > 0.6) & (z < 0.8) & (np.abs(y) < 0.1)
        return trunk | legs | tail

    return carved((1.8, 0.6, 0.8), 0.1, keep)


def test_both_arms_of_a_figure_are_parts() -> None:
    mesh = figure()
    arms = [part for part in find_protrusions(mesh, UP) if abs(mesh.nodes[part.tip, 0]) > 0.6]
    left, right = sorted(arms, key=lambda part: mesh.nodes[part.tip, 0])
    x, z = mesh.nodes[:, 0], mesh.nodes[:, 2]
    for part, side in ((left, -1.0), (right, 1.0)):
        assert np.isin(np.flatnonzero(side * x > 0.55), part.nodes).all() and part.tip in part.nodes
        assert z[part.nodes].min() > 0.75 and (side * x[part.nodes] > -0.15).all()
        assert 0.4 < part.length < 0.6


def test_a_hanging_tail_is_a_part_and_legs_are_not() -> None:
    mesh = dog()
    (tail,) = find_protrusions(mesh, UP)
    assert mesh.nodes[tail.nodes, 0].min() > 0.35 and mesh.nodes[tail.nodes, 2].min() > 0.15
    assert np.isin(np.flatnonzero(mesh.nodes[:, 0] > 0.65), tail.nodes).all()


@pytest.mark.parametrize("make", [column, coarse_stool])
def test_nothing_sticks_out_of_a_column_or_a_stool(make: Callable[[], TetMesh]) -> None:
    assert find_protrusions(make(), UP) == ()
