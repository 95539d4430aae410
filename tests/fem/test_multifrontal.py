"""Sparse factors: solutions agree with dense algebra, and definiteness follows from the inertia of the matrix."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.multifrontal import MultifrontalLdl, SymbolicFactorization, inverse_and_positives
from egs_warp.launching import THREADS
from tests.support.factors import has_factors, is_definite
from tests.support.sparse_patterns import PATTERNS, upper_of


def random_matrix(count: int, shift: float) -> sparse.csc_matrix:
    """Return a random symmetric matrix with ``shift`` added to its diagonal."""
    random = np.random.default_rng(3)
    half = sparse.csc_matrix(np.where(random.random((count, count)) < 0.1, random.standard_normal((count, count)), 0.0))
    return sparse.csc_matrix(half + half.T + shift * sparse.eye(count))


@pytest.mark.parametrize("shift", [12.0, 0.7])
def test_one_and_many_right_sides(shift: float) -> None:
    """For definite and indefinite matrices, A x = b to rounding, and the number of negative pivots is that of negative
    eigenvalues."""
    matrix = random_matrix(60, shift)
    dense, upper = matrix.toarray(), upper_of(matrix)
    negative = int((np.linalg.eigvalsh(dense) < 0.0).sum())
    assert (negative == 0) == (shift > 10.0)
    factors = MultifrontalLdl(upper)
    assert is_definite(factors, upper.data) == (negative == 0)
    assert has_factors(factors) and factors.negative_pivots == negative
    right = np.random.default_rng(4).standard_normal((60, 7))
    assert np.abs(dense @ factors.solve(right) - right).max() < 1e-9
    assert np.abs(dense @ factors.solve(right[:, 0]) - right[:, 0]).max() < 1e-9
    assert factors.solve(right[:, :0]).shape == (60, 0)
    # A low-rank term of rank zero does not change definiteness.
    assert factors.add_low_rank(np.zeros((60, 0)), np.zeros(0)) == (negative == 0)
    # The same object factors another matrix with the same pattern.
    assert is_definite(factors, 2.0 * upper.data) == (negative == 0)
    assert np.abs(2.0 * dense @ factors.solve(right) - right).max() < 1e-9


def test_singular_matrices_are_reported() -> None:
    upper = upper_of(random_matrix(60, 12.0))
    factors = MultifrontalLdl(upper)
    assert not is_definite(factors, np.full(upper.nnz, np.nan)) and not has_factors(factors)
    singular = sparse.csc_matrix(np.ones((2, 2)))
    factors = MultifrontalLdl(upper_of(singular))
    assert not is_definite(factors, np.ones(3)) and not has_factors(factors)


@pytest.mark.parametrize("name", PATTERNS)
def test_every_pattern_and_number_of_right_sides(name: str) -> None:
    """The solution is exact to rounding for any memory order of the right-hand sides. Its bits do not depend on their
    number, except that a single right-hand side is solved by another routine."""
    matrix = PATTERNS[name]
    factors, count = MultifrontalLdl(upper_of(matrix)), len(matrix.indptr) - 1
    assert is_definite(factors, upper_of(matrix).data) and factors.negative_pivots == 0
    right = np.random.default_rng(5).standard_normal((count, 70))
    whole = factors.solve(right)
    assert np.abs(matrix @ whole - right).max() < 1e-12 * np.abs(right).max() * count
    for width in (2, 3, 8, 9, 15, 16, 17, 33):
        np.testing.assert_array_equal(factors.solve(right[:, :width]), whole[:, :width])
    np.testing.assert_array_equal(factors.solve(np.asfortranarray(right)), whole)
    np.testing.assert_array_equal(factors.solve(right[:, ::-2]), whole[:, ::-2])
    np.testing.assert_allclose(factors.solve(right[:, 3]), whole[:, 3], atol=1e-13)
    np.testing.assert_array_equal(factors.solve(right[:, [3]])[:, 0], factors.solve(right[:, 3].copy()))


def strained(factors: LinearSolver, upper: sparse.csc_matrix, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the result of ``quadratic_form`` for random input and ``vectors``; the random matrix has the pattern of
    ``upper``."""
    random = np.random.default_rng(6)
    slope, weights, away = random.standard_normal((3, len(vectors)))
    return factors.quadratic_form(upper.data, slope, weights, vectors, dt_now=0.3, dt_ahead=-0.7, reference=away)


