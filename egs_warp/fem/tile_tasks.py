"""Task list of the tiled inverse Cholesky factor: one task per tile, ordered so that no task depends on a later one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from egs_warp.kernels.fem.tiled_inverse import TASK_SIZE, TILE_SIDE, Kind

_MIN_PRODUCTS = 8
"""Minimum number of products for a separate task that sums them."""


class TileTaskGraph:
    """Tasks of ``tiled_inverse_kernel`` for a matrix in the order of its dissection.

    With L the factor of S, the columns of tiles of L and, below them, of L^-T are computed one after the other. The
    tile of L in row i and column j is (S_ij - sum_k L_ik L_jk^T) L_jj^-T, with the sum over the columns k to its left.
    In the rows of L^-T, the identity takes the place of S. Parts share no rows, so all parts proceed in parallel.
    Meanwhile, separate tasks sum their contributions to the separator.
    """

    tasks: np.ndarray
    """(t, ``TASK_SIZE``) int32 task records (``kernels.fem.tiled_inverse.TASK_SIZE``)."""
    pairs: np.ndarray
    """(p, 2) int32, slots of the tiles whose products are summed."""
    tiles: int
    """Number of tiles to store."""
    columns: int
    """Number of tile columns."""

    def __init__(self, parts: Sequence[int], separator: int) -> None:
        """Build the tasks for ``parts`` and a ``separator`` with the given numbers of unknowns."""
        ends = np.cumsum([0, *parts, separator]).tolist()
        self._spans: list[tuple[int, int]] = []
        groups: list[range] = []
        for first, last in pairwise(ends):
            first_column = len(self._spans)
            self._spans += [(start, min(TILE_SIDE, last - start)) for start in range(first, last, TILE_SIDE)]
            groups.append(range(first_column, len(self._spans)))
        *self._parts, self._separator = groups
        self._group = {column: group for group in groups for column in group}
        self.columns = len(self._spans)
        self._tiles: dict[tuple[int, ...], int] = {}
        self._sums: dict[tuple[int, int], tuple[int, int]] = {}
        self._tasks: list[tuple[int, ...]] = []
        self._pairs: list[tuple[int, int]] = []
        # Columns of all parts, in the order of their computation.
        depth = max(len(part) for part in self._parts)
        self._levels = [[part[level] for part in self._parts if level < len(part)] for level in range(depth)]
        self._part_columns = [column for level in self._levels for column in level]
        self._eliminate_parts()
        self._eliminate_separator()
        self._clear(groups)
        self.tasks = np.array(self._tasks, dtype=np.int32)
        self.pairs = np.array(self._pairs or [(0, 0)], dtype=np.int32)
        self.tiles = len(self._tiles)

    def _eliminate_parts(self) -> None:
        for part in self._parts:
            self._diagonal(part, 0)
        summed = 0
        for depth, level in enumerate(self._levels):
            for part in self._parts:
                if depth + 1 < len(part):
                    self._diagonal(part, depth + 1)
            for below in range(depth + 2, len(self._levels)):
                for part in self._parts:
                    if below < len(part):
                        self._tile(Kind.ROWS, part[below], part[depth])
            for column in level:
                for row in self._separator:
                    self._tile(Kind.ROWS, row, column)
            for column in level:
                for row in range(self._group[column][0], column):
                    self._tile(Kind.UNIT, self.columns + row, column)
            known = sum(len(each) for each in self._levels[: depth + 1])
            if known - summed >= _MIN_PRODUCTS and known < len(self._part_columns):
                for column in self._separator:
                    for row in range(column, self._separator.stop):
                        self._sum(row, column, self._part_columns[summed:known])
                summed = known

    def _eliminate_separator(self) -> None:
        for depth, column in enumerate(self._separator):
            if depth == 0:
                self._diagonal(self._separator, 0)
            if depth + 1 < len(self._separator):
                self._diagonal(self._separator, depth + 1)
            for row in self._separator[depth + 2 :]:
                self._tile(Kind.ROWS, row, column)
            for level in self._levels:
                for row in level:
                    self._tile(Kind.UNIT, self.columns + row, column)
            for row in self._separator[:depth]:
                self._tile(Kind.UNIT, self.columns + row, column)

    def _clear(self, groups: Iterable[range]) -> None:
        """Add tasks that clear the entries of the inverse outside the tiles."""
        for group in groups:
            for column in group:
                start, count = self._spans[column]
                first = 0 if group is self._separator else self._spans[group[0]][0]
                self._add(Kind.ZEROS, start, count, first, start + count)

    def _diagonal(self, group: range, depth: int) -> None:
        """Add a task for the inverse of a diagonal factor. Except in the first column of a group, the task also
        computes the tile to its left."""
        column = group[depth]
        slots = {"diagonal": column, "transposed": self._slot(self.columns + column, column)}
        if depth == 0:
            self._tile(Kind.FIRST, column, column, **slots)
        else:
            self._tile(
                Kind.CHAINED,
                column,
                group[depth - 1],
                diagonal_sum=self._sums.get((column, column), (-1, 0))[0],
                **slots,
            )

    def _sum(self, row: int, column: int, factors: Sequence[int]) -> None:
        """Add a task that subtracts the products in columns ``factors`` from a partial sum."""
        before, count = self._sums.get((row, column), (-1, 0))
        tile = self._slot(row, column, count)
        first = self._products(row, column, factors)
        spans = (*self._spans[row], *self._spans[column])
        self._add(Kind.SUM, *spans, column, first, len(self._pairs), tile, initial=before)
        self._sums[row, column] = tile, count + len(factors)

    def _tile(self, kind: Kind, row: int, column: int, **more: int) -> None:
        initial, count = self._sums.get((row, column), (-1, 0))
        first = self._products(row, column, self._factors(row, column)[count:])
        tile = -1 if kind is Kind.FIRST else self._slot(row, column)
        spans = (*self._spans[row % self.columns], *self._spans[column])
        self._add(kind, *spans, column, first, len(self._pairs), tile, initial=initial, **more)

    def _factors(self, row: int, column: int) -> Sequence[int]:
        """Return the columns in which both ``row`` and the row of the diagonal tile of ``column`` have a tile."""
        group = self._group[column]
        if row >= self.columns:
            unit = row - self.columns
            own = self._group[unit]
            return range(unit, column) if own is group else [*range(unit, own.stop), *range(group.start, column)]
        return (
            [*self._part_columns, *range(group.start, column)]
            if group is self._separator
            else range(group.start, column)
        )

    def _products(self, row: int, column: int, factors: Sequence[int]) -> int:
        first = len(self._pairs)
        self._pairs += [(self._slot(row, factor), self._slot(column, factor)) for factor in factors]
        return first

    def _slot(self, *tile: int) -> int:
        return self._tiles.setdefault(tile, len(self._tiles))

    def _add(
        self,
        kind: Kind,
        row: int,
        rows: int,
        column: int,
        width: int,
        by: int = 0,
        first: int = 0,
        last: int = 0,
        tile: int = -1,
        *,
        diagonal: int = -1,
        transposed: int = -1,
        initial: int = -1,
        diagonal_sum: int = -1,
    ) -> None:
        task = (kind, row, rows, column, width, by, first, last, tile, diagonal, transposed, initial, diagonal_sum)
        self._tasks.append((*task, *[0] * (TASK_SIZE - len(task))))
