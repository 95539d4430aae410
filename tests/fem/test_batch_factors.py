"""Cholesky factors of many matrices by panels, against NumPy's solutions."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import torch

from egs_warp.fem.batch_factors import BatchCholesky

COUNT, SIZE = 5, 53


@pytest.fixture
def matrices() -> np.ndarray:
    """(5, 53, 53), the third indefinite, the fourth with a NaN."""
    half = np.random.default_rng(0).normal(size=(COUNT, SIZE, SIZE))
    made = half @ np.swapaxes(half, 1, 2) + SIZE * np.eye(SIZE)
    made[2] -= 1.01 * np.linalg.eigvalsh(made[2])[0] * np.eye(SIZE)
    made[3, 40, 7] = np.nan
    return made


@pytest.mark.parametrize("panel", [8, 53, 96])
@pytest.mark.parametrize("chunk_bytes", [1, 2**31])
def test_solutions_equal_those_of_numpy(matrices: np.ndarray, panel: int, chunk_bytes: int) -> None:
    """In all slots, in some of them, and after some slots were overwritten."""
    right = np.random.default_rng(1).normal(size=(COUNT, SIZE, 3))
    upper = sparse.csc_array(np.triu(np.ones((SIZE, SIZE))))
    factors = BatchCholesky(upper, COUNT, torch.device("cpu"), panel=panel, chunk_bytes=chunk_bytes)
    every = torch.arange(COUNT)
    given = torch.from_numpy(np.tril(matrices))
    assert factors.factor(every, given).tolist() == [True, True, False, False, True]
    fine = [0, 1, 4]
    for slots in (every, torch.tensor(fine)):
        made = factors.solve(slots, torch.from_numpy(right)[slots]).numpy()
        at = [slots.tolist().index(slot) for slot in fine]
        np.testing.assert_allclose(made[at], np.linalg.solve(matrices[fine], right[fine]), rtol=0, atol=1e-13)
    assert factors.factor(torch.tensor([2]), torch.from_numpy(matrices[:1].copy())).tolist() == [True]
    made = factors.solve(torch.tensor([1, 2]), torch.from_numpy(right[1:3])).numpy()
    np.testing.assert_allclose(made, np.linalg.solve(matrices[[1, 0]], right[1:3]), rtol=0, atol=1e-13)
