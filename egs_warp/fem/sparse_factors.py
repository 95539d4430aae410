"""Factors of a step's sparse matrix, many right-hand sides at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg as dense
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.supernodes import Supernodes
from egs_warp.kernels.fem import supernodal as kernels
from egs_warp.launching import beside, launch_again
from egs_warp.precision import real

_SINGULAR = 1e-14
"""Of the largest diagonal entry: pivots that are as small have no reciprocal worth the name."""
_CPU = wp.get_device("cpu")


class SparseFactors:
    """L D L^T of symmetric matrices of one pattern by a multifrontal method; see ``Factors``. The symbolic analysis is
    done once. The same bits on any number of cores.

    Pivots are taken as they come: a definite matrix asks for no others, of one that is not only the inertia and a sum
    with muscles are wanted, and one that is next to singular has no factors.
    """

    def __init__(self, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> None:
        """``upper_pattern``: upper triangle with the diagonal, entries in the order of ``update``."""
        upper = sparse.csc_matrix(
            (np.arange(1.0, upper_pattern.nnz + 1.0), upper_pattern.indices, upper_pattern.indptr), upper_pattern.shape
        )
        full = (upper + sparse.triu(upper, 1).T).tocsc()
        full.sort_indices()
        self._full_from_upper, self._full = full.data.astype(np.int64) - 1, (full.indices, full.indptr)
        self._diagonal = upper.indptr[1:] - 1
        self._unknowns = upper.shape[0]
        self._lay_out(Supernodes.of(upper), upper)
        self._ready = False
        self._added: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        """U, S^-1 U and the inverse of the capacitance matrix."""
        self.negative_pivots = 0
        """Negative eigenvalues of the last matrix."""

    def _lay_out(self, blocks: Supernodes, upper: sparse.csc_matrix) -> None:
        """Where the numbers of each block lie."""
        widths, heights, parents = (part.astype(np.int64) for part in (blocks.widths, blocks.heights, blocks.parents))
        below = heights - widths
        strides = -(-heights // 8) * 8
        in_front = _places_in_fronts(blocks)
        # An entry lies in the columns of the block that is eliminated first.
        rows, columns = blocks.place[upper.indices], blocks.place[np.repeat(np.arange(self._unknowns), np.diff(upper.indptr))]
        lower, higher = np.minimum(rows, columns), np.maximum(rows, columns)
        block = np.repeat(np.arange(blocks.count), widths)[lower]
        order = np.argsort(block, kind="stable")
        places = in_front(block, higher) * strides[block] + lower - blocks.first[block]
        has_parent = np.flatnonzero(parents >= 0)
        children = has_parent[np.argsort(parents[has_parent], kind="stable")]
        inside = np.repeat(parents, heights)
        is_below = np.arange(len(blocks.rows)) - np.repeat(blocks.row_offsets[:-1], heights) >= np.repeat(widths, heights)
        in_parent = np.zeros(len(blocks.rows), dtype=np.int64)
        in_parent[is_below] = in_front(inside[is_below], blocks.rows[is_below])
        updates, depth = _stacked(below, parents)
        fronts = kernels.Fronts()
        for name, values in {
            "first": blocks.first,
            "widths": blocks.widths,
            "row_offsets": blocks.row_offsets,
            "rows": blocks.rows,
            "in_parent": in_parent,
            "child_offsets": _offsets(np.bincount(parents[has_parent], minlength=blocks.count)),
            "children": children,
            "entry_offsets": _offsets(np.bincount(block, minlength=blocks.count)),
            "entries": order,
            "entry_places": places[order],
            "factor_offsets": _offsets(heights * widths),
            "inverse_offsets": _offsets(-(-widths // kernels.BLOCK) * kernels.BLOCK**2),
            "update_offsets": updates,
            "place": blocks.place,
        }.items():
            setattr(fronts, name, wp.array(np.asarray(values, dtype=np.int32), dtype=int, device="cpu"))
        front_size = int((heights * strides).max())
        self._fronts, self._blocks, self._front_size = fronts, blocks.count, front_size
        self._entries, self._matrix = _shared_zeros(upper.nnz)
        sizes = (
            front_size + kernels.BLOCK * int(strides.max()),
            depth,
            int((heights * widths).sum()),
            int((-(-widths // kernels.BLOCK)).sum()) * kernels.BLOCK**2,
            self._unknowns,
        )
        self._front, self._stack, self._factor, self._inverses, self._reciprocals = (
            _shared_zeros(size + kernels.PADDING)[1] for size in sizes
        )
        self._negative, self._negative_array = np.zeros(1, np.int32), None
        self._negative_array = wp.array(self._negative, dtype=int, device="cpu", copy=False)
        self._room = _shared_zeros(0)[1]

    def update(self, entries: np.ndarray) -> bool:
        """See ``Factors``. The factors of an indefinite matrix can be solved with all the same; without any, ``solve``
        must not be called.
        """
        self._ready, self._added = False, None
        if not np.isfinite(entries).all():
            return False
        self._entries[:] = entries
        launch_again(
            kernels.factor_kernel,
            1,
            inputs=[
                self._fronts,
                self._blocks,
                self._matrix,
                _SINGULAR * float(np.abs(entries[self._diagonal]).max()),
                self._front,
                self._front_size,
                self._stack,
                self._factor,
                self._inverses,
                self._reciprocals,
            ],
            outputs=[self._negative_array],
            device=_CPU,
        )
        self._ready, self.negative_pivots = bool(self._negative[0] >= 0), int(self._negative[0])
        return self.negative_pivots == 0

    def add(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """See ``Factors``: by Woodbury's formula, also where S alone is not definite."""
        if not self.ready:
            return False
        if len(rates) == 0:
            return self.negative_pivots == 0
        self._added = None
        through = self.solve(across)
        small = across.T @ through
        small[np.diag_indices_from(small)] += 1.0 / rates
        # Haynsworth: negative eigenvalues of the sum = those of S + positive ones of the small matrix - pulling
        # directions.
        positive, inverse = inverse_and_positives(small)
        if self.negative_pivots + positive != int((rates > 0.0).sum()):
            return False
        self._added = across, through, inverse
        return True

    @property
    def ready(self) -> bool:
        """See ``Factors``."""
        return self._ready

    def solve(self, right: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        plain = self._plain(right)
        if self._added is None:
            return plain
        across, through, small = self._added
        return plain - through @ (small @ (across.T @ plain))

    def quadratic(self, entries: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        matrix = sparse.csr_matrix((entries[self._full_from_upper], *self._full), shape=(len(moves), len(moves)))
        moves = np.ascontiguousarray(moves)
        half = moves.shape[1] // 2
        parts = beside(lambda: moves.T @ (matrix @ moves[:, :half]), lambda: moves.T @ (matrix @ moves[:, half:]))
        return np.hstack(parts)

    def take(self, values: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        return values

    def give(self, values: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        return values

    def _plain(self, right: np.ndarray) -> np.ndarray:
        assert self._ready, "update() comes first"
        right = np.asarray(right, dtype=np.float64)
        count = 1 if right.ndim == 1 else right.shape[1]
        solution = np.empty(right.shape)
        strides = [stride // 8 for stride in right.strides]
        panels = -(-count // kernels.PANEL)
        if self._room.size < panels * (self._unknowns + 4) * kernels.PANEL:
            self._room = _shared_zeros(panels * (self._unknowns + 4) * kernels.PANEL)[1]
        inputs = [
            self._fronts,
            self._blocks,
            self._unknowns,
            self._factor,
            self._inverses,
            self._reciprocals,
            right.ctypes.data,
            strides[0],
            strides[1] if right.ndim > 1 else 0,
            count,
            self._room,
            solution.ctypes.data,
        ]

        def solve(first: int, last: int) -> None:
            launch_again(kernels.solve_kernel, last - first, inputs=[first, *inputs], outputs=[], device=_CPU)

        if panels < 2:
            solve(0, panels)
        else:
            beside(lambda: solve(0, (panels + 1) // 2), lambda: solve((panels + 1) // 2, panels))
        return solution


def _offsets(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])


def _shared_zeros(size: int) -> tuple[np.ndarray, wp.array]:
    values = np.zeros(size)
    return values, wp.array(values, dtype=real, device="cpu", copy=False)


def _places_in_fronts(blocks: Supernodes) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Where permuted rows lie in the fronts of given blocks."""
    owner = np.repeat(np.arange(blocks.count, dtype=np.int64), blocks.heights)
    keys = owner * len(blocks.place) + blocks.rows

    def found(block: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.searchsorted(keys, block * len(blocks.place) + row) - blocks.row_offsets[block]

    return found


def _stacked(below: np.ndarray, parents: np.ndarray) -> tuple[np.ndarray, int]:
    """(S,) where on a stack each block leaves what its parent is still to take, and how much room all need: a block
    takes its children's off before it leaves its own."""
    waiting: list[int] = []
    where, top, most = np.zeros(len(below), dtype=np.int64), 0, 0
    for block, size in enumerate(below):
        while waiting and parents[waiting[-1]] == block:
            top -= int(below[waiting.pop()]) ** 2
        where[block] = top
        top += int(size) ** 2
        most = max(most, top)
        waiting.append(block)
    return where, most


def inverse_and_positives(symmetric: np.ndarray) -> tuple[int, np.ndarray]:
    """How many eigenvalues of the lower triangle's matrix (n, n) are positive, and its inverse, from one
    Bunch-Kaufman factorisation; not finite where the matrix is singular.
    """
    factor, invert = dense.get_lapack_funcs(("sytrf", "sytri"), (symmetric,))
    factors, pivots, info = factor(symmetric, lower=1)
    if info > 0:
        return -1, np.full_like(symmetric, np.nan)
    # A block of two, marked by negative pivots, has an eigenvalue of each sign.
    positive = int((factors.diagonal()[pivots > 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2
    inverse, _ = invert(factors, pivots, lower=1)
    lower = np.tril(inverse, -1)
    return positive, lower + lower.T + np.diag(inverse.diagonal())
