"""OSQP's operator splitting on many quadratic programs at once, as kernels.

See ``egs_warp.kernels.locomotion.admm``.
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
"""Of a program's first iterations."""


class AdmmStatus(Enum):
    """How iterations end."""

    SOLVED = kernels.SOLVED
    """Residuals are within the accuracy."""
    INEXACT = kernels.INEXACT
    """They are within ten times that at the last iteration."""
    LIMIT = kernels.LIMIT
    """They are not."""
    INFEASIBLE = kernels.INFEASIBLE
    """There is a certificate that no point satisfies the bounds."""
    DOUBTFUL = kernels.DOUBTFUL
    """There is one within ten times its accuracy at the last iteration."""
    FAILED = -1
    """Nothing is known."""


@dataclass(frozen=True)
class DenseQp:
    """min 1/2 x^T P x + q^T x over rows A; their bounds come later."""

    P: np.ndarray
    """(n, n) symmetric and positive semidefinite."""
    q: np.ndarray
    """(n,)."""
    A: np.ndarray
    """(m, n)."""


@dataclass(frozen=True)
class AdmmResult:
    """Where the iterations on a program have ended."""

    ending: AdmmStatus
    x: np.ndarray
    """(n,)."""
    multipliers: np.ndarray
    """(m,) positive where the upper bound pushes."""
    iterations: int


class AdmmPrograms:
    """k programs, whose sizes may differ, that are iterated on side by side. Each begins where its last iterations
    have ended, with the rho that they have found."""

    def __init__(
        self, programs: Sequence[DenseQp], *, device: Device, scaling: int = 4, adapt: int = 50, rho: float = _RHO
    ) -> None:
        """``scaling`` passes equilibrate, rho begins with ``rho`` and may change every ``adapt`` iterations, a multiple
        of ``kernels.CHECK``."""
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
        """With each program's bounds l <= A x <= u (m,), from its start (n,) if there is one; at most ``iterations``
        each, to ``accuracy``, absolute and relative."""
        k, n = self._x.shape
        m = self._y.shape[1]
        for x, start in zip(self._x, starts, strict=True):
            if start is not None:
                x[: len(start)] = start
        self._programs.lower = self._on_device(_padded(lower, (k, m)))
        self._programs.upper = self._on_device(_padded(upper, (k, m)))
        iterates = scaled.Iterates()
        iterates.x, iterates.y, iterates.rho = map(self._on_device, (self._x, self._y, self._rho))
        memory, ended, taken = _memory(self._device, k, m, n)
        block = _block(self._device)
        wp.launch(
            kernels.admm_kernel,
            k * block,
            inputs=[self._programs, accuracy, iterations, self._scaling, self._adapt, memory, iterates],
            outputs=[ended, taken],
            device=self._device,
            block_dim=block,
        )
        self._x, self._y, self._rho = iterates.x.numpy(), iterates.y.numpy(), iterates.rho.numpy()
        how, count = ended.numpy(), taken.numpy()
        ends = []
        for i, (rows, columns) in enumerate(self._sizes):
            ending, x, y = AdmmStatus(int(how[i])), self._x[i, :columns].copy(), self._y[i, :rows].copy()
            if not np.isfinite(x).all() or not np.isfinite(y).all():
                ending = AdmmStatus.FAILED
            if ending in (AdmmStatus.INFEASIBLE, AdmmStatus.DOUBTFUL, AdmmStatus.FAILED):
                # What was driven apart is no place to begin.
                self._x[i], self._y[i], self._rho[i] = 0.0, 0.0, self._first
            ends.append(AdmmResult(ending, x, y, int(count[i])))
        return ends

    def _on_device(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=real, device=self._device, copy=False)


