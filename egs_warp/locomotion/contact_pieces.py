"""The program of a step over the activations alone: contact as what it makes of them, one linear piece at a time
(Eq. 9, 13).

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.launching import Device
from egs_warp.locomotion.solvers import QpSolver, quadratic_program

_FACES = 8
"""Of the pyramid that stands in for the friction cone of a contact that sticks."""
_SINGULAR = 1e-7
"""Of the mean of the operator's diagonal: more points than the cage can resolve leave it singular."""
_SLOWEST = 1e-9
"""Of sqrt(g H): tangential velocity without a direction."""
_ACTIVE = 1e-3
"""Multiplier, of the objective's value for a unit of the row, from which a bound is worth leaving."""
_GAIN = 5e-3
"""Share of the objective by which a further piece has to lower it."""
_BROKEN = 0.02
"""By which a start may break a row that its piece does not quite hold."""

_WEDGE = np.radians(30.0)
"""How far a contact that slides may turn from the way that its friction is taken against. Friction that stays where it
was while a foot slides elsewhere pushes a body along that no ground would."""
_NOTHING = 1e-9
"""Body weights: what rounding leaves of the force of a contact that is open."""

_LEAVES, _SLIPS, _TURNS, _LANDS = 0, 1, 2, 3

FREE, STICK, SLIDE = 0, 1, 2