@pytest.mark.parametrize("name", PATTERNS)
def test_quadratic_form_equals_dense_algebra(name: str) -> None:
    """X^T H X and X^T g are those of X = 0.3 V - 0.7 S^-1 diag(w) V, minus the reference in the last column of X, for
    another matrix H with the same pattern."""
    matrix = PATTERNS[name]
    factors = MultifrontalLdl(upper_of(matrix))
    factors.factor(upper_of(matrix).data)
    other = sparse.csc_matrix(matrix - 0.3 * sparse.diags(matrix.diagonal()))
    for width in (1, 4, 8, 13, 16, 41):
        vectors = np.random.default_rng(5).standard_normal((len(matrix.indptr) - 1, width))
        slope, weights, away = np.random.default_rng(6).standard_normal((3, len(vectors)))
        moves = 0.3 * vectors - 0.7 * np.linalg.solve(matrix.toarray(), weights[:, None] * vectors)
        moves[:, -1] -= away
        expected = moves.T @ (other @ moves), moves.T @ slope
        for given in (vectors, np.asfortranarray(vectors), np.repeat(vectors, 2, axis=1)[:, ::2]):
            found = strained(factors, upper_of(other), given)
            for one, wanted in zip(found, expected, strict=True):
                np.testing.assert_allclose(one, wanted, rtol=1e-11, atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("added", [False, True])
def test_solutions_conserve_the_angular_momentum(added: bool) -> None:
    """The scaled angular momentum of a solution equals that of its right-hand side, also with a low-rank term."""
    matrix = PATTERNS["grid of nodes"]
    count, random = len(matrix.indptr) - 1, np.random.default_rng(8)
    factors = MultifrontalLdl(upper_of(matrix))
    factors.factor(upper_of(matrix).data)
    if added:
        assert factors.add_low_rank(random.standard_normal((count, 4)), np.ones(4))
    turns, mass, ratio = random.standard_normal((count, 3)), random.uniform(1.0, 2.0, (count, 1)), 1.1
    turned = factors.solve(mass * turns)
    kept = MomentumProjection(turns, mass * turns, ratio, turned, np.linalg.inv(ratio * (mass * turns).T @ turned))
    right = random.standard_normal((count, 21))
    for given in (right, right[:, 3], right[:, ::-2]):
        found, plain = factors.solve(given, kept), factors.solve(given)
        np.testing.assert_allclose(ratio * (mass * turns).T @ found, turns.T @ given, atol=1e-12 * count)
        np.testing.assert_allclose(found, kept.corrected(given, plain), atol=1e-13 * np.abs(plain).max())
        assert np.abs(found - plain).max() > 1e-6


def test_sparse_right_hand_sides() -> None:
    """Solutions are correct for columns with few nonzero entries, for which some blocks are skipped."""
    matrix = PATTERNS["grid of nodes"]
    count = len(matrix.indptr) - 1
    factors = MultifrontalLdl(upper_of(matrix))
    factors.factor(upper_of(matrix).data)
    right = np.eye(count)[:, [0, 1, 7, count // 2, count - 1]]
    np.testing.assert_allclose(factors.solve(right), np.linalg.solve(matrix.toarray(), right), atol=1e-13)


def test_the_same_bits_on_any_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    matrix, found = PATTERNS["grid of nodes"], []
    right = np.random.default_rng(7).standard_normal((len(matrix.indptr) - 1, 50))
    for threads in ("1", "2"):
        monkeypatch.setenv(THREADS, threads)
        factors = MultifrontalLdl(upper_of(matrix))
        factors.factor(upper_of(matrix).data)
        found.append((factors.solve(right), *strained(factors, upper_of(matrix), right)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_solvers_with_a_shared_analysis_have_their_own_factors() -> None:
    """Two solvers that share a symbolic analysis give the same bits as solvers with an analysis each."""
    upper = upper_of(random_matrix(60, 12.0))
    analysis, right = SymbolicFactorization.of(upper), np.random.default_rng(5).standard_normal((60, 3))
    shared = [MultifrontalLdl(upper, analysis) for _ in range(2)]
    for scale, factors in zip((1.0, 3.0), shared, strict=True):
        assert is_definite(factors, scale * upper.data)
    for scale, factors in zip((1.0, 3.0), shared, strict=True):
        alone = MultifrontalLdl(upper)
        assert is_definite(alone, scale * upper.data)
        assert np.array_equal(factors.solve(right), alone.solve(right))


def test_a_negligible_pivot_has_no_factors() -> None:
    """A matrix with a negligible pivot, at the start or in the middle of a block, has no factors; an indefinite matrix
    has factors."""
    matrix = PATTERNS["full, of fifty"].toarray()
    whole = upper_of(sparse.csc_matrix(matrix))
    factors = MultifrontalLdl(whole)
    # Build a matrix whose Schur complement at the last of k rows, in the order of elimination, is ``share`` times the
    # diagonal entry.
    place = np.argsort(factors.permutation)
    for k in (1, 17, 50):
        inside, last = place[: k - 1], place[k - 1]
        schur = matrix[last, inside] @ np.linalg.solve(matrix[np.ix_(inside, inside)], matrix[inside, last])
        for share, ready in ((1e-16, False), (-0.1, True)):
            changed = matrix.copy()
            changed[last, last] = schur + share * matrix[last, last]
            data = upper_of(sparse.csc_matrix(np.where(changed == 0.0, 1e-300, changed))).data
            assert not is_definite(factors, data) and has_factors(factors) == ready
            if ready:
                assert factors.negative_pivots == 1
                np.testing.assert_allclose(
                    changed @ factors.solve(matrix[:, :3]), matrix[:, :3], atol=1e-9 * matrix.max()
                )
    assert is_definite(factors, whole.data)


@pytest.mark.parametrize("size", [2, 7, 60])
def test_an_inverse_has_the_count_of_positive_eigenvalues(size: int) -> None:
    """The inverse of any symmetric matrix is returned with its number of positive eigenvalues, also for zero diagonals
    and 2 x 2 pivots. The upper triangle is not read."""
    random = np.random.default_rng(size)
    for diagonal in (0.0, 1.0, 10.0, -10.0):
        lower = np.tril(random.normal(size=(size, size)), -1)
        matrix = lower + lower.T + diagonal * np.diag(random.normal(size=size))
        positive, inverse = inverse_and_positives(np.tril(matrix) + np.triu(np.full_like(matrix, 7.0), 1))
        assert positive == (np.linalg.eigvalsh(matrix) > 0.0).sum()
        np.testing.assert_allclose(inverse @ matrix, np.eye(size), atol=1e-8)
    positive, inverse = inverse_and_positives(np.zeros((size, size)))
    assert positive < 0 and not np.isfinite(inverse).any()
