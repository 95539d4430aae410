"""Symbolic analysis: the blocks contain all entries of the factor, in a valid order of elimination."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.supernodes import Supernodes, first_of_equal_rows
from tests.support.sparse_patterns import PATTERNS, upper_of


@pytest.mark.parametrize("name", PATTERNS)
def test_blocks_contain_the_factor(name: str) -> None:
    """Every nonzero entry of the factor L lies in a block, and the blocks partition the columns."""
    matrix = PATTERNS[name]
    blocks, count = Supernodes.of(upper_of(matrix)), len(matrix.indptr) - 1
    assert np.array_equal(np.sort(blocks.permutation), np.arange(count))
    assert np.array_equal(blocks.first, np.cumsum([0, *blocks.widths[:-1]])) and blocks.widths.sum() == count
    order = np.argsort(blocks.permutation)
    factor = np.linalg.cholesky(matrix.toarray()[np.ix_(order, order)])
    held = np.zeros((count, count), dtype=bool)
    for s in range(blocks.count):
        front = blocks.rows[blocks.row_offsets[s] : blocks.row_offsets[s + 1]]
        own = np.arange(blocks.first[s], blocks.first[s] + blocks.widths[s])
        assert np.array_equal(front[: len(own)], own) and (np.diff(front) > 0).all()
        held[np.ix_(front, own)] = True
        # The rows below the diagonal block are in the parent, which is later in the order.
        below, parent = front[len(own) :], blocks.parents[s]
        assert (parent < 0) == (len(below) == 0)
        if parent >= 0:
            assert parent > s
            assert np.isin(below, blocks.rows[blocks.row_offsets[parent] : blocks.row_offsets[parent + 1]]).all()
    assert not (np.abs(factor) > 0.0)[~held].any()


def test_blocks_of_a_mesh_are_wide_and_nearly_full() -> None:
    """The three rows of a node form one group; most entries of the blocks of a grid are nonzero."""
    matrix = PATTERNS["grid of nodes"]
    full = sparse.csc_matrix(matrix)
    full.sort_indices()
    assert np.array_equal(np.flatnonzero(first_of_equal_rows(full)), np.arange(0, len(full.indptr) - 1, 3))
    blocks = Supernodes.of(upper_of(matrix))
    assert (blocks.widths % 3 == 0).all() and blocks.count < len(full.indptr) / 6
    order = np.argsort(blocks.permutation)
    factor = np.linalg.cholesky(matrix.toarray()[np.ix_(order, order)])
    held = (blocks.widths * (blocks.heights - 0.5 * (blocks.widths - 1.0))).sum()
    assert held < 1.35 * np.count_nonzero(np.abs(factor) > 1e-14)
    # In the original order, the factor would have 1.5 times as many entries.
    assert held < np.count_nonzero(np.abs(np.linalg.cholesky(matrix.toarray())) > 1e-14) / 1.5
