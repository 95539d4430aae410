"""Dense and sparse factors, which give the same solutions and agree on which matrices are definite."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.dissection import Dissection
from egs_warp.fem.multifrontal import MultifrontalLdl

pytest.importorskip("torch")

import torch

from egs_warp.fem.cuda_graphs import GraphStream
from egs_warp.fem.tiled_cholesky import TiledCholesky, TiledInverseFactor, _TriangularInverse
from egs_warp.kernels.fem.triangles import MAX_ROWS
from tests.support.factors import has_factors, is_definite
from tests.support.slab_matrices import slab_matrix

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
SIZES = [
    ([1], 0),
    ([7], 0),
    ([64], 0),
    ([65], 0),
    ([259], 0),
    ([1, 1], 1),
    ([100, 1, 65], 70),
    ([64, 128], 64),
    ([200, 190, 210, 150], 129),
    ([1, 504, 426, 468], 305),
]
"""Number of unknowns of each slab, and number of unknowns of the separator."""


def entries_of(upper: sparse.csc_matrix, seed: int, diagonal: float) -> np.ndarray:
    """Return the entries (nnz,) of a random symmetric matrix with the pattern of ``upper``."""
    entries = np.random.default_rng(seed).normal(size=upper.nnz)
    entries[upper.indptr[1:] - 1] += diagonal
    return entries


def pattern(count: int) -> sparse.csc_matrix:
    """Return a random pattern of an upper triangle with the diagonal and a tenth of the other entries."""
    filled = np.triu(np.random.default_rng(3).random((count, count)) < 0.1) | np.eye(count, dtype=bool)
    upper = sparse.csc_matrix(filled.astype(float))
    upper.sort_indices()
    return upper


def band(count: int) -> sparse.csc_matrix:
    """Return the upper triangle of a band matrix with bandwidth four."""
    return sparse.csc_matrix(np.triu(np.tri(count, k=4).T.astype(float)) * (np.tri(count, k=4) > 0))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 7, 64, 65, 130, 259])
def test_matrices_of_every_size_are_inverted_by_halves(count: int, device: str) -> None:
    """Dense and sparse factors solve a matrix plus a diagonal; a matrix with NaN is rejected."""
    upper = pattern(count)
    dense, thin = TiledCholesky(upper, device=device), MultifrontalLdl(upper)
    random = np.random.default_rng(count)
    right = random.normal(size=(count, 3))
    for seed in range(3):
        entries, diagonal = entries_of(upper, seed, 1.0), 40.0 + random.random(count)
        assert is_definite(dense, entries, diagonal) and is_definite(thin, entries, diagonal)
        half = sparse.csc_matrix((entries, upper.indices, upper.indptr), upper.shape).toarray()
        matrix = half + np.triu(half, 1).T + np.diag(diagonal)
        for factors in (dense, thin):
            assert np.abs(matrix @ factors.solve(right) - right).max() < 1e-11
    entries[-1] = np.nan
    assert not any(is_definite(factors, entries, diagonal) for factors in (dense, thin)) and not has_factors(dense)


@pytest.mark.parametrize("count", [3, 64, 65, 129, 500, 1704])
def test_diagonal_blocks_fill_one_thread_block(count: int) -> None:
    """The side of a diagonal block is even and, unless one block covers the matrix, more than half of the kernel's
    maximum. Together, the blocks cover the matrix."""
    inverse = _TriangularInverse(count, GraphStream(torch.device("cpu")))
    side, size = inverse._side, inverse._size
    assert side % 2 == 0 and side <= MAX_ROWS and (2 * side > MAX_ROWS or size == side)
    assert count <= size <= 1.1 * count + 2 and size % side == 0


@pytest.mark.parametrize("device", DEVICES)
def test_slabs_of_a_long_body_are_factored_at_once(device: str) -> None:
    """The factors are correct in repeated calls, which replay a captured graph, and with a low-rank term between two
    matrices. A matrix that is indefinite only in a slab or only in the separator has no factors."""
    count = 150
    upper = band(count)
    slabs = Dissection.of(upper)
    assert len(slabs.parts) > 2
    factors = TiledCholesky(upper, device=device)
    random = np.random.default_rng(0)
    right, across, rates = random.normal(size=(count, 5)), random.normal(size=(count, 3)), np.array([2.0, -0.01, 1.0])
    for seed in range(4):
        entries = entries_of(upper, seed, 12.0)
        half = sparse.csc_matrix((entries, upper.indices, upper.indptr), upper.shape).toarray()
        matrix = half + np.triu(half, 1).T
        assert is_definite(factors, entries)
        assert np.abs(matrix @ factors.solve(right) - right).max() < 1e-12
        root = factors.inverse.cpu().numpy()
        np.testing.assert_allclose(root.T @ root, np.linalg.inv(matrix), rtol=0, atol=1e-13)
        assert factors.add_low_rank(across, rates)
        both = matrix + across * rates @ across.T
        assert np.abs(both @ factors.solve(right) - right).max() < 1e-11
    for wrong in (slabs.parts[0][0], slabs.parts[-1][-1], slabs.separator[0]):
        lower = np.zeros(count)
        lower[wrong] = -40.0
        assert not is_definite(factors, entries, lower) and is_definite(factors, entries)
        assert np.abs(matrix @ factors.solve(right) - right).max() < 1e-12


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("diagonal", [30.0, 1.0])
def test_dense_and_sparse_factors_agree(diagonal: float, device: str) -> None:
    """Solutions and quadratic models agree to rounding, with and without a low-rank term; an indefinite matrix has no
    dense factors, but its sum with a low-rank term may have them.
    """
    upper = pattern(60)
    dense, thin = TiledCholesky(upper, device=device), MultifrontalLdl(upper)
    random = np.random.default_rng(7)
    right = random.normal(size=(60, 40))
    across, rates = random.normal(size=(60, 8)), 0.1 * random.normal(size=8)
    for seed in range(5):
        entries = entries_of(upper, seed, diagonal)
        definite = is_definite(thin, entries)
        assert is_definite(dense, entries) == has_factors(dense) == definite == (diagonal == 30.0)
        half = sparse.csc_matrix((entries, upper.indices, upper.indptr), upper.shape).toarray()
        matrix = half + np.triu(half, 1).T
        if definite:
            slope, weights, away = random.normal(size=(3, 60))
            for found, expected in zip(
                *(
                    one.quadratic_form(entries, slope, weights, right, dt_now=0.2, dt_ahead=0.5, reference=away)
                    for one in (dense, thin)
                ),
                strict=True,
            ):
                assert np.abs(found - expected).max() < 1e-11 * np.abs(expected).max()
        if definite:
            assert np.abs(dense.solve(right) - thin.solve(right)).max() < 1e-12
            assert np.abs(dense.solve(right[:, 0]) - thin.solve(right[:, 0])).max() < 1e-12
        assert dense.add_low_rank(across, rates) == thin.add_low_rank(across, rates) == definite
        if definite:
            assert np.abs(dense.solve(right) - thin.solve(right)).max() < 1e-12
        # A low-rank term that is rejected changes nothing.
        assert not dense.add_low_rank(across, np.full(8, -1e3)) and not thin.add_low_rank(across, np.full(8, -1e3))
        assert is_definite(dense, entries) == is_definite(thin, entries) == definite
        if definite:
            assert not dense.add_low_rank(across, np.full(8, -1e3)) and not thin.add_low_rank(across, np.full(8, -1e3))
            assert np.abs(dense.solve(right) - thin.solve(right)).max() < 1e-12
        # The term has equal stiffness along every axis, large enough that the sum is definite.
        assert (
            dense.add_low_rank(np.eye(60), np.full(60, 40.0))
            and thin.add_low_rank(np.eye(60), np.full(60, 40.0))
            and has_factors(dense)
        )
        assert np.abs(dense.solve(right) - thin.solve(right)).max() < 1e-10
        assert np.abs((matrix + 40.0 * np.eye(60)) @ dense.solve(right) - right).max() < 1e-10


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 70])
def test_low_rank_terms_need_no_new_factorization(count: int, device: str) -> None:
    """Low-rank terms are added to and subtracted from a factored matrix. If the sum is indefinite, there are no factors
    until the next matrix is factored."""
    upper, random = pattern(60), np.random.default_rng(5)
    factors, right = TiledCholesky(upper, device=device), random.normal(size=(60, 4))
    directions = np.vstack([random.normal(size=(count, 60)), np.zeros((3, 60))])
    for seed, strengths, definite in [(0, (3.0, 0.1), True), (1, (1e3, 0.0), True), (2, (0.1, 90.0), False)]:
        entries = entries_of(upper, seed, 30.0)
        half = sparse.csc_matrix((entries, upper.indices, upper.indptr), upper.shape).toarray()
        matrix = half + np.triu(half, 1).T
        with factors.stream:
            factors.enqueue_factor(torch.from_numpy(entries).to(device))
            for sign, strength in zip((1.0, -1.0), strengths, strict=True):
                told = np.sqrt(strength / count) * directions
                matrix = matrix + sign * told.T @ told
                factors.enqueue_low_rank(torch.from_numpy(told).to(device), sign)
        factors.mark_started()
        assert has_factors(factors) == definite == (np.linalg.eigvalsh(matrix).min() > 0.0)
        if definite:
            found = factors.solve(right)
            assert np.abs(matrix @ found - right).max() < 1e-11
            np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=0, atol=1e-13)


@pytest.mark.parametrize("device", DEVICES)
def test_non_finite_matrices_have_no_factors(device: str) -> None:
    upper = pattern(20)
    factors = TiledCholesky(upper, device=device)
    for value in (np.nan, np.inf):
        assert not is_definite(factors, np.full(upper.nnz, value)) and not has_factors(factors)
        assert not factors.add_low_rank(np.eye(20), np.ones(20)) and not has_factors(factors)
    assert is_definite(factors, entries_of(upper, 0, 30.0)) and has_factors(factors)
    assert not factors.add_low_rank(np.full((20, 1), np.nan), np.ones(1))


@pytest.mark.cuda
def test_factors_keep_temporary_memory_of_warp() -> None:
    """The temporary memory of Warp's sorts on the stream must not be freed, in particular not during a capture."""
    upper = band(150)
    factors, count = TiledCholesky(upper, device="cuda:0"), 1000
    for seed in range(3):
        keys, values = (wp.array(np.arange(2 * count)[::-1].astype(np.int32), dtype=int, device="cuda:0") for _ in "kv")
        wp.utils.radix_sort_pairs(keys, values, count)
        assert is_definite(factors, entries_of(upper, seed, 12.0))
        assert np.array_equal(keys.numpy()[:count], np.arange(count, 2 * count))


