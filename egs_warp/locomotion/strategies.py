"""Strategies that choose the contact states of a step's program (Eq. 13), and with them the activations.

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import warp as wp

from egs_warp.errors import UserError
from egs_warp.launching import Device
from egs_warp.locomotion.branch_and_bound import exact_states
from egs_warp.locomotion.complementarity import (
    SEPARATE,
    STATIC,
    Pivot,
    plain_pivots,
    proposed_pivots,
    states_from_prediction,
    states_of_pairs,
)
from egs_warp.locomotion.contact_modes import (
    ContactModes,
    CoulombProgram,
    ModeSearchResult,
    search_modes,
    solve_relaxed,
)
from egs_warp.locomotion.device_search import search_modes_device
from egs_warp.locomotion.lemke import lemke
from egs_warp.locomotion.program import ContactProgram
from egs_warp.locomotion.solvers import QpSolution, QpSolver, QpStatus, QuadraticProgram, quadratic_program

STOP_GAP = 1.005
"""A search ends when the objective is within this factor of its bound."""
RESTART_GAP = 1.2
"""A search that ends further than this factor from its bound is done again from other states,
with ``PATIENCE`` times as many QPs.
"""
NEGLIGIBLE_GAIN = 0.01
"""Unless there is no more to gain than this share of what it costs to do nothing,
to fall without muscles and ground.
"""
RESTART_COST = 0.3
"""Of the end of a step: what costs less is not doubted."""
LOADED_FORCE = 1e-3
"""Body weights, of a contact that holds."""
RESTART_BUDGET = 3
"""Feet that slide have many states that are nearly as likely."""


class Strategy(Enum):
    """How the contact states are found."""

    MODES = "pieces"
    """Contact is what the activations make of it: from the piece that stage 1 foresees over the bounds that hold the
    optimum back (``contact_pieces``). The only one with the exact friction cone, and with no unknowns but activations.
    """
    PAPER = "paper"
    """The paper's: the QP in the states that stage 1 predicts (Eq. 12), then one contact at a time as its own
    multipliers say."""
    STATIC = "static"
    """Every contact stays static: one QP."""
    QPCC = "qpcc"
    """From all-static, one contact at a time, as its own multipliers say (after Tan, Turk and Liu 2012)."""
    QPCC_OUR_MOVES = "qpcc-our-moves"
    """The same from all-static with the moves of relaxed: what the moves alone are worth."""
    RELAXED = "relaxed"
    """From where the optimum without complementarity would end up under true contact, several contacts at a time."""
    EXACT = "exact"
    """The global optimum by branch and bound: for small problems."""

    @classmethod
    def _missing_(cls, value: object) -> Strategy:
        raise UserError(f"strategy {value!r} is not known; give one of {', '.join(one.value for one in cls)}")


@dataclass(frozen=True)
class SearchResult:
    """What a strategy found."""

    y: np.ndarray | None
    """(variables,) obeys Eq. (9) to the QP solver's accuracy; None if no QP had a solution."""
    relaxed: bool
    """True where no states were found feasible: ``y`` then only obeys 0 <= x and 0 <= w."""
    states: np.ndarray
    """(n,)."""
    objective: float
    """With the program's constant; infinite without ``y``."""
    qp_count: int
    infeasible: int
    """QPs without a solution among them."""


@dataclass
class _StateSearch:
    """Solves for states, counts, and keeps the best."""

    program: ContactProgram
    qp: QuadraticProgram
    limit: int
    zero: float = 1e-4
    count: int = 0
    infeasible: int = 0
    relaxed: QpSolution | None = None
    """Optimum without complementarity: no states give a lower objective."""
    best: QpSolution | None = None
    states: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    moves: Callable[..., list[Pivot]] = proposed_pivots
    visited: set[bytes] = field(default_factory=set)

    def try_states(self, states: np.ndarray) -> bool:
        """Solve for ``states`` unless that was done before; whether it is the best so far."""
        limit = self.limit if self.settled else RESTART_BUDGET * self.limit
        if self.count >= limit or states.tobytes() in self.visited:
            return False
        self.visited.add(states.tobytes())
        self.count += 1
        solution = self.qp.solve(*self.program.bounds(states))
        if not solution.usable:
            self.infeasible += 1
            return False
        if self.best is not None and solution.objective >= self.best.objective - 1e-9:
            return False
        self.best, self.states = solution, states
        return True

    def try_activations(self, activations: np.ndarray) -> bool:
        """Solve for the states that follow from ``activations`` (M,), which have a solution; whether there is one."""
        y = contact_response(self.program, activations)
        if y is None:
            return False
        states = states_of_pairs(self.program.layout, *self.program.pairs(y))
        objective = self.program.objective(y)
        self.best = QpSolution(QpStatus.SOLVED, y, np.zeros(len(self.program.A)), objective - self.program.constant)
        self.states = states
        if not self.is_within_gap(STOP_GAP):
            self.try_states(states)
        return True

    def is_within_gap(self, factor: float, share: float = 0.0) -> bool:
        """Whether no states can be better by more than ``factor``,
        or by more than a ``share`` of the cost of doing nothing.
        """
        if self.best is None or self.relaxed is None:
            return False
        constant = self.program.constant
        bound = self.relaxed.objective + constant
        return self.best.objective + constant <= max(factor * bound, bound + share * constant)

    @property
    def settled(self) -> bool:
        """Whether the best is good enough to stop looking elsewhere."""
        return self.is_within_gap(RESTART_GAP, NEGLIGIBLE_GAIN)

    def pivots(self) -> list[Pivot]:
        """Of the best point."""
        if self.best is None:
            return []
        x, w = self.program.pairs(self.best.x)
        return self.moves(self.program.layout, self.states, x, w, self.best.multipliers, zero=self.zero)

    def result(self) -> SearchResult:
        """What was found."""
        point = self.best or self.relaxed
        if point is None:
            return SearchResult(None, True, self.states, float("inf"), self.count, self.infeasible)
        objective = point.objective + self.program.constant
        states = self.states if self.best else states_of_pairs(self.program.layout, *self.program.pairs(point.x))
        return SearchResult(point.x, self.best is None, states, objective, self.count, self.infeasible)


