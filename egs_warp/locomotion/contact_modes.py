"""The program of a step over the activations alone: contact as what it makes of them, one linear piece at a time
(Eq. 9, 13).

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.kernels.locomotion import mode_region as kernels
from egs_warp.launching import Device, launch_cached, thread_local_cache, zeros
from egs_warp.locomotion.solvers import QpSolver, quadratic_program
from egs_warp.precision import real

FREE, STICK, SLIDE = kernels.FREE, kernels.STICK, kernels.SLIDE


@dataclass(frozen=True)
class CoulombProgram:
    """min 1/2 x^T P x + q^T x + constant over x = (a, f), where f is what exact Coulomb contact answers to a.

    Activations are in their bounds, forces in body weights (contact-major: normal and two tangents), speeds in
    sqrt(g H). Contact velocities are ``rows`` x + ``offset``, the normal ones with the push-out's shift.
    """

    P: np.ndarray
    """(m + 3n, m + 3n)."""
    q: np.ndarray
    """(m + 3n,)."""
    constant: float
    rows: np.ndarray
    """(3n, m + 3n)."""
    offset: np.ndarray
    """(3n,)."""
    friction: float
    lower: np.ndarray
    """(m,) of the activations."""
    upper: np.ndarray
    """(m,)."""

    @property
    def activation_count(self) -> int:
        """m."""
        return len(self.lower)

    @property
    def contact_count(self) -> int:
        """n."""
        return len(self.offset) // 3

    def objective(self, x: np.ndarray) -> float:
        """Value at ``x``."""
        return float(0.5 * x @ self.P @ x + self.q @ x + self.constant)

    def contact_response(self, activations: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """(m + 3n,) ``activations`` (m,) and what contact answers to them; its forces are near ``guess`` (n, 3)."""
        m, n = self.activation_count, self.contact_count
        operator = self.rows[:, m:].copy()
        operator[np.diag_indices_from(operator)] += kernels.DELASSUS_REGULARIZATION * operator.diagonal().mean()
        free = self.offset + self.rows[:, :m] @ activations
        forces, _ = coulomb_forces(operator, free, np.zeros(n), self.friction, guess)
        return np.concatenate([activations, forces.ravel()])


@dataclass(frozen=True)
class ContactModes:
    """How each contact moves in a piece."""

    kind: np.ndarray
    """(n,) FREE, STICK or SLIDE."""
    slip: np.ndarray
    """(n, 2) unit vectors along which those that slide do."""

    @classmethod
    def of(cls, forces: np.ndarray, friction: float) -> ContactModes:
        """Those of ``forces`` (n, 3) body weights that obey Coulomb's law."""
        pull = np.linalg.norm(forces[:, 1:], axis=1)
        pressing = forces[:, 0] > kernels.ZERO_FORCE
        sliding = pressing & (pull >= kernels.CONE_FRACTION * friction * forces[:, 0])
        kind = np.where(sliding, SLIDE, np.where(pressing, STICK, FREE))
        return cls(kind, _unit(-forces[:, 1:]))


@dataclass(frozen=True)
class ModeRegionOptimum:
    """Optimum of a piece."""

    x: np.ndarray
    """(m + 3n,)."""
    objective: float
    next_modes: ContactModes | None
    """Those of the piece that lies beyond the bounds that hold the optimum back; None if none does."""
    next_modes_single: ContactModes | None
    """Of these bounds only the one that holds it back most is left behind."""


@dataclass(frozen=True)
class ModeSearchResult:
    """Best point found."""

    x: np.ndarray | None
    """(m + 3n,); None if no QP had a solution."""
    objective: float
    qp_count: int
    infeasible: int


