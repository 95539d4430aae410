"""Factors of a step's sparse matrix, many right-hand sides at once."""

from __future__ import annotations

import numpy as np
import scipy.linalg as dense
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.front_layout import Layout, indices_of
from egs_warp.fem.supernodes import Supernodes, first_of_alike
from egs_warp.kernels.fem import products as products_kernels
from egs_warp.kernels.fem import supernodal as kernels
from egs_warp.launching import beside, launch_again
from egs_warp.precision import real

_SINGULAR = 1e-14
"""Of the largest diagonal entry: pivots that are as small have no reciprocal worth the name."""
_FIRST_PART = 0.42
"""Of the columns of a symmetric product."""


class SparseFactors:
    """L D L^T of symmetric matrices of one pattern by a multifrontal method; see ``Factors``. The symbolic analysis is
    done once. The same bits on any number of cores.

    Pivots are taken as they come: a definite matrix asks for no others, of one that is not only the inertia and a sum
    with muscles are wanted, and one that is next to singular has no factors.
    """

    def __init__(self, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> None:
        """``upper_pattern``: upper triangle with the diagonal, entries in the order of ``update``."""
        self._device = wp.get_device("cpu")
        # Two threads at once cannot load them.
        for kernel in (kernels.solve_kernel, products_kernels.product_kernel):
            kernel.module.load(self._device, block_dim=1)
        upper = sparse.csc_matrix(
            (np.arange(1.0, upper_pattern.nnz + 1.0), upper_pattern.indices, upper_pattern.indptr), upper_pattern.shape
        )
        full = (upper + sparse.triu(upper, 1).T).tocsc()
        full.sort_indices()
        self._full_from_upper = full.data.astype(np.int64) - 1
        self._full_values, self._full_array = _shared_zeros(full.nnz)
        self._full = [indices_of(full.indptr), indices_of(full.indices), indices_of(first_of_alike(full))]
        self._diagonal = upper.indptr[1:] - 1
        self._unknowns = len(upper.indptr) - 1
        blocks = Supernodes.of(upper)
        self.place = blocks.place
        """(n,) of each row in the order of elimination."""
        self._layout = Layout.of(blocks, upper)
        self._entries, self._matrix = _shared_zeros(upper.nnz)
        layout = self._layout
        sizes = layout.front + layout.scratch, layout.stack, layout.factor, layout.inverses, self._unknowns
        self._front, self._stack, self._factor, self._inverses, self._reciprocals = (
            _shared_zeros(size + kernels.PADDING)[1] for size in sizes
        )
        self._negative = np.zeros(1, np.int32)
        self._negative_array = wp.array(self._negative, dtype=int, device="cpu", copy=False)
        self._room = _shared_zeros(0)[1]
        self._ready = False
        self._added: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        """U, S^-1 U and the inverse of the capacitance matrix."""
        self.negative_pivots = 0
        """Negative eigenvalues of the last matrix."""

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
                self._layout.fronts,
                len(self._layout.fronts.first),
                self._matrix,
                _SINGULAR * float(np.abs(entries[self._diagonal]).max()),
                self._front,
                self._layout.front,
                self._stack,
                self._factor,
                self._inverses,
                self._reciprocals,
            ],
            outputs=[self._negative_array],
            device=self._device,
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
        self._full_values[:] = entries[self._full_from_upper]
        moves = np.ascontiguousarray(moves)
        products, count = np.empty_like(moves), moves.shape[1]
        strips = -(-count // products_kernels.STRIP)
        inputs = [self._unknowns, *self._full, self._full_array, moves.ctypes.data, count, products.ctypes.data]

        def part(first: int, last: int) -> np.ndarray:
            """The columns of some strips, from their own rows on: the rest is their mirror image."""
            launch_again(
                products_kernels.product_kernel, last - first, inputs=[first, *inputs], outputs=[], device=self._device
            )
            begin, end = first * products_kernels.STRIP, min(last * products_kernels.STRIP, count)
            return moves[:, begin:].T @ products[:, begin:end]

        # The first has more rows: less than half of them are as much work.
        half = max(1, int(_FIRST_PART * strips))
        first, second = beside(lambda: part(0, half), lambda: part(half, strips)) if strips > 1 else (part(0, 1), None)
        if second is None:
            return first
        inside = first.shape[1]
        return np.block([[first[:inside], first[inside:].T], [first[inside:], second]])

    def ahead(self, weights: np.ndarray, vectors: np.ndarray, near: float, far: float) -> np.ndarray:
        """See ``Factors``."""
        assert self._added is None, "of a matrix alone"
        return self._plain(vectors, np.ascontiguousarray(weights, dtype=np.float64), near, far)

    def take(self, values: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        return values

    def give(self, values: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        return values

    def _plain(
        self, right: np.ndarray, weights: np.ndarray | None = None, near: float = 0.0, far: float = 1.0
    ) -> np.ndarray:
        assert self._ready, "update() comes first"
        right = np.asarray(right, dtype=np.float64)
        count = 1 if right.ndim == 1 else right.shape[1]
        solution = np.empty(right.shape)
        strides = [stride // 8 for stride in right.strides]
        panels = -(-count // kernels.PANEL)
        if self._room.size < panels * (self._unknowns + 4) * kernels.PANEL:
            self._room = _shared_zeros(panels * (self._unknowns + 4) * kernels.PANEL)[1]
        inputs = [
            self._layout.fronts,
            len(self._layout.fronts.first),
            self._unknowns,
            self._factor,
            self._inverses,
            self._reciprocals,
            right.ctypes.data,
            strides[0],
            strides[1] if right.ndim > 1 else 0,
            count,
            0 if weights is None else weights.ctypes.data,
            near,
            far,
            self._room,
            solution.ctypes.data,
        ]

        def solve(first: int, last: int) -> None:
            launch_again(kernels.solve_kernel, last - first, inputs=[first, *inputs], outputs=[], device=self._device)

        if panels < 2:
            solve(0, panels)
        else:
            beside(lambda: solve(0, (panels + 1) // 2), lambda: solve((panels + 1) // 2, panels))
        return solution


def _shared_zeros(size: int) -> tuple[np.ndarray, wp.array]:
    values = np.zeros(size)
    return values, wp.array(values, dtype=real, device="cpu", copy=False)


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