@dataclass(frozen=True)
class PredictedContact:
    """Stage 1: what known activations, first those of the last step, would bring."""

    activations: np.ndarray
    """(M,) in their bounds."""
    forces: np.ndarray
    """(n, 3) body weights: normal and two tangents of each contact."""
    velocities: np.ndarray
    """(n, 3) sqrt(g H)."""


def search_program(
    program: CoulombProgram,
    strategy: Strategy | str,
    foreseen: PredictedContact,
    *,
    directions: int,
    qp_limit: int,
    solver: QpSolver | str = QpSolver.OSQP,
    device: Device = None,
) -> ModeSearchResult:
    """Activations and contact forces of a step's program by ``strategy`` (or its name), with at most ``qp_limit`` QPs
    (``PATIENCE`` times as many in doubt); all but ``PIECES`` have a friction pyramid of ``directions`` edges.
    ``solver`` and ``device``: see ``quadratic_program``.
    """
    strategy = Strategy(strategy)
    if strategy is Strategy.MODES:
        how = _SearchOptions(qp_limit, QpSolver(solver), device)
        return _search_with_restart(program, _first_search(program, foreseen, how), foreseen.forces, how)
    paired = ContactProgram.of(program, directions)
    predicted = states_from_prediction(
        foreseen.forces[:, 0], foreseen.forces[:, 1:], foreseen.velocities[:, 1:], program.friction, directions
    )
    found = find_states(
        paired, strategy, predicted, foreseen.activations, qp_limit=qp_limit, solver=solver, device=device
    )
    x = None if found.y is None else paired.forces_of(found.y)
    return ModeSearchResult(x, found.objective, found.qp_count, found.infeasible)


def needs_restart(objective: float, contacts: int) -> bool:
    """Whether an end of a step may have a better one elsewhere."""
    return contacts > 0 and not objective < RESTART_COST


@dataclass(frozen=True)
class _SearchOptions:
    """Pieces are searched."""

    qp_limit: int
    solver: QpSolver
    device: Device


def _first_search(program: CoulombProgram, foreseen: PredictedContact, how: _SearchOptions) -> ModeSearchResult:
    """From what is foreseen."""
    start = np.concatenate([foreseen.activations, foreseen.forces.ravel()])
    return _search_from(program, start, foreseen.forces, how)


def _search_with_restart(
    program: CoulombProgram, found: ModeSearchResult, forces: np.ndarray, how: _SearchOptions
) -> ModeSearchResult:
    """``found``, or better if that costs so much that it is doubted."""
    if not needs_restart(found.objective, program.contact_count):
        return found
    return _restart(program, found, forces, how)


def _search_from(
    program: CoulombProgram, start: np.ndarray, forces: np.ndarray, how: _SearchOptions
) -> ModeSearchResult:
    """From ``start`` (m + 3n,), in the piece of ``forces`` (n, 3), which are those of it or near them."""
    modes, solver = ContactModes.of(forces, program.friction), how.solver
    if solver is QpSolver.ADMM:
        found = search_modes_device(program, start, modes, qp_limit=how.qp_limit, device=wp.get_device(how.device))
        if found is not None:
            return found
        solver = QpSolver.OSQP
    return search_modes(program, start, modes, qp_limit=how.qp_limit, solver=solver, device=how.device)


def _restart(
    program: CoulombProgram, found: ModeSearchResult, forces: np.ndarray, how: _SearchOptions
) -> ModeSearchResult:
    """See ``better_elsewhere``; ``forces`` (n, 3) are a guess."""
    # Thousands of iterations, one after the other, are not for a GPU.
    bound_by = QpSolver.OSQP if how.solver is QpSolver.ADMM else how.solver

    def search(activations: np.ndarray) -> ModeSearchResult:
        start = program.contact_response(activations, forces)
        return _search_from(program, start, start[program.activation_count :].reshape(-1, 3), how)

    return restart_from_relaxation(found, solve_relaxed(program, bound_by, device=how.device), search)


