"""Tetrahedra cut at the integer level sets of a field, and the adjacency of the resulting cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LevelSetCells:
    """Cells into which the level sets of a field cut T tetrahedra; the cells of a tetrahedron have consecutive
    levels."""

    tet_from_cell: np.ndarray
    """(C,) index of the tetrahedron of each cell."""
    level_from_cell: np.ndarray
    """(C,) level of each cell."""
    touching: np.ndarray
    """(., 2) pairs of cells on the same level that share part of a face."""
    stacked: np.ndarray
    """(., 2) pairs of cells on consecutive levels in the same tetrahedron."""
    first_cell: np.ndarray
    """(T,) index of each tetrahedron's cell on its lowest level."""
    first_level: np.ndarray
    """(T,) lowest level of each tetrahedron."""

    @property
    def count(self) -> int:
        """Number of cells C."""
        return len(self.tet_from_cell)

    @classmethod
    def cut(cls, tets: np.ndarray, level_field: np.ndarray, *, level_count: int) -> LevelSetCells:
        """Cut the tetrahedra where ``level_field`` (N,), defined at the nodes and linear in each tetrahedron, is an
        integer."""
        first, last = _level_range(level_field[tets], level_count)
        tet_from_cell, level_from_cell = _runs(first, last)
        first_cell = np.concatenate([[0], np.cumsum(last - first + 1)[:-1]])
        sides, corners = _inner_faces(tets)
        face_from_run, level = _runs(*_level_range(level_field[corners], level_count))
        owners = sides[face_from_run]
        touching = first_cell[owners] + level[:, None] - first[owners]
        below = np.flatnonzero(tet_from_cell[1:] == tet_from_cell[:-1])
        return cls(tet_from_cell, level_from_cell, touching, np.stack([below, below + 1], axis=1), first_cell, first)

    def holding(self, tets: np.ndarray, level_field: np.ndarray) -> np.ndarray:
        """Return, for points in the tetrahedra ``tets`` (S,) with field values ``level_field`` (S,), the indices (S,)
        of the cells that contain them."""
        last_level = np.append(self.first_cell[1:], self.count) - self.first_cell + self.first_level - 1
        level = np.clip(np.floor(level_field).astype(int), self.first_level[tets], last_level[tets])
        return self.first_cell[tets] + level - self.first_level[tets]


def _level_range(values: np.ndarray, level_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last levels (rows,) that each row of corner ``values`` (rows, corners) covers."""
    first = np.clip(np.floor(values.min(axis=1)).astype(int), 0, level_count - 1)
    return first, np.clip(np.ceil(values.max(axis=1)).astype(int) - 1, first, level_count - 1)


def _runs(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the row number and the level of every level from ``first`` to ``last`` (rows,) of each row."""
    counts = last - first + 1
    row = np.repeat(np.arange(len(first)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts) + first[row]


def _inner_faces(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for every inner face, its two tetrahedra (I, 2) and its three nodes (I, 3)."""
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(axis=1))
    return np.stack([order[same], order[same + 1]], axis=1) // 4, faces[order[same]]
