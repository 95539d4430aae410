"""Tiled inverse factors on a GPU agree with NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.dissection import Dissection
from tests.support.slab_matrices import slab_matrix

pytest.importorskip("torch")

import torch

from egs_warp.fem.cuda_graphs import GraphStream
from egs_warp.fem.tiled_inverse import TiledInverseFactor

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


@pytest.mark.cuda
@pytest.mark.parametrize(("parts", "between"), SIZES)
def test_tiles_make_the_inverse_of_a_factor(parts: list[int], between: int) -> None:
    """Previous contents of the output do not matter; results are bitwise equal, also after an indefinite matrix and for
    any number of blocks."""
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