def restart_from_relaxation(
    found: ModeSearchResult,
    relaxed: tuple[np.ndarray, float] | None,
    search: Callable[[np.ndarray], ModeSearchResult],
) -> ModeSearchResult:
    """The better of ``found`` and of a ``search`` from where the optimum without complementarity, ``relaxed`` (see
    ``solve_relaxed``), would end up under true contact: from its activations (m,)."""
    found = replace(found, qp_count=found.qp_count + 1)
    if relaxed is None or found.objective <= RESTART_GAP * relaxed[1]:
        return found
    other = search(relaxed[0])
    best = min(found, other, key=lambda one: one.objective)
    return replace(best, qp_count=found.qp_count + other.qp_count, infeasible=found.infeasible + other.infeasible)


def find_states(
    program: ContactProgram,
    strategy: Strategy | str,
    predicted: np.ndarray,
    activations: np.ndarray,
    *,
    qp_limit: int,
    solver: QpSolver | str = QpSolver.OSQP,
    device: Device = None,
) -> SearchResult:
    """Contact states and the optimum for them by ``strategy`` (or its name), which is not ``PIECES``.

    ``predicted`` (n,) states of stage 1 (Eq. 12); ``activations`` (M,) of the last step, in their bounds. Where a
    strategy's own first states have no solution, it starts from those that follow from ``activations``, which always
    have one. ``solver`` and ``device``: see ``quadratic_program``.
    """
    strategy = Strategy(strategy)
    if strategy is Strategy.EXACT:
        found = exact_states(program, starts=(predicted,))
        if found is None:
            return SearchResult(None, True, predicted, float("inf"), 0, 0)
        return SearchResult(found.y, False, found.states, found.objective, found.qp_count, 0)
    qp = quadratic_program(program.P, program.q, program.A, solver=solver, device=device)
    search = _StateSearch(program, qp, qp_limit)
    if strategy is Strategy.RELAXED:
        _start_relaxed(search, predicted, activations)
        _move(search, together=True)
        for start in _other_starts(search, predicted):
            if search.settled:
                break
            kept = search.best, search.states
            search.best = None
            search.try_states(start)
            _move(search, together=True)
            if kept[0] is not None and (search.best is None or search.best.objective > kept[0].objective):
                search.best, search.states = kept
        return search.result()
    search.try_states(predicted if strategy is Strategy.PAPER else np.full(program.layout.contacts, STATIC))
    if search.best is None:
        search.try_activations(activations)
    if strategy is not Strategy.STATIC:
        search.moves = proposed_pivots if strategy is Strategy.QPCC_OUR_MOVES else plain_pivots
        _move(search, together=False)
    return search.result()


def contact_response(program: ContactProgram, activations: np.ndarray) -> np.ndarray | None:
    """(variables,) what contact and friction make of given ``activations`` (M,): the y that obeys Eq. (9); None if none
    is found.

    There always is one, whatever the contacts: the starts that it gives never lose a frame.
    """
    layout = program.layout
    rows, offset = program.A[layout.variables :], program.offset[layout.variables :]
    x = lemke(rows[:, layout.activations :], offset + rows[:, : layout.activations] @ activations)
    return None if x is None else np.concatenate([activations, x])


def _start_relaxed(search: _StateSearch, predicted: np.ndarray, activations: np.ndarray) -> None:
    """Begin where the optimum without complementarity, 0 <= x and 0 <= w alone, would end up under true contact.

    Its objective is a bound on every state's; its activations are mostly right, its forces are not.
    """
    program, layout = search.program, search.program.layout
    lower, upper = program.bounds(np.full(layout.contacts, STATIC))
    upper[layout.activations :] = np.inf
    search.count += 1
    relaxed = search.qp.solve(lower, upper)
    if relaxed.usable:
        search.relaxed = relaxed
        activations = np.clip(relaxed.x[: layout.activations], program.lower, program.upper)
    if not search.try_activations(activations):
        search.try_states(predicted)


def _other_starts(search: _StateSearch, predicted: np.ndarray) -> Iterator[np.ndarray]:
    """States (n,) worth another search: feet that hold where the best point without complementarity presses, or where
    the prediction does, and the predicted states themselves."""
    if search.relaxed is not None:
        layout = search.program.layout
        pressed = search.relaxed.x[layout.normal] > LOADED_FORCE
        yield np.where(pressed, STATIC, SEPARATE)
    yield np.where(predicted == SEPARATE, SEPARATE, STATIC)
    yield predicted


def _move(search: _StateSearch, *, together: bool) -> None:
    """Move contacts to their better states while that lowers the objective:
    each contact's best move ``together``, else one by one.
    """
    improved = search.best is not None
    while improved and not search.is_within_gap(STOP_GAP):
        pivots = search.pivots()
        trials = [_moved(search.states, [pivot]) for pivot in pivots]
        if together:
            trials.insert(0, _moved(search.states, pivots[::-1]))  # the last word on a contact is its best
        improved = any(search.try_states(trial) for trial in trials)


def _moved(states: np.ndarray, pivots: list[Pivot]) -> np.ndarray:
    moved = states.copy()
    for pivot in pivots:
        moved[pivot.contact] = pivot.state
    return moved
