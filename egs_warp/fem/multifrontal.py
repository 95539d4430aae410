"""Factors of a step's sparse matrix, many right-hand sides at once."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as dense
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.front_layout import FrontLayout, as_index_array
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.supernodes import Supernodes, first_of_equal_rows
from egs_warp.kernels.fem import supernodal as kernels
from egs_warp.kernels.fem.products import Rows
from egs_warp.launching import launch_cached, run_concurrently, zeros
from egs_warp.precision import real

_SINGULAR = 1e-14
"""Of the largest diagonal entry: pivots that are as small have no reciprocal worth the name."""


@dataclass(frozen=True)
class SymbolicFactorization:
    """Of the pattern of symmetric matrices: what their factors have in common."""

    full_from_upper: np.ndarray
    """Where each entry of both triangles is, in the order of the columns, in the upper one."""
    offsets: wp.array
    """(n + 1,) of the columns of both triangles."""
    indices: wp.array
    """The rows in them."""
    first_of_equal_rows: wp.array
    """(n,) see ``first_of_alike``."""
    permutation: np.ndarray
    """(n,) of each row in the order of elimination."""
    layout: FrontLayout

    @classmethod
    def of(cls, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> SymbolicFactorization:
        """Of an upper triangle with the diagonal."""
        upper = sparse.csc_matrix(
            (np.arange(1.0, upper_pattern.nnz + 1.0), upper_pattern.indices, upper_pattern.indptr), upper_pattern.shape
        )
        full = (upper + sparse.triu(upper, 1).T).tocsc()
        full.sort_indices()
        blocks = Supernodes.of(upper)
        return cls(
            full.data.astype(np.int64) - 1,
            as_index_array(full.indptr),
            as_index_array(full.indices),
            as_index_array(first_of_equal_rows(full)),
            blocks.permutation,
            FrontLayout.of(blocks, upper),
        )


class MultifrontalLdl:
    """L D L^T of symmetric matrices of one pattern by a multifrontal method; see ``Factors``. The symbolic analysis is
    done once. The same bits on any number of cores.

    Pivots are taken as they come: a definite matrix asks for no others, of one that is not only the inertia and a sum
    with muscles are wanted, and one that is next to singular has no factors.
    """

    is_host = True
    stream: AbstractContextManager[None] = nullcontext()

    def __init__(
        self, upper_pattern: sparse.csc_matrix | sparse.csc_array, analysis: SymbolicFactorization | None = None
    ) -> None:
        """``upper_pattern``: upper triangle with the diagonal, entries in the order of ``update``; ``analysis``: of it,
        where it is known."""
        self._device = wp.get_device("cpu")
        # Two threads at once cannot load them.
        kernels.solve_kernel.module.load(self._device, block_dim=1)
        known = analysis or SymbolicFactorization.of(upper_pattern)
        self._full_from_upper = known.full_from_upper
        self._full = Rows()
        self._full_values, self._full.values = _shared_zeros(len(known.full_from_upper))
        self._full.offsets, self._full.indices, self._full.heads = (
            known.offsets,
            known.indices,
            known.first_of_equal_rows,
        )
        self._diagonal = upper_pattern.indptr[1:] - 1
        self._unknowns = len(upper_pattern.indptr) - 1
        self.place = known.permutation
        """(n,) of each row in the order of elimination."""
        self._layout = layout = known.layout
        self._entries, self._matrix = _shared_zeros(upper_pattern.nnz)
        sizes = layout.front + layout.scratch, layout.stack, layout.factor, layout.inverses, self._unknowns
        self._front, self._stack, self._factor, self._inverses, self._reciprocals = (
            _shared_zeros(size + kernels.PADDING)[1] for size in sizes
        )
        self._negative = np.zeros(1, np.int32)
        self._negative_array = wp.array(self._negative, dtype=int, device="cpu", copy=False)
        self._room = _shared_zeros(0)[1]
        self._counters = np.zeros(3, np.int32)
        self._counters_array = wp.array(self._counters, dtype=int, device="cpu", copy=False)
        self._nothing, self._keeping = _Keeping(0).struct, _Keeping(self._unknowns)
        self._keeping.struct.enabled = 1
        self._moves: _Moves | None = None
        self._ready = False
        self._added: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        """U, S^-1 U and the inverse of the capacitance matrix."""
        self.negative_pivots = 0
        """Negative eigenvalues of the last matrix."""

    def update(self, entries: np.ndarray, diagonal: np.ndarray | None = None) -> bool:
        """See ``Factors``. The factors of an indefinite matrix can be solved with all the same; without any, ``solve``
        must not be called.
        """
        self._ready, self._added = False, None
        if not np.isfinite(entries).all():
            return False
        self._entries[:] = entries
        if diagonal is not None:
            self._entries[self._diagonal] += diagonal
        launch_cached(
            kernels.factor_kernel,
            1,
            inputs=[
                self._layout.fronts,
                len(self._layout.fronts.first),
                self._matrix,
                _SINGULAR * float(np.abs(self._entries[self._diagonal]).max()),
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

    def start_update(self, entries: np.ndarray, diagonal: np.ndarray | None = None) -> None:
        """See ``Factors``."""
        self.update(entries, diagonal)

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """See ``Factors``: by Woodbury's formula, also where S alone is not definite."""
        if not self.is_ready:
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
        self._added = np.ascontiguousarray(across), np.ascontiguousarray(through), np.ascontiguousarray(inverse)
        return True

    @property
    def is_ready(self) -> bool:
        """See ``Factors``."""
        return self._ready

    def solve(self, right: np.ndarray, kept: MomentumProjection | None = None) -> np.ndarray:
        """See ``Factors``."""
        if self._added is None:
            return self._solve_unprojected(right, kept)
        plain = self._solve_unprojected(right)
        across, through, small = self._added
        plain -= through @ (small @ (across.T @ plain))
        return plain if kept is None else kept.corrected(right, plain)

    def effort_quadratic(
        self,
        entries: np.ndarray,
        gradient: np.ndarray,
        weights: np.ndarray,
        vectors: np.ndarray,
        *,
        dt_now: float,
        dt_ahead: float,
        reference: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See ``Factors``: two threads share the panels."""
        assert self._ready and self._added is None, "update() comes first"
        count = vectors.shape[1]
        panels = -(-count // kernels.PANEL)
        if self._moves is None or len(self._moves.along) != panels:
            self._moves = _Moves(panels, self._unknowns)
        room, vectors = self._moves, np.asarray(vectors, dtype=np.float64)
        weights = np.ascontiguousarray(weights, dtype=np.float64)
        self._full_values[:] = entries[self._full_from_upper]
        room.away[:], room.slope[:] = reference, gradient
        self._launch_two_threads(
            kernels.effort_panel_kernel,
            panels,
            [*self._solving, *self._place_of(vectors), weights.ctypes.data, dt_now, dt_ahead, room.away_array]
            + [room.slope_array, self._full, self._room_for(panels)],
            [room.moves, room.products, room.along_array, room.form_array],
        )
        return room.form[:count, :count].copy(), room.along.ravel()[:count].copy()

    def _solve_unprojected(self, right: np.ndarray, kept: MomentumProjection | None = None) -> np.ndarray:
        assert self._ready, "update() comes first"
        right = np.asarray(right, dtype=np.float64)
        solution = np.empty(right.shape)
        panels = -(-(1 if right.ndim == 1 else right.shape[1]) // kernels.PANEL)
        keeping = self._nothing if kept is None else self._keeping.of(kept)
        inputs = [*self._solving, *self._place_of(right), keeping, self._room_for(panels), solution.ctypes.data]
        self._launch_two_threads(kernels.solve_kernel, panels, inputs, [])
        return solution

    def _launch_two_threads(self, kernel: Any, panels: int, inputs: list[Any], outputs: list[Any]) -> None:
        """``kernel``, of which two threads share what there is to do if there are several ``panels``."""
        self._counters[:] = 0

        def launch() -> None:
            launch_cached(kernel, 1, inputs=[self._counters_array, *inputs], outputs=outputs, device=self._device)

        if panels > 1:
            run_concurrently(launch, launch)
        else:
            launch()

    def solving_one(self, kept: MomentumProjection) -> tuple[list[Any], list[int], wp.array]:
        """What ``kernels.fem.supernodal.solved_one`` is told of the factors and of what is ``kept``; of what is added
        the directions, their number first, with addresses of what ``add`` has made of them; memory to work in."""
        assert self._ready, "update() comes first"
        added = [0, 0, 0, 0]
        if self._added is not None:
            across, through, small = self._added
            added = [across.shape[1], across.ctypes.data, through.ctypes.data, small.ctypes.data]
        return [*self._solving, self._keeping.of(kept)], added, self._room_for(1)

    @property
    def _solving(self) -> list[Any]:
        fronts = self._layout.fronts
        return [fronts, len(fronts.first), self._unknowns, self._factor, self._inverses, self._reciprocals]

    @staticmethod
    def _place_of(right: np.ndarray) -> list[int]:
        """Address, strides by rows and columns, and how many columns there are."""
        strides = [stride // 8 for stride in right.strides]
        return [right.ctypes.data, *(strides if right.ndim > 1 else [*strides, 0]), right[0].size]

    def _room_for(self, panels: int) -> wp.array:
        size = panels * (self._unknowns + 4) * kernels.PANEL
        if self._room.size < size:
            self._room = _shared_zeros(size)[1]
        return self._room


class _Keeping:
    """Memory for what is kept."""

    def __init__(self, unknowns: int) -> None:
        self.struct = kernels.MomentumProjection()
        self._arrays: dict[str, np.ndarray] = {}
        for name, size in (
            ("rotation_modes", 3 * unknowns),
            ("mode_momenta", 3 * unknowns),
            ("rotation_response", 3 * unknowns),
            ("inverse", 9),
        ):
            self._arrays[name], array = _shared_zeros(size)
            setattr(self.struct, name, array)
        self._ratio, self.struct.inertia_ratio = _shared_zeros(1)
        self._now: MomentumProjection | None = None

    def of(self, kept: MomentumProjection) -> Any:
        """As the kernels read it."""
        if self._now is not kept:
            self._now, self._ratio[0] = kept, kept.inertia_ratio
            for name, array in self._arrays.items():
                array[:] = getattr(kept, name).ravel()
        return self.struct


class _Moves:
    """Memory for so many panels of moves."""

    def __init__(self, panels: int, unknowns: int) -> None:
        self.moves, self.products = (zeros((panels, unknowns, kernels.PANEL), real, "cpu") for _ in range(2))
        self.away, self.away_array = _shared_zeros(unknowns)
        self.slope, self.slope_array = _shared_zeros(unknowns)
        self.along, self.along_array = _shared_zeros((panels, kernels.PANEL))
        self.form, self.form_array = _shared_zeros((panels * kernels.PANEL, panels * kernels.PANEL))


def _shared_zeros(size: int | tuple[int, ...]) -> tuple[np.ndarray, wp.array]:
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
