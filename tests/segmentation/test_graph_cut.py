"""Cut of a graph of Gaussians, which has the lowest cost, and shortest paths along the graph."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from egs_warp.segmentation.graph_cut import SplatGraph
from tests.support.scenes import round_ones


def cost(graph: SplatGraph, inside: np.ndarray, leaning: np.ndarray, smoothness: float) -> float:
    """Return the cost of the labelling ``inside``."""
    unlike = inside[graph.first] != inside[graph.second]
    own = np.where(inside, np.maximum(-leaning, 0.0), np.maximum(leaning, 0.0)).sum()
    return float(own + smoothness * graph.strength[unlike].sum())


@pytest.mark.parametrize("seed", range(6))
def test_the_cut_has_the_lowest_cost(seed: int) -> None:
    """The cost is compared with all 2^9 labellings of nine Gaussians that respect the fixed labels."""
    random = np.random.default_rng(seed)
    graph = SplatGraph.linking(random.normal(size=(9, 3)), random.uniform(size=(9, 3)))
    leaning = random.normal(scale=2.0, size=9)
    held, dropped = np.arange(9) == 0, np.arange(9) == 8
    found = graph.cut(leaning, held, dropped, smoothness=1.5)
    assert found[0] and not found[8]
    least = min(
        cost(graph, np.array(labels, bool), np.where(held | dropped, 0.0, leaning), 1.5)
        for labels in product((False, True), repeat=9)
        if labels[0] and not labels[8]
    )
    # The tolerance is for the rounding of costs to thousandths.
    assert cost(graph, found, np.where(held | dropped, 0.0, leaning), 1.5) == pytest.approx(least, abs=0.05)


def test_a_chain_is_cut_at_its_widest_gap_and_at_its_change_of_colour() -> None:
    line = np.zeros((40, 3))
    line[:, 0] = np.arange(40) + 3.0 * (np.arange(40) >= 13)
    grey = np.full((40, 3), 0.5)
    nothing, held, dropped = np.zeros(40), np.arange(40) == 0, np.arange(40) == 39
    by_gap = SplatGraph.linking(line, grey).cut(nothing, held, dropped)
    assert by_gap.sum() == 13 and by_gap[:13].all()
    even = np.column_stack([np.arange(40), np.zeros((40, 2))])
    tones = np.where(np.arange(40)[:, None] < 25, 0.2, 0.8) + np.zeros(3)
    by_colour = SplatGraph.linking(even, tones).cut(nothing, held, dropped)
    assert by_colour.sum() == 25 and by_colour[:25].all()


def test_distances_follow_the_links() -> None:
    """The shortest path follows three sides of an open square and does not cross the gap; two distant squares are not
    connected."""
    side = np.linspace(0.0, 1.0, 41)
    legs = [
        np.column_stack([side * 0, side]),
        np.column_stack([side, side * 0 + 1]),
        np.column_stack([side * 0 + 1, side]),
    ]
    points = np.column_stack([np.concatenate(legs), np.zeros(123)])
    points = np.concatenate([points, points + [50.0, 0.0, 0.0]])
    graph = SplatGraph.linking(points, np.full((len(points), 3), 0.5))
    ways = graph.distances(np.array([0]))
    # The end of the open square is three sides away from the start, 6 times the distance of the middle of the first
    # side.
    assert ways[82] / ways[20] == pytest.approx(6.0, rel=0.05)
    assert np.isinf(ways[123:]).all()


def test_parts_are_connected_components_on_either_side() -> None:
    line = np.column_stack([np.arange(60.0), np.zeros((60, 2))])
    graph = SplatGraph.linking(line, np.full((60, 3), 0.5))
    inside = (np.arange(60) < 20) | (np.arange(60) >= 40)
    parts = graph.parts(inside)
    assert len(np.unique(parts)) == 3
    assert len(np.unique(parts[:20])) == len(np.unique(parts[20:40])) == len(np.unique(parts[40:])) == 1


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any(count: int) -> None:
    graph = SplatGraph.linking(np.zeros((count, 3)), np.zeros((count, 3)))
    held = np.arange(count) == 0
    np.testing.assert_array_equal(graph.cut(-np.ones(count), held, np.zeros(count, bool), smoothness=0.0), held)


def test_gaussians_at_one_place_do_not_isolate_it() -> None:
    """A line of 50 positions, at each of which training has stacked eight Gaussians, remains connected. The links to
    the six nearest neighbours alone would connect only Gaussians at the same position."""
    line = np.zeros((400, 3))
    line[:, 0] = np.repeat(np.arange(50), 8) + np.tile(0.001 * np.arange(8), 50)
    everywhere = np.arange(400)
    stacked = round_ones(line, 1.0)
    by_place, by_point = SplatGraph.of(stacked, everywhere, neighbours=6), SplatGraph.linking(line, line, neighbours=6)
    assert len(np.unique(by_place.parts(np.ones(400, bool)))) == 1
    assert len(np.unique(by_point.parts(np.ones(400, bool)))) == 50
    held, dropped = everywhere < 8, everywhere >= 392
    inside = by_place.cut(np.where(line[:, 0] < 20.5, 0.2, -0.2), held, dropped)
    np.testing.assert_array_equal(inside, line[:, 0] < 20.5)