@pytest.mark.cuda
@pytest.mark.parametrize(("parts", "between"), SIZES)
def test_tiles_make_the_inverse_of_a_factor(parts: list[int], between: int) -> None:
    """Results do not depend on previous contents of the output, and are bitwise equal after an indefinite matrix and
    for any number of thread blocks."""
    count = sum(parts) + between
    random = np.random.default_rng(count)
    order = random.permutation(count)
    *cuts, _ = np.cumsum([*parts, between])
    *slabs, rest = np.split(order, cuts)
    given = slab_matrix(parts, between, seed=count)
    matrix, inverse = torch.zeros((2, count, count), dtype=torch.float64, device="cuda")
    tiled = TiledInverseFactor(Dissection(slabs, rest), matrix, inverse, GraphStream(matrix.device))

    def make(entries: np.ndarray) -> bool:
        inverse.fill_(3.0)
        matrix.copy_(torch.from_numpy(np.tril(entries)))
        return bool(tiled.factor())

    assert make(given)
    root = inverse.cpu().numpy()
    factor = np.linalg.cholesky(given)
    expected = np.linalg.inv(factor)
    np.testing.assert_allclose(root[:, order], expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert np.abs(root[:, order].T @ (root[:, order] @ given) - np.eye(count)).max() < 1e-13
    for wrong, value in ((0, 0.0), (random.integers(count), -50.0), (count - 1, -1e-3), (count - 1, np.nan)):
        indefinite = given.copy()
        indefinite[wrong, wrong] = value
        assert not make(indefinite)
        for _ in range(5):
            assert make(given)
            np.testing.assert_array_equal(inverse.cpu().numpy(), root)
    for blocks in (1, 7):
        tiled._blocks = blocks
        assert make(given)
        np.testing.assert_array_equal(inverse.cpu().numpy(), root)