class AdmmWarmStart:
    """Iterations on min 1/2 x^T x over rows A, of so many rows and unknowns: memory and a launch are made once, for
    only numbers change, which come and go in one piece. They begin where they are told to."""

    def __init__(
        self, rows: int, unknowns: int, device: str, *, accuracy: float, iterations: int, adapt: int, rho: float
    ) -> None:
        """See ``AdmmPrograms``."""
        self._device, self._rho = wp.get_device(device), rho
        m, n = rows, unknowns
        self._parts = np.cumsum([m * n, m, m, n, m, 1])
        size, pinned = int(self._parts[-1]), self._device.is_cuda
        self._here, self._there = wp.zeros(size, real, "cpu", pinned=pinned), wp.zeros(size, real, self._device)
        programs, iterates = scaled.Programs(), scaled.Iterates()
        begins = [0, *self._parts.tolist()]
        there: Any = self._there
        A, lower, upper, x, y, iterates.rho = (there[a:b] for a, b in pairwise(begins))
        programs.A, programs.lower, programs.upper = A.reshape((1, m, n)), lower.reshape((1, m)), upper.reshape((1, m))
        iterates.x, iterates.y = x.reshape((1, n)), y.reshape((1, m))
        programs.P = wp.array(np.eye(n)[None], dtype=real, device=self._device)
        programs.q = wp.zeros((1, n), dtype=real, device=self._device)
        programs.rows, programs.variables = (wp.array([size], dtype=int, device=self._device) for size in (m, n))
        memory, self._ended, self._taken = _memory(self._device, 1, m, n)
        self._how, self._count = (wp.zeros(1, int, "cpu", pinned=pinned) for _ in range(2))
        self._held = programs, iterates, memory
        block = _block(self._device)
        self._launch: Any = wp.launch(
            kernels.admm_kernel,
            block,
            inputs=[programs, accuracy, iterations, 0, adapt, memory, iterates],
            outputs=[self._ended, self._taken],
            device=self._device,
            block_dim=block,
            record_cmd=True,
        )

    def run(self, rows: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> AdmmResult:
        """With ``rows`` A (m, n), which may be fewer than there is room for, and bounds l <= A x <= u (m,), from
        ``start`` (n,), or from 0."""
        m, n = rows.shape
        A, low, high, x, y, rho = np.split(self._here.numpy(), self._parts[:-1])
        A[: m * n], A[m * n :] = rows.ravel(), 0.0
        low[:m], low[m:], high[:m], high[m:] = lower, -1.0, upper, 1.0
        x[:], y[:], rho[:] = 0.0 if start is None else start, 0.0, self._rho
        wp.copy(self._there, self._here)
        self._launch.launch()
        # The iterates lie behind what they are told of.
        behind = int(self._parts[2])
        wp.copy(self._here, self._there, behind, behind, len(self._there) - behind)
        wp.copy(self._how, self._ended)
        wp.copy(self._count, self._taken)
        wp.synchronize_stream(self._device)
        ending = AdmmStatus(int(self._how.numpy()[0]))
        if not np.isfinite(x).all() or not np.isfinite(y).all():
            ending = AdmmStatus.FAILED
        return AdmmResult(ending, x.copy(), y[:m].copy(), int(self._count.numpy()[0]))


def _memory(device: wp.Device, k: int, m: int, n: int) -> tuple[Any, wp.array, wp.array]:
    """Of k programs of so many rows and variables: to work in, how they end, and after how many iterations."""
    memory = scaled.AdmmWorkspace()
    square, table = ((k, n, n), real), ((k, m, n), real)
    memory.P, memory.inverse, memory.rows, memory.columns, memory.by_variable, memory.by_row, ended, taken = (
        empty_pooled(
            device,
            *(square, square, table, ((k, n, m), real), ((k, scaled.BY_VARIABLE, n), real)),
            *(((k, scaled.BY_ROW, m), real), (k, int), (k, int)),
        )
    )
    return memory, ended, taken


def _block(device: wp.Device) -> int:
    return 1 if device.is_cpu else kernels.BLOCK


def _padded(values: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Arrays (``shape``) with zeros after what is shorter."""
    if len(values) == 1:
        return np.ascontiguousarray(values[0], dtype=np.float64)[None]
    padded = np.zeros(shape)
    for row, one in zip(padded, values, strict=True):
        row[tuple(map(slice, one.shape))] = one
    return padded