def search_modes(
    program: CoulombProgram,
    start: np.ndarray,
    modes: ContactModes,
    *,
    qp_limit: int,
    solver: QpSolver | str,
    device: Device = None,
) -> ModeSearchResult:
    """From the piece of ``modes``, which holds ``start`` (m + 3n,), onward as long as the objective falls.

    Neighbouring pieces share the point between them, so no step is lost on an infeasible one. What slides in ``modes``
    is held at first: feet that slide apart under a load each resist only where they came from, and no way leads from
    there to a common push. ``solver`` and ``device``: see ``quadratic_program``.
    """
    best: ModeRegionOptimum | None = None
    count = infeasible = 0
    sliding, modes = modes, ContactModes(np.where(modes.kind == SLIDE, STICK, modes.kind), modes.slip)
    while count < qp_limit:
        count += 1
        solution = solve_mode_region(program, start, modes, solver, device=device, warm_start=best is not None)
        if solution is None:
            infeasible += 1
            if best is not None or infeasible > 1 or (sliding.kind != SLIDE).all():
                break
            modes = sliding
            continue
        if best is not None and solution.objective >= best.objective:
            # Together the contacts went too far; the one that is pushed most may still gain.
            if best.next_modes_single is None or modes is best.next_modes_single:
                break
            modes = best.next_modes_single
            continue
        enough = best is not None and best.objective - solution.objective < kernels.GAIN * abs(best.objective)
        best, start = solution, solution.x
        if solution.next_modes is None or enough:
            break
        modes = solution.next_modes
    return ModeSearchResult(best.x if best else None, best.objective if best else float("inf"), count, infeasible)


def solve_relaxed(
    program: CoulombProgram, solver: QpSolver | str, *, device: Device = None
) -> tuple[np.ndarray, float] | None:
    """The activations (m,) and the objective of the optimum with forces that need not be what contact answers: within
    the cone, but also where nothing touches. No piece has a lower objective. None without a solution.
    """
    m, n = program.activation_count, program.contact_count
    forces = np.hstack([np.zeros((3 * n, m)), np.eye(3 * n)])
    cone = [forces[::3]]
    for angle in 2.0 * np.pi * np.arange(kernels.CONE_FACES) / kernels.CONE_FACES:
        # Around the cone: what bounds must not cut it.
        cone.append(program.friction * forces[::3] - np.cos(angle) * forces[1::3] - np.sin(angle) * forces[2::3])
    A = np.vstack([np.eye(m, m + 3 * n), *cone, program.rows[::3]])
    lower = np.concatenate([program.lower, np.zeros(n * (1 + kernels.CONE_FACES)), -program.offset[::3]])
    upper = np.concatenate([program.upper, np.full(len(lower) - m, np.inf)])
    P = program.P + kernels.DELASSUS_REGULARIZATION * program.P.diagonal().mean() * np.eye(len(program.P))
    found = quadratic_program(P, program.q, A, solver=solver, device=device).solve(lower, upper)
    if not found.usable:
        return None
    return np.clip(found.x[:m], program.lower, program.upper), found.objective + program.constant


@dataclass(frozen=True)
class ModeRegion:
    """Where each contact goes on as it does: forces are ``offset`` + ``slope`` a, the cost of activations a is
    1/2 a^T P a + q^T a and a constant, and ``rows`` a + ``rows_offset`` >= 0 is where it holds."""

    force_offset: np.ndarray
    """(3n,) body weights."""
    force_slope: np.ndarray
    """(3n, m)."""
    P: np.ndarray
    """(m, m)."""
    q: np.ndarray
    """(m,)."""
    rows: np.ndarray
    """(m + k, m), the first m those of the activations themselves."""
    rows_offset: np.ndarray
    """(m + k,)."""
    contact: np.ndarray
    """(k,) whose row each of the others is."""
    transitions: np.ndarray
    """(k,) what happens to it beyond."""

    @classmethod
    def of(cls, program: CoulombProgram, modes: ContactModes) -> ModeRegion | None:
        """That of ``modes``; None if no forces hold what is held."""
        m, n = program.activation_count, program.contact_count
        stick, slide, free = (np.flatnonzero(modes.kind == kind) for kind in (STICK, SLIDE, FREE))
        contact = np.concatenate([stick, slide, np.tile(stick, kernels.CONE_FACES), slide, slide, free])
        onward = np.repeat(
            [kernels.TO_FREE, kernels.TO_SLIDE, kernels.TO_OTHER_DIRECTION, kernels.TO_TOUCHING],
            [len(stick) + len(slide), kernels.CONE_FACES * len(stick), 2 * len(slide), len(free)],
        )
        given = [np.ascontiguousarray(each) for each in (program.P, program.q, program.rows, program.offset)]
        given += [modes.kind.astype(np.int32), np.ascontiguousarray(modes.slip)]
        total, wide = m + len(contact), kernels.padded(m)
        shapes = (3 * n, wide), 3 * n, (m, wide), m, (total, wide), total
        slope, offset, P, q, rows, rows_offset = made = [np.empty(shape) for shape in shapes]
        room = _workspace(kernels.scratch_size(m, n), 10 * n)
        launch_cached(
            kernels.mode_region_kernel,
            1,
            inputs=[m, n, program.friction, *_addresses(given), room.numbers, room.scratch, total],
            outputs=[*_addresses(made), room.there_array],
            device=room.device,
        )
        if not room.there[0]:
            return None
        return cls(offset, slope[:, :m], P[:, :m], q, rows[:, :m], rows_offset, contact, onward)


