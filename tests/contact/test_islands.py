"""Islands of touching bodies: they equal the connected components found by a graph search, and are numbered by their
lowest body, for many worlds and any order of contacts."""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from egs_warp.contact.islands import enqueue_islands, find_islands


def test_random_contacts_give_the_connected_components_in_any_order() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        count = int(random.integers(1, 20))
        pairs = random.integers(0, count, (int(random.integers(1, 25)), 2))
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), (count, count))
        part = connected_components(graph, directed=False)[1]
        expected = np.array([np.flatnonzero(part == each)[0] for each in part])
        assert np.array_equal(find_islands(count, pairs), expected)
        assert np.array_equal(find_islands(count, random.permutation(pairs)[:, ::-1]), expected)


def test_an_obstacle_connects_nothing() -> None:
    assert find_islands(4, np.array([[0, -1], [3, -1], [3, 2]])).tolist() == [0, 1, 2, 2]
    assert find_islands(3, np.zeros((0, 2), int)).tolist() == [0, 1, 2]


def test_worlds_are_independent_and_padding_is_ignored(device: str) -> None:
    pairs = wp.array([[[0, 1], [1, 2]], [[2, 1], [0, 1]]], dtype=wp.vec2i, device=device)
    islands = wp.zeros((2, 3), dtype=int, device=device)
    enqueue_islands(wp.array([2, 1], dtype=int, device=device), pairs, islands)
    assert islands.numpy().tolist() == [[0, 0, 0], [0, 1, 1]]
