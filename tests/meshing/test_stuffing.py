"""Minimum dihedral angle of isosurface stuffing, found by a search over all states of a lattice tetrahedron."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing import stuffing

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, -0.5, 0.5], [0.5, 0.5, 0.5]])
"""Corners of a lattice tetrahedron in units of the cube side: two ends of a long edge, then two of the opposite one."""
STEPS = np.array([*(np.array(d) - 0.5 for d in product((0, 1), repeat=3)), *np.eye(3), *-np.eye(3)])
"""Vectors (14, 3) from a lattice point to its neighbours, in units of the cube side: 8 short edges, then 6 long
ones."""
INSIDE, OUTSIDE = -2, -1
"""States of corners that were not moved. A state of 0 or more is an index into ``STEPS``: the corner was moved along
that edge."""
PAIRS = stuffing._CORNER_PAIRS
IS_LONG = np.isin(np.arange(6), [0, 5])


def is_possible(states: tuple[int, ...]) -> bool:
    """Return True if signs of the lattice points exist that lead to these states: the two ends of an edge along which a
    corner was moved have opposite signs, and no edge has two cuts."""

    def point(x: np.ndarray) -> tuple[int, ...]:
        return tuple((2.0 * x).round().astype(int))

    moves = [(point(x), point(x + STEPS[s])) for x, s in zip(CORNERS, states, strict=True) if s >= 0]
    if any((b, a) in moves for a, b in moves):
        return False
    signs = {point(x): s == INSIDE for x, s in zip(CORNERS, states, strict=True) if s < 0}
    while moves:
        known = [move for move in moves if move[0] in signs or move[1] in signs] or [moves[0]]
        a, b = known[0]
        if a not in signs:
            signs[a] = not signs[b] if b in signs else True
        if signs.setdefault(b, not signs[a]) == signs[a]:
            return False
        moves.remove((a, b))
    return True


def least_angle(states: np.ndarray, moved: np.ndarray, cuts: np.ndarray, order: list[int]) -> float:
    """Return the minimum dihedral angle, degrees, of the tetrahedra that fill lattice tetrahedra in these states.

    Args:
        states: (n, 4) states of the corners.
        moved: (4,) displacement of each corner as a fraction of its limit.
        cuts: (6,) position of the cut on each edge, from 0, closest to the first end, to 1.
        order: order of the corners, which selects one of two diagonals of equal rank.
    """
    limits = np.where(np.arange(14) < 8, stuffing._SNAP_SHORT, stuffing._SNAP_LONG)
    signs = np.select([states == INSIDE, states == OUTSIDE], [1, -1], 0)[:, order]
    points = (CORNERS + ((states >= 0) * moved * limits[states])[:, :, None] * STEPS[states])[:, order].reshape(-1, 3)
    tets = np.arange(len(points)).reshape(-1, 4)
    edges, is_long = tets[:, PAIRS].reshape(-1, 2), np.tile(IS_LONG, len(tets))
    is_cut = np.prod(signs[:, PAIRS], axis=2).ravel() < 0
    nodes_of_edges = np.where(is_cut, len(points) + np.cumsum(is_cut) - 1, -1)
    nearest = np.where(IS_LONG, stuffing._SNAP_LONG, stuffing._SNAP_SHORT)
    share = np.tile(nearest + cuts * (1.0 - 2.0 * nearest), len(tets))[is_cut, None]
    first, second = points[edges[is_cut]].transpose(1, 0, 2)
    nodes = np.concatenate([points, first + share * (second - first)])
    filled = stuffing._fill_tets(nodes, tets, signs.ravel(), edges, is_long, nodes_of_edges)
    return TetMesh(nodes, filled).min_dihedral_degrees()


@pytest.mark.slow
def test_stuffing_bound() -> None:
    """Away from the floor, the minimum dihedral angle is 9.269 degrees.

    A corner of a tetrahedron is inside, outside, or was moved by at most its limit along one of 14 edges. An edge from
    inside to outside is cut no nearer to either end than the limit, because the end would have been moved otherwise.
    The search covers all states that are consistent with signs of the lattice points. Moves and cuts take the lower
    limit, middle and upper limit of their ranges; the minimum is at limits. The paper's bound of 10.7 degrees holds for
    smaller limits and its parity rule for diagonals.
    """
    states = np.array([s for s in product(range(-2, 14), repeat=4) if INSIDE in s and is_possible(s)])
    patterns, pattern_of = np.unique(np.minimum(states, 0), axis=0, return_inverse=True)
    least = 180.0
    for number, pattern in enumerate(patterns):
        chosen = states[pattern_of == number]
        signs = np.select([pattern == INSIDE, pattern == OUTSIDE], [1, -1], 0)
        for order in ([0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2], [1, 0, 3, 2]):
            is_cut = np.prod(signs[order][PAIRS], axis=1) < 0
            free = np.flatnonzero(np.append(pattern == 0, is_cut))
            for values in product((0.0, 0.5, 1.0), repeat=len(free)):
                at = np.zeros(10)
                at[free] = values
                least = min(least, least_angle(chosen, at[:4], at[4:], order))
    assert 9.268 < least < 9.27
