"""The tiles of the inverse of a factor, one task each, in an order in which none waits for a later one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from egs_warp.kernels.fem.tiled_inverse import TASK_SIZE, TILE_SIDE, Kind

_LEAST = 8
"""Products that are worth a task of their own."""


class TileTaskGraph:
    """What ``inverse_root_kernel`` does for a matrix in the order of its slabs: ``parts`` of so many unknowns, which do
    not meet, and so many ``between`` them.

    With L the factor of S, columns of the tiles of L and, below these, of L^-T are found one after the other: a tile of
    S, or of the unit matrix, less the products of those to the left of it in its rows and in the rows of its column's
    diagonal, times the inverse of the factor there. Rows of parts do not meet, so that all parts go on at once. What
    their columns add to those between is summed on the way.
    """

    tasks: np.ndarray
    """(t, TASK) int32, see ``inverse_root``."""
    pairs: np.ndarray
    """(p, 2) int32: tiles whose products are summed."""
    tiles: int
    """How many are kept."""
    columns: int
    """Of tiles."""

    def __init__(self, parts: Sequence[int], between: int) -> None:
        ends = np.cumsum([0, *parts, between]).tolist()
        self._spans: list[tuple[int, int]] = []
        groups: list[range] = []
        for first, last in pairwise(ends):
            begin = len(self._spans)
            self._spans += [(start, min(TILE_SIDE, last - start)) for start in range(first, last, TILE_SIDE)]
            groups.append(range(begin, len(self._spans)))
        *self._parts, self._between = groups
        self._group = {column: group for group in groups for column in group}
        self.columns = len(self._spans)
        self._tiles: dict[tuple[int, ...], int] = {}
        self._sums: dict[tuple[int, int], tuple[int, int]] = {}
        self._tasks: list[tuple[int, ...]] = []
        self._pairs: list[tuple[int, int]] = []
        # The columns of all parts, as they are found.
        depth = max(len(part) for part in self._parts)
        self._levels = [[part[level] for part in self._parts if level < len(part)] for level in range(depth)]
        self._found = [column for level in self._levels for column in level]
        self._eliminate_parts()
        self._eliminate_between()
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
                for row in self._between:
                    self._tile(Kind.ROWS, row, column)
            for column in level:
                for row in range(self._group[column][0], column):
                    self._tile(Kind.UNIT, self.columns + row, column)
            known = sum(len(each) for each in self._levels[: depth + 1])
            if known - summed >= _LEAST and known < len(self._found):
                for column in self._between:
                    for row in range(column, self._between.stop):
                        self._sum(row, column, self._found[summed:known])
                summed = known

    def _eliminate_between(self) -> None:
        for depth, column in enumerate(self._between):
            if depth == 0:
                self._diagonal(self._between, 0)
            if depth + 1 < len(self._between):
                self._diagonal(self._between, depth + 1)
            for row in self._between[depth + 2 :]:
                self._tile(Kind.ROWS, row, column)
            for level in self._levels:
                for row in level:
                    self._tile(Kind.UNIT, self.columns + row, column)
            for row in self._between[:depth]:
                self._tile(Kind.UNIT, self.columns + row, column)

    def _clear(self, groups: Iterable[range]) -> None:
        """Above what the tiles fill."""
        for group in groups:
            for column in group:
                start, count = self._spans[column]
                first = 0 if group is self._between else self._spans[group[0]][0]
                self._add(Kind.ZEROS, start, count, first, start + count)

    def _diagonal(self, group: range, depth: int) -> None:
        """The inverse of the factor there, and the tile to the left of it in its group."""
        column = group[depth]
        made = {"made": column, "turned": self._place(self.columns + column, column)}
        if depth == 0:
            self._tile(Kind.FIRST, column, column, **made)
        else:
            self._tile(
                Kind.CHAINED, column, group[depth - 1], square=self._sums.get((column, column), (-1, 0))[0], **made
            )

    def _sum(self, row: int, column: int, factors: Sequence[int]) -> None:
        """The products of some more ``factors`` less."""
        before, count = self._sums.get((row, column), (-1, 0))
        tile = self._place(row, column, count)
        first = self._products(row, column, factors)
        spans = (*self._spans[row], *self._spans[column])
        self._add(Kind.SUM, *spans, column, first, len(self._pairs), tile, begun=before)
        self._sums[row, column] = tile, count + len(factors)

    def _tile(self, kind: Kind, row: int, column: int, **more: int) -> None:
        begun, count = self._sums.get((row, column), (-1, 0))
        first = self._products(row, column, self._factors(row, column)[count:])
        tile = -1 if kind is Kind.FIRST else self._place(row, column)
        spans = (*self._spans[row % self.columns], *self._spans[column])
        self._add(kind, *spans, column, first, len(self._pairs), tile, begun=begun, **more)

    def _factors(self, row: int, column: int) -> Sequence[int]:
        """Columns in which both this row and that of the diagonal in this ``column`` have a tile."""
        group = self._group[column]
        if row >= self.columns:
            unit = row - self.columns
            own = self._group[unit]
            return range(unit, column) if own is group else [*range(unit, own.stop), *range(group.start, column)]
        return [*self._found, *range(group.start, column)] if group is self._between else range(group.start, column)

    def _products(self, row: int, column: int, factors: Sequence[int]) -> int:
        first = len(self._pairs)
        self._pairs += [(self._place(row, factor), self._place(column, factor)) for factor in factors]
        return first

    def _place(self, *tile: int) -> int:
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
        made: int = -1,
        turned: int = -1,
        begun: int = -1,
        square: int = -1,
    ) -> None:
        task = (kind, row, rows, column, width, by, first, last, tile, made, turned, begun, square)
        self._tasks.append((*task, *[0] * (TASK_SIZE - len(task))))