@dataclass(frozen=True)
class ContactPieces:
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
    def activations(self) -> int:
        """m."""
        return len(self.lower)

    @property
    def contacts(self) -> int:
        """n."""
        return len(self.offset) // 3

    def objective(self, x: np.ndarray) -> float:
        """Value at ``x``."""
        return float(0.5 * x @ self.P @ x + self.q @ x + self.constant)

    def under(self, activations: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """(m + 3n,) ``activations`` (m,) and what contact answers to them; its forces are near ``guess`` (n, 3)."""
        m, n = self.activations, self.contacts
        operator = self.rows[:, m:].copy()
        operator[np.diag_indices_from(operator)] += _SINGULAR * operator.diagonal().mean()
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
        pressing = forces[:, 0] > _NOTHING
        sliding = pressing & (pull >= (1.0 - 1e-6) * friction * forces[:, 0])
        kind = np.where(sliding, SLIDE, np.where(pressing, STICK, FREE))
        return cls(kind, _unit(-forces[:, 1:]))


@dataclass(frozen=True)
class PieceSolution:
    """Optimum of a piece."""

    x: np.ndarray
    """(m + 3n,)."""
    objective: float
    onward: ContactModes | None
    """Those of the piece that lies beyond the bounds that hold the optimum back; None if none does."""
    nearest: ContactModes | None
    """Of these bounds only the one that holds it back most is left behind."""


@dataclass(frozen=True)
class PieceSearch:
    """Best point found."""

    x: np.ndarray | None
    """(m + 3n,); None if no QP had a solution."""
    objective: float
    qp_count: int
    infeasible: int


def search_pieces(
    program: ContactPieces,
    start: np.ndarray,
    modes: ContactModes,
    *,
    qp_limit: int,
    solver: QpSolver | str,
    device: Device = None,
) -> PieceSearch:
    """From the piece of ``modes``, which holds ``start`` (m + 3n,), onward as long as the objective falls.

    Neighbouring pieces share the point between them, so no step is lost on an infeasible one. What slides in ``modes``
    is held at first: feet that slide apart under a load each resist only where they came from, and no way leads from
    there to a common push. ``solver`` and ``device``: see ``quadratic_program``.
    """
    best: PieceSolution | None = None
    count = infeasible = 0
    sliding, modes = modes, ContactModes(np.where(modes.kind == SLIDE, STICK, modes.kind), modes.slip)
    while count < qp_limit:
        count += 1
        solution = solve_piece(program, start, modes, solver, device=device, beside=best is not None)
        if solution is None:
            infeasible += 1
            if best is not None or infeasible > 1 or (sliding.kind != SLIDE).all():
                break
            modes = sliding
            continue
        if best is not None and solution.objective >= best.objective:
            # Together the contacts went too far; the one that is pushed most may still gain.
            if best.nearest is None or modes is best.nearest:
                break
            modes = best.nearest
            continue
        enough = best is not None and best.objective - solution.objective < _GAIN * abs(best.objective)
        best, start = solution, solution.x
        if solution.onward is None or enough:
            break
        modes = solution.onward
    return PieceSearch(best.x if best else None, best.objective if best else float("inf"), count, infeasible)


def solve_relaxed(
    program: ContactPieces, solver: QpSolver | str, *, device: Device = None
) -> tuple[np.ndarray, float] | None:
    """The activations (m,) and the objective of the optimum with forces that need not be what contact answers: within
    the cone, but also where nothing touches. No piece has a lower objective. None without a solution.
    """
    m, n = program.activations, program.contacts
    forces = np.hstack([np.zeros((3 * n, m)), np.eye(3 * n)])
    cone = [forces[::3]]
    for angle in 2.0 * np.pi * np.arange(_FACES) / _FACES:
        # Around the cone: what bounds must not cut it.
        cone.append(program.friction * forces[::3] - np.cos(angle) * forces[1::3] - np.sin(angle) * forces[2::3])
    A = np.vstack([np.eye(m, m + 3 * n), *cone, program.rows[::3]])
    lower = np.concatenate([program.lower, np.zeros(n * (1 + _FACES)), -program.offset[::3]])
    upper = np.concatenate([program.upper, np.full(len(lower) - m, np.inf)])
    P = program.P + _SINGULAR * program.P.diagonal().mean() * np.eye(len(program.P))
    found = quadratic_program(P, program.q, A, solver=solver, device=device).solve(lower, upper)
    if not found.usable:
        return None
    return np.clip(found.x[:m], program.lower, program.upper), found.objective + program.constant


def solve_piece(
    program: ContactPieces,
    start: np.ndarray,
    modes: ContactModes,
    solver: QpSolver | str,
    *,
    device: Device = None,
    beside: bool = False,
) -> PieceSolution | None:
    """Optimum of the activations in the piece of ``modes``; what ``start`` breaks of its bounds, up to ``_BROKEN``, may
    stay broken as much. None without a solution. ``beside`` where another piece of the step is solved already.
    """
    m = program.activations
    offset, slope = _forces_of(program, modes)
    # x = (0, offset) + (1, slope) a; ``PZ`` is P times the second.
    PZ = program.P[:, :m] + program.P[:, m:] @ slope
    P = PZ[:m] + slope.T @ PZ[m:]
    q = program.q[:m] + slope.T @ program.q[m:] + PZ[m:].T @ offset
    A, b, contact, onward = _bounds(program, modes, offset, slope)
    lower = np.minimum(-b, np.maximum(A @ start[:m], -b - _BROKEN)) if len(A) else np.zeros(0)
    qp = quadratic_program(0.5 * (P + P.T), q, np.vstack([np.eye(m), A]), solver=solver, device=device)
    found = qp.solve(
        np.concatenate([program.lower, lower]),
        np.concatenate([program.upper, np.full(len(lower), np.inf)]),
        start[:m],
        beside=beside,
    )
    if not found.usable:
        return None
    a = np.clip(found.x, program.lower, program.upper)
    x = np.concatenate([a, offset + slope @ a])
    objective = program.objective(x)
    pushes = -found.multipliers[m:]
    active = np.flatnonzero(pushes > _ACTIVE * max(abs(objective), 1e-9))
    further = nearest = None
    if len(active):
        further = _beyond(program, modes, x, contact[active], onward[active], pushes[active])
    if len(active) > 1:
        most = active[[int(np.argmax(pushes[active]))]]
        nearest = _beyond(program, modes, x, contact[most], onward[most], pushes[most])
    return PieceSolution(x, objective, further, nearest)


def _forces_of(program: ContactPieces, modes: ContactModes) -> tuple[np.ndarray, np.ndarray]:
    """(3n,) and (3n, m): f = offset + slope a in the piece of ``modes``."""
    n, m = program.contacts, program.activations
    stick, slide = modes.kind == STICK, modes.kind == SLIDE
    held = np.flatnonzero(np.stack([stick | slide, stick, stick], axis=1))
    sliding = 3 * np.flatnonzero(slide)
    pull = -program.friction * modes.slip[slide]
    forces = np.zeros((3 * n, 1 + m))
    if len(held) > 0:
        rows = program.rows[held]
        operator = rows[:, m + held]
        drawn = rows[:, m + sliding + 1] * pull[:, 0] + rows[:, m + sliding + 2] * pull[:, 1]
        operator[:, np.searchsorted(held, sliding)] += drawn
        operator[np.diag_indices_from(operator)] += _SINGULAR * np.abs(operator.diagonal()).mean()
        forces[held] = np.linalg.solve(operator, -np.column_stack([program.offset[held], rows[:, :m]]))
        for t in (0, 1):
            forces[sliding + 1 + t] = pull[:, t, None] * forces[sliding]
    return forces[:, 0], forces[:, 1:]


def _bounds(
    program: ContactPieces, modes: ContactModes, offset: np.ndarray, slope: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows A a + b >= 0 within which a piece holds; of each the contact and what happens to it beyond."""
    m, friction = program.activations, program.friction
    speed = program.rows[:, :m] + program.rows[:, m:] @ slope
    speed_offset = program.offset + program.rows[:, m:] @ offset
    stick, slide = np.flatnonzero(modes.kind == STICK), np.flatnonzero(modes.kind == SLIDE)
    free = np.flatnonzero(modes.kind == FREE)
    pressing = np.concatenate([stick, slide])
    parts = [(slope[3 * pressing], offset[3 * pressing], pressing, _LEAVES)]
    parts.append((_faces(slope, stick, friction), _faces(offset, stick, friction), np.tile(stick, _FACES), _SLIPS))
    d = modes.slip[slide]
    # The way it slides is near the one that its friction is taken against.
    for side in (1.0, -1.0):
        edge = np.sin(_WEDGE) * d + side * np.cos(_WEDGE) * d[:, ::-1] * [-1.0, 1.0]
        parts.append(
            (
                edge[:, :1] * speed[3 * slide + 1] + edge[:, 1:] * speed[3 * slide + 2],
                edge[:, 0] * speed_offset[3 * slide + 1] + edge[:, 1] * speed_offset[3 * slide + 2],
                slide,
                _TURNS,
            )
        )
    parts.append((speed[3 * free], speed_offset[3 * free], free, _LANDS))
    A = np.vstack([part[0] for part in parts])
    b = np.concatenate([part[1] for part in parts])
    contact = np.concatenate([part[2] for part in parts])
    onward = np.repeat([part[3] for part in parts], [len(part[2]) for part in parts])
    return A, b, contact, onward


def _faces(forces: np.ndarray, contacts: np.ndarray, friction: float) -> np.ndarray:
    """(faces k, ...) what ``forces`` (3n, ...) leave of each face of the pyramids of k ``contacts``, face by face."""
    normal, first, second = (forces[3 * contacts + part] for part in range(3))
    angle = (2.0 * np.pi * np.arange(_FACES) / _FACES).reshape(-1, *np.ones(forces.ndim, int))
    room = friction * np.cos(np.pi / _FACES) * normal - np.cos(angle) * first - np.sin(angle) * second
    return room.reshape(-1, *forces.shape[1:])


def _beyond(
    program: ContactPieces,
    modes: ContactModes,
    x: np.ndarray,
    contacts: np.ndarray,
    onward: np.ndarray,
    pushes: np.ndarray,
) -> ContactModes:
    """Modes where ``contacts`` go ``onward``, the most pushed one's word last."""
    kind, slip = modes.kind.copy(), modes.slip.copy()
    forces = x[program.activations :].reshape(-1, 3)
    velocities = (program.rows @ x + program.offset).reshape(-1, 3)
    against, along = _unit(-forces[:, 1:]), _unit(velocities[:, 1:])
    moving = np.linalg.norm(velocities[:, 1:], axis=1) > _SLOWEST
    for index in np.argsort(pushes, kind="stable"):
        i = contacts[index]
        if onward[index] == _LEAVES:
            kind[i] = FREE
        elif onward[index] == _SLIPS:
            kind[i], slip[i] = SLIDE, against[i]
        elif moving[i]:
            kind[i], slip[i] = SLIDE, along[i]
        else:
            kind[i] = STICK
    return ContactModes(kind, slip)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), [1.0, 0.0])
