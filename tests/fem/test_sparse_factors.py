"""Sparse factors solve as dense algebra does, and tell definiteness by inertia."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.sparse_factors import SparseFactors, inverse_and_positives


def random_matrix(count: int, shift: float) -> sparse.csc_matrix:
    """Symmetric, ``shift`` added to its diagonal."""
    random = np.random.default_rng(3)
    half = sparse.csc_matrix(np.where(random.random((count, count)) < 0.1, random.standard_normal((count, count)), 0.0))
    return sparse.csc_matrix(half + half.T + shift * sparse.eye(count))


def upper_of(matrix: sparse.csc_matrix) -> sparse.csc_matrix:
    upper = sparse.csc_matrix(sparse.triu(matrix))
    upper.sort_indices()
    return upper


@pytest.mark.parametrize("shift", [12.0, 0.7])
def test_one_and_many_right_sides(shift: float) -> None:
    """Definite and indefinite: A x = b to rounding, and as many negative pivots as negative eigenvalues."""
    matrix = random_matrix(60, shift)
    dense, upper = matrix.toarray(), upper_of(matrix)
    negative = int((np.linalg.eigvalsh(dense) < 0.0).sum())
    assert (negative == 0) == (shift > 10.0)
    factors = SparseFactors(upper)
    assert factors.update(upper.data) == (negative == 0)
    assert factors.ready and factors.negative_pivots == negative
    right = np.random.default_rng(4).standard_normal((60, 7))
    assert np.abs(dense @ factors.solve(right) - right).max() < 1e-9
    assert np.abs(dense @ factors.solve(right[:, 0]) - right[:, 0]).max() < 1e-9
    assert factors.solve(right[:, :0]).shape == (60, 0)
    # Where nothing is added, it is as definite as it was.
    assert factors.add(np.zeros((60, 0)), np.zeros(0)) == (negative == 0)
    # Another matrix of the same pattern.
    assert factors.update(2.0 * upper.data) == (negative == 0)
    assert np.abs(2.0 * dense @ factors.solve(right) - right).max() < 1e-9


def test_what_cannot_be_factored_is_told() -> None:
    upper = upper_of(random_matrix(60, 12.0))
    factors = SparseFactors(upper)
    assert not factors.update(np.full(upper.nnz, np.nan)) and not factors.ready
    singular = sparse.csc_matrix(np.ones((2, 2)))
    factors = SparseFactors(upper_of(singular))
    assert not factors.update(np.ones(3)) and not factors.ready


@pytest.mark.parametrize("size", [2, 7, 60])
def test_an_inverse_comes_with_the_count_of_positive_eigenvalues(size: int) -> None:
    """Of any symmetric matrix, a diagonal of zeros and blocks of two among them; the upper triangle is not read."""
    random = np.random.default_rng(size)
    for diagonal in (0.0, 1.0, 10.0, -10.0):
        lower = np.tril(random.normal(size=(size, size)), -1)
        matrix = lower + lower.T + diagonal * np.diag(random.normal(size=size))
        positive, inverse = inverse_and_positives(np.tril(matrix) + np.triu(np.full_like(matrix, 7.0), 1))
        assert positive == (np.linalg.eigvalsh(matrix) > 0.0).sum()
        np.testing.assert_allclose(inverse @ matrix, np.eye(size), atol=1e-8)
    positive, inverse = inverse_and_positives(np.zeros((size, size)))
    assert positive < 0 and not np.isfinite(inverse).any()
