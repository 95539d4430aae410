"""OSQP's operator splitting (ADMM) on many dense QPs at once.

Its kernels are in ``egs_warp.kernels.locomotion.admm``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.locomotion import admm as kernels
from egs_warp.kernels.locomotion import scaled_programs as scaled
from egs_warp.launching import Device, empty_pooled
from egs_warp.precision import real

_RHO = 0.1
"""Initial step size parameter rho."""


class AdmmStatus(Enum):
    """Status of the iterations when they end."""

    SOLVED = kernels.SOLVED
    """Residuals are within the accuracy."""
    INEXACT = kernels.INEXACT
    """At the iteration limit, residuals are within ten times the accuracy."""
    LIMIT = kernels.LIMIT
    """At the iteration limit, residuals are larger."""
    INFEASIBLE = kernels.INFEASIBLE
    """There is a certificate that no point satisfies the bounds."""
    INFEASIBLE_INEXACT = kernels.INFEASIBLE_INEXACT
    """At the iteration limit, there is such a certificate to ten times its tolerance."""
    FAILED = -1
    """The iterates are not finite, or the solver failed."""


@dataclass(frozen=True)
class DenseQp:
    """The QP min 1/2 x^T P x + q^T x over rows A, whose bounds are given to ``solve``."""

    P: np.ndarray
    """(n, n) symmetric and positive semidefinite."""
    q: np.ndarray
    """(n,)."""
    A: np.ndarray
    """(m, n)."""


@dataclass(frozen=True)
class AdmmResult:
    """Result of the iterations on one QP."""

    status: AdmmStatus
    x: np.ndarray
    """(n,)."""
    multipliers: np.ndarray
    """(m,) positive at an active upper bound."""
    iterations: int


class AdmmPrograms:
    """Batch of k QPs, whose sizes may differ, solved in one launch. Each solve is warm-started from the previous one,
    with its rho.

    Args:
        programs: the k QPs.
        device: device of the kernels.
        scaling: number of equilibration passes.
        adapt: number of iterations after which rho may change, a multiple of ``kernels.CHECK``.
        rho: initial rho.
    """

    def __init__(
        self, programs: Sequence[DenseQp], *, device: Device, scaling: int = 4, adapt: int = 50, rho: float = _RHO
    ) -> None:
        self._device = wp.get_device(device)
        self._scaling, self._adapt, self._first = scaling, adapt, rho
        self._sizes = [one.A.shape for one in programs]
        k, m, n = len(programs), *(max(sizes) for sizes in zip(*self._sizes, strict=True))
        self._programs = scaled.Programs()
        self._programs.P = self._on_device(_padded([one.P for one in programs], (k, n, n)))
        self._programs.q = self._on_device(_padded([one.q for one in programs], (k, n)))
        self._programs.A = self._on_device(_padded([one.A for one in programs], (k, m, n)))
        self._programs.rows, self._programs.variables = (
            wp.array([size[side] for size in self._sizes], dtype=int, device=self._device) for side in (0, 1)
        )
        self._x, self._y, self._rho = np.zeros((k, n)), np.zeros((k, m)), np.full(k, rho)

    def solve(
        self,
        lower: Sequence[np.ndarray],
        upper: Sequence[np.ndarray],
        starts: Sequence[np.ndarray | None],
        *,
        accuracy: float,
        iterations: int,
    ) -> list[AdmmResult]:
        """Solve all QPs with bounds lower <= A x <= upper.

        Args:
            lower: (m,) of each QP.
            upper: (m,) of each QP.
            starts: (n,) of each QP; None starts from its previous solution.
            accuracy: absolute and relative tolerance of the residuals.
            iterations: maximum number of iterations.
        """
        k, n = self._x.shape
        m = self._y.shape[1]
        for x, start in zip(self._x, starts, strict=True):
            if start is not None:
                x[: len(start)] = start
        self._programs.lower = self._on_device(_padded(lower, (k, m)))
        self._programs.upper = self._on_device(_padded(upper, (k, m)))
        iterates = scaled.Iterates()
        iterates.x, iterates.y, iterates.rho = map(self._on_device, (self._x, self._y, self._rho))
        workspace, ended, taken = _workspace(self._device, k, m, n)
        block = _block(self._device)
        wp.launch(
            kernels.admm_kernel,
            k * block,
            inputs=[self._programs, accuracy, iterations, self._scaling, self._adapt, workspace, iterates],
            outputs=[ended, taken],
            device=self._device,
            block_dim=block,
        )
        self._x, self._y, self._rho = iterates.x.numpy(), iterates.y.numpy(), iterates.rho.numpy()
        status, count = ended.numpy(), taken.numpy()
        results = []
        for i, (rows, columns) in enumerate(self._sizes):
            ending, x, y = AdmmStatus(int(status[i])), self._x[i, :columns].copy(), self._y[i, :rows].copy()
            if not np.isfinite(x).all() or not np.isfinite(y).all():
                ending = AdmmStatus.FAILED
            if ending in (AdmmStatus.INFEASIBLE, AdmmStatus.INFEASIBLE_INEXACT, AdmmStatus.FAILED):
                # Iterates that diverged are not used as a warm start.
                self._x[i], self._y[i], self._rho[i] = 0.0, 0.0, self._first
            results.append(AdmmResult(ending, x, y, int(count[i])))
        return results

    def _on_device(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=real, device=self._device, copy=False)


class AdmmWarmStart:
    """Short runs on QPs min 1/2 x^T x over rows A, all started from given points. Buffers and the launch are allocated
    once for at most ``rows`` rows and ``unknowns`` unknowns; each run makes one upload. ``adapt`` and ``rho`` are those
    of ``AdmmPrograms``, ``accuracy`` and ``iterations`` those of its ``solve``."""

    def __init__(
        self, rows: int, unknowns: int, device: str, *, accuracy: float, iterations: int, adapt: int, rho: float
    ) -> None:
        self._device, self._rho = wp.get_device(device), rho
        m, n = rows, unknowns
        self._parts = np.cumsum([m * n, m, m, n, m, 1])
        size, pinned = int(self._parts[-1]), self._device.is_cuda
        self._host_buffer, self._device_buffer = (
            wp.zeros(size, real, "cpu", pinned=pinned),
            wp.zeros(size, real, self._device),
        )
        programs, iterates = scaled.Programs(), scaled.Iterates()
        offsets = [0, *self._parts.tolist()]
        device_values: Any = self._device_buffer
        A, lower, upper, x, y, iterates.rho = (device_values[a:b] for a, b in pairwise(offsets))
        programs.A, programs.lower, programs.upper = A.reshape((1, m, n)), lower.reshape((1, m)), upper.reshape((1, m))
        iterates.x, iterates.y = x.reshape((1, n)), y.reshape((1, m))
        programs.P = wp.array(np.eye(n)[None], dtype=real, device=self._device)
        programs.q = wp.zeros((1, n), dtype=real, device=self._device)
        programs.rows, programs.variables = (wp.array([size], dtype=int, device=self._device) for size in (m, n))
        workspace, self._status, self._iterations = _workspace(self._device, 1, m, n)
        self._host_status, self._host_iterations = (wp.zeros(1, int, "cpu", pinned=pinned) for _ in range(2))
        self._structs = programs, iterates, workspace
        block = _block(self._device)
        self._launch: Any = wp.launch(
            kernels.admm_kernel,
            block,
            inputs=[programs, accuracy, iterations, 0, adapt, workspace, iterates],
            outputs=[self._status, self._iterations],
            device=self._device,
            block_dim=block,
            record_cmd=True,
        )

    def run(self, rows: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> AdmmResult:
        """Iterate on the QP with ``rows`` A (m, n), of which there may be fewer than the capacity, and bounds (m,).

        Args:
            rows: (m, n).
            lower: (m,).
            upper: (m,).
            start: (n,); None starts from 0.
        """
        m, n = rows.shape
        A, low, high, x, y, rho = np.split(self._host_buffer.numpy(), self._parts[:-1])
        A[: m * n], A[m * n :] = rows.ravel(), 0.0
        low[:m], low[m:], high[:m], high[m:] = lower, -1.0, upper, 1.0
        x[:], y[:], rho[:] = 0.0 if start is None else start, 0.0, self._rho
        wp.copy(self._device_buffer, self._host_buffer)
        self._launch.launch()
        # The iterates are stored after the rows and bounds; only they are downloaded.
        iterates_offset = int(self._parts[2])
        wp.copy(
            self._host_buffer,
            self._device_buffer,
            iterates_offset,
            iterates_offset,
            len(self._device_buffer) - iterates_offset,
        )
        wp.copy(self._host_status, self._status)
        wp.copy(self._host_iterations, self._iterations)
        wp.synchronize_stream(self._device)
        ending = AdmmStatus(int(self._host_status.numpy()[0]))
        if not np.isfinite(x).all() or not np.isfinite(y).all():
            ending = AdmmStatus.FAILED
        return AdmmResult(ending, x.copy(), y[:m].copy(), int(self._host_iterations.numpy()[0]))


def _workspace(device: wp.Device, k: int, m: int, n: int) -> tuple[Any, wp.array, wp.array]:
    """Return the workspace of ``k`` QPs with at most ``m`` rows and ``n`` variables, and their (k,) status and (k,)
    iteration count."""
    workspace = scaled.AdmmWorkspace()
    square, table = ((k, n, n), real), ((k, m, n), real)
    (
        workspace.P,
        workspace.inverse,
        workspace.rows,
        workspace.columns,
        workspace.by_variable,
        workspace.by_row,
        ended,
        taken,
    ) = empty_pooled(
        device,
        *(square, square, table, ((k, n, m), real), ((k, scaled.BY_VARIABLE, n), real)),
        *(((k, scaled.BY_ROW, m), real), (k, int), (k, int)),
    )
    return workspace, ended, taken


def _block(device: wp.Device) -> int:
    """Return the number of threads of a block."""
    return 1 if device.is_cpu else kernels.BLOCK


def _padded(values: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of ``shape`` with ``values``, padded with zeros."""
    if len(values) == 1:
        return np.ascontiguousarray(values[0], dtype=np.float64)[None]
    padded = np.zeros(shape)
    for row, one in zip(padded, values, strict=True):
        row[tuple(map(slice, one.shape))] = one
    return padded
