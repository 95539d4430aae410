"""Dissection into slabs: parts are coupled only through the separator."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.dissection import Dissection


def upper_of(joined: np.ndarray) -> sparse.csc_matrix:
    """Return the upper triangle, with the diagonal, of a pattern (n, n)."""
    return sparse.csc_matrix(np.triu(joined | joined.T | np.eye(len(joined), dtype=bool)).astype(float))


def band(count: int, reach: int, seed: int) -> np.ndarray:
    """Return the pattern (n, n) of a band matrix of bandwidth ``reach`` in a random order."""
    places = np.random.default_rng(seed).permutation(count)
    return abs(places[:, None] - places) <= reach


@pytest.mark.parametrize("count", [20, 60, 200])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_joins_two_slabs(count: int, seed: int) -> None:
    joined = band(count, 3, seed)
    slabs = Dissection.of(upper_of(joined))
    assert np.array_equal(np.sort(slabs.order), np.arange(count))
    assert len(slabs.parts) > 1 and min(map(len, slabs.parts)) > 0
    for number, part in enumerate(slabs.parts):
        for other in slabs.parts[number + 1 :]:
            assert not joined[np.ix_(part, other)].any()
    # The optimum has a quarter of the unknowns in each part, and three separators as wide as the band.
    assert max(map(len, slabs.parts)) + len(slabs.separator) < 0.3 * count + 12


def test_a_dense_matrix_is_not_divided() -> None:
    for joined in (np.ones((30, 30), bool), np.ones((1, 1), bool)):
        slabs = Dissection.of(upper_of(joined))
        assert (
            len(slabs.parts) == 1 and np.array_equal(slabs.order, np.arange(len(joined))) and not len(slabs.separator)
        )


def test_disconnected_bodies_have_slabs_too() -> None:
    """The vertices that are not connected to the first one form a single level."""
    joined = sparse.block_diag([band(60, 2, 0), band(20, 2, 1)]).toarray().astype(bool)
    slabs = Dissection.of(upper_of(joined))
    assert np.array_equal(np.sort(slabs.order), np.arange(80)) and len(slabs.parts) > 1
    parts = np.full(80, -1)
    for number, part in enumerate(slabs.parts):
        parts[part] = number
    rows, columns = np.nonzero(joined)
    one, other = parts[rows], parts[columns]
    assert ((one == other) | (one < 0) | (other < 0)).all()
