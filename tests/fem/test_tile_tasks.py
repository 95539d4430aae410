"""Tile tasks: executed in sequence, they compute the inverse of a Cholesky factor."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.linalg import cholesky, inv

from egs_warp.fem.tile_tasks import TileTaskGraph
from egs_warp.kernels.fem.tiled_inverse import TASK_SIZE, TILE_SIDE, Kind
from tests.support.slab_matrices import slab_matrix

SIZES = [([1], 0), ([64], 0), ([200], 0), ([1, 1], 1), ([65, 3, 130], 70), ([64, 192, 90, 300], 129)]


def padded(entries: np.ndarray, *, unit: bool) -> np.ndarray:
    """Pad ``entries`` to (``TILE_SIDE``, ``TILE_SIDE``) with the identity or zeros."""
    tile = np.eye(TILE_SIDE) if unit else np.zeros((TILE_SIDE, TILE_SIDE))
    tile[: len(entries)] = tile[:, : entries.shape[1]] = 0.0
    tile[: len(entries), : entries.shape[1]] = entries
    return tile


def work(plan: TileTaskGraph, matrix: np.ndarray) -> np.ndarray:
    """Execute the tasks for ``matrix``; a tile that is read before it is written raises ``KeyError``."""
    tiles: dict[int, np.ndarray] = {}
    inverses: dict[int, np.ndarray] = {}
    root = np.full_like(matrix, np.nan)

    def keep(number: int, tile: np.ndarray) -> None:
        assert number not in tiles and 0 <= number < plan.tiles
        tiles[number] = tile

    for task in plan.tasks.tolist():
        kind, row, rows, column, width, by, first, last, out, diagonal, transposed, initial, diagonal_sum = task[:13]
        own, target = slice(row, row + rows), slice(column, column + width)
        if kind == Kind.ZEROS:
            root[own, :column] = root[own, width:] = 0.0
            continue
        if initial >= 0:
            tile = tiles[initial].copy()
        elif kind == Kind.UNIT:
            tile = np.zeros((TILE_SIDE, TILE_SIDE))
        else:
            tile = padded(matrix[own, target], unit=row == column)
        beside = tiles[diagonal_sum].copy() if diagonal_sum >= 0 else padded(matrix[own, own], unit=True)
        for one, other in plan.pairs[first:last].tolist():
            tile -= tiles[one] @ tiles[other].T
            beside -= tiles[one] @ tiles[one].T
        if kind == Kind.SUM:
            keep(out, tile)
            continue
        if kind == Kind.FIRST:
            beside = tile
        else:
            tile = tile @ inverses[by].T
            keep(out, tile)
            beside -= tile @ tile.T
        if kind == Kind.UNIT:
            root[target, own] = tile[:rows, :width].T
        if kind in (Kind.FIRST, Kind.CHAINED):
            assert diagonal not in inverses
            inverses[diagonal] = inv(cholesky(beside))
            keep(transposed, inverses[diagonal].T)
            root[own, own] = inverses[diagonal][:rows, :rows]
    assert len(tiles) == plan.tiles and len(inverses) == plan.columns
    return root


@pytest.mark.parametrize(("parts", "between"), SIZES)
def test_tasks_make_the_inverse_of_a_factor(parts: list[int], between: int) -> None:
    matrix = slab_matrix(parts, between, seed=len(parts))
    plan = TileTaskGraph(parts, between)
    assert plan.tasks.shape[1] == TASK_SIZE
    np.testing.assert_allclose(work(plan, np.tril(matrix)), inv(cholesky(matrix)), rtol=0, atol=1e-13)