class _Workspace:
    """Memory of a thread in which pieces are made."""

    def __init__(self) -> None:
        self.device = wp.get_device("cpu")
        self.there = np.zeros(1, np.int32)
        self.there_array = wp.array(self.there, dtype=int, device="cpu", copy=False)
        self.scratch, self.numbers = zeros(0, real, "cpu"), zeros(0, int, "cpu")

    def grown(self, scratch: int, numbers: int) -> _Workspace:
        """With so many numbers at least."""
        if self.scratch.size < scratch:
            self.scratch = zeros(scratch, real, "cpu")
        if self.numbers.size < numbers:
            self.numbers = zeros(numbers, int, "cpu")
        return self


_thread_room = thread_local_cache(1)(_Workspace)


def _workspace(scratch: int, numbers: int) -> _Workspace:
    return _thread_room().grown(scratch, numbers)


def _addresses(values: Sequence[np.ndarray]) -> list[int]:
    return [value.ctypes.data for value in values]


def solve_mode_region(
    program: CoulombProgram,
    start: np.ndarray,
    modes: ContactModes,
    solver: QpSolver | str,
    *,
    device: Device = None,
    warm_start: bool = False,
) -> ModeRegionOptimum | None:
    """Optimum of the activations in the piece of ``modes``; what ``start`` breaks of its bounds, up to ``BROKEN``, may
    stay broken as much. None without a solution. ``beside`` where another piece of the step is solved already.
    """
    m, piece = program.activation_count, ModeRegion.of(program, modes)
    if piece is None:
        return None
    b = piece.rows_offset[m:]
    lower = np.minimum(-b, np.maximum(piece.rows[m:] @ start[:m], -b - kernels.BROKEN)) - kernels.ROUNDING
    found = quadratic_program(piece.P, piece.q, piece.rows, solver=solver, device=device).solve(
        np.concatenate([program.lower, lower]),
        np.concatenate([program.upper, np.full(len(lower), np.inf)]),
        start[:m],
        beside=warm_start,
    )
    if not found.usable:
        return None
    a = np.clip(found.x, program.lower, program.upper)
    x = np.concatenate([a, piece.force_offset + piece.force_slope @ a])
    objective = program.objective(x)
    pushes = -found.multipliers[m:]
    active = np.flatnonzero(pushes > kernels.ACTIVE * max(abs(objective), 1e-9))
    further = nearest = None
    if len(active):
        contact, onward, pushes = piece.contact[active], piece.transitions[active], pushes[active]
        beyond = _NextModes(program, modes, x)
        further = beyond.after_transitions(contact, onward, pushes)
        if len(active) > 1:
            most = [int(np.argmax(pushes))]
            nearest = beyond.after_transitions(contact[most], onward[most], pushes[most])
    return ModeRegionOptimum(x, objective, further, nearest)


class _NextModes:
    """Modes past the bounds that hold the optimum ``x`` back."""

    def __init__(self, program: CoulombProgram, modes: ContactModes, x: np.ndarray) -> None:
        self._modes = modes
        tangents = (program.rows @ x + program.offset).reshape(-1, 3)[:, 1:]
        self._against, self._along = _unit(-x[program.activation_count :].reshape(-1, 3)[:, 1:]), _unit(tangents)
        self._moving = np.linalg.norm(tangents, axis=1) > kernels.ZERO_SPEED

    def after_transitions(self, contacts: np.ndarray, onward: np.ndarray, pushes: np.ndarray) -> ContactModes:
        """Modes where ``contacts`` go ``onward``, the most pushed one's word last."""
        kind, slip = self._modes.kind.copy(), self._modes.slip.copy()
        for index in np.argsort(pushes, kind="stable"):
            i = contacts[index]
            if onward[index] == kernels.TO_FREE:
                kind[i] = FREE
            elif onward[index] == kernels.TO_SLIDE:
                kind[i], slip[i] = SLIDE, self._against[i]
            elif self._moving[i]:
                kind[i], slip[i] = SLIDE, self._along[i]
            else:
                kind[i] = STICK
        return ContactModes(kind, slip)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), [1.0, 0.0])
