"""Cholesky factorisation of many matrices by panels: solutions compared with NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import torch

from egs_warp.fem.panel_cholesky import PanelCholesky

COUNT, SIZE = 5, 53


@pytest.fixture
def matrices() -> np.ndarray:
    """Return five symmetric matrices (5, 53, 53); the third is indefinite, the fourth has a NaN."""
    half = np.random.default_rng(0).normal(size=(COUNT, SIZE, SIZE))
    made = half @ np.swapaxes(half, 1, 2) + SIZE * np.eye(SIZE)
    made[2] -= 1.01 * np.linalg.eigvalsh(made[2])[0] * np.eye(SIZE)
    made[3, 40, 7] = np.nan
    return made


@pytest.mark.parametrize("panel", [8, 53, 96])
@pytest.mark.parametrize("chunk_bytes", [1, 2**31])
def test_solutions_equal_those_of_numpy(matrices: np.ndarray, panel: int, chunk_bytes: int) -> None:
    """Solutions are compared in all slots, in a subset of them, and after one slot was overwritten."""
    right = np.random.default_rng(1).normal(size=(COUNT, SIZE, 3))
    upper = sparse.csc_array(np.triu(np.ones((SIZE, SIZE))))
    factors = PanelCholesky(upper, COUNT, torch.device("cpu"), panel=panel, chunk_bytes=chunk_bytes)
    zero, every = torch.zeros(SIZE), torch.arange(COUNT)
    rows, columns = upper.indices, np.repeat(np.arange(SIZE), np.diff(upper.indptr))
    entries = torch.from_numpy(matrices[:, columns, rows])
    factors.factor(entries, zero, every)
    assert factors.status.tolist() == [2, 2, 0, 0, 2]
    fine = [0, 1, 4]
    for worlds in (every, torch.tensor(fine)):
        made = factors.solve(torch.from_numpy(right)[worlds], worlds).numpy()
        at = [worlds.tolist().index(world) for world in fine]
        np.testing.assert_allclose(made[at], np.linalg.solve(matrices[fine], right[fine]), rtol=0, atol=1e-13)
    # Slot 2 is overwritten with twice the first matrix, given as entries, a diagonal and a low-rank term.
    half = torch.from_numpy(np.tril(matrices[:1]))
    diagonal = half[0].diagonal()

    def add_term(lower: torch.Tensor) -> None:
        lower += half - torch.diag(diagonal)

    factors.factor(entries[:1], diagonal, torch.tensor([2]), add_term)
    assert factors.status.tolist() == [2, 2, 2, 0, 2]
    made = factors.solve(torch.from_numpy(right[1:3]), torch.tensor([1, 2])).numpy()
    expected = np.linalg.solve(np.stack([matrices[1], 2.0 * matrices[0]]), right[1:3])
    np.testing.assert_allclose(made, expected, rtol=0, atol=1e-13)
