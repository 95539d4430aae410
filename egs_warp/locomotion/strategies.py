"""Strategies that search the activations of a step over contact modes or contact states (Eq. 13).

``search_program`` is the entry point. See docs/concepts/locomotion.md#contact-states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import warp as wp

from egs_warp.errors import UserError, did_you_mean
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
"""A search over states ends if the objective is within this factor of its lower bound."""
RESTART_GAP = 1.2
"""A search restarts from other states, with ``RESTART_BUDGET`` times as many QPs, if the objective exceeds its lower
bound by more than this factor."""
NEGLIGIBLE_GAIN = 0.01
"""No restart if less than this fraction of the cost of doing nothing (no muscle and no contact force) could be
gained."""
RESTART_COST = 0.3
"""A mode search restarts only if the end of the step costs at least this."""
LOADED_FORCE = 1e-3
"""Body weights, normal force from which a contact counts as loaded."""
RESTART_BUDGET = 3
"""Factor on the number of QPs for restarts: sliding feet have many states of similar cost."""


class Strategy(Enum):
    """Search for the contact modes or states of a step."""

    MODES = "modes"
    """Search over contact modes (``contact_modes``) from the predicted modes. The only strategy with the exact friction
    cone, and with no unknowns but the activations."""
    PAPER = "paper"
    """The paper's: the QP in the predicted states (Eq. 12), then one contact at a time by its multipliers."""
    STATIC = "static"
    """All contacts static: one QP."""
    QPCC = "qpcc"
    """From all contacts static, one contact at a time by its multipliers (after Tan, Turk and Liu 2012)."""
    QPCC_OUR_MOVES = "qpcc-our-moves"
    """``qpcc`` with the moves of ``relaxed``, to measure the moves alone."""
    RELAXED = "relaxed"
    """From the contact response to the activations of the relaxed optimum, several contacts at a time."""
    EXACT = "exact"
    """Global optimum by branch and bound, for small problems."""

    @classmethod
    def _missing_(cls, value: object) -> Strategy:
        names = [one.value for one in cls]
        raise UserError(f"strategy {value!r} is not known{did_you_mean(value, names)}; give one of {', '.join(names)}")


@dataclass(frozen=True)
class SearchResult:
    """Result of a search over contact states."""

    y: np.ndarray | None
    """(variables,), satisfies Eq. (9) to the QP solver's accuracy; None if no QP had a solution."""
    relaxed: bool
    """True if no states were feasible: ``y`` then only satisfies 0 <= x and 0 <= w."""
    states: np.ndarray
    """(n,) contact states."""
    objective: float
    """With the QP's constant; infinite without ``y``."""
    qp_count: int
    """Number of QPs that were solved."""
    infeasible: int
    """Number of QPs without a solution."""


@dataclass
class _StateSearch:
    """Search over contact states: solves QPs, counts them, and stores the best solution."""

    program: ContactProgram
    qp: QuadraticProgram
    limit: int
    """Maximum number of QPs, or ``RESTART_BUDGET`` times as many while the best is far from the bound."""
    zero: float = 1e-4
    """Tolerance of zero in pairs and multipliers."""
    count: int = 0
    infeasible: int = 0
    relaxed: QpSolution | None = None
    """Optimum without complementarity, a lower bound on the objective of all states."""
    best: QpSolution | None = None
    states: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """(n,) states of ``best``."""
    moves: Callable[..., list[Pivot]] = proposed_pivots
    """Function that proposes changes of state."""
    visited: set[bytes] = field(default_factory=set)
    """States that were tried."""

    def try_states(self, states: np.ndarray) -> bool:
        """Solve the QP of ``states`` unless it was solved before; return True if it is the best so far."""
        limit = self.limit if self.is_good_enough else RESTART_BUDGET * self.limit
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
        """Solve the QP of the states that follow from ``activations`` (M,), which is always feasible; return False if
        the contact response to the activations was not found."""
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
        """Return True if no states can be better by more than ``factor``, or by more than a ``share`` of the cost of
        doing nothing."""
        if self.best is None or self.relaxed is None:
            return False
        constant = self.program.constant
        bound = self.relaxed.objective + constant
        return self.best.objective + constant <= max(factor * bound, bound + share * constant)

    @property
    def is_good_enough(self) -> bool:
        """True if the best is good enough not to restart."""
        return self.is_within_gap(RESTART_GAP, NEGLIGIBLE_GAIN)

    def pivots(self) -> list[Pivot]:
        """Return the changes of state that are proposed at the best point, best first."""
        if self.best is None:
            return []
        x, w = self.program.pairs(self.best.x)
        return self.moves(self.program.layout, self.states, x, w, self.best.multipliers, zero=self.zero)

    def result(self) -> SearchResult:
        """Return the best point, or the relaxed optimum if no states were feasible."""
        point = self.best or self.relaxed
        if point is None:
            return SearchResult(None, True, self.states, float("inf"), self.count, self.infeasible)
        objective = point.objective + self.program.constant
        states = self.states if self.best else states_of_pairs(self.program.layout, *self.program.pairs(point.x))
        return SearchResult(point.x, self.best is None, states, objective, self.count, self.infeasible)


@dataclass(frozen=True)
class PredictedContact:
    """Predicted contact of a step (Eq. 12) in the units of the QP."""

    activations: np.ndarray
    """(M,) as fractions of their bounds."""
    forces: np.ndarray
    """(n, 3) body weights: normal and two tangential components of each contact."""
    velocities: np.ndarray
    """(n, 3) in sqrt(g H), contact velocities at the predicted end."""


def search_program(
    program: CoulombProgram,
    strategy: Strategy | str,
    predicted: PredictedContact,
    *,
    directions: int,
    qp_limit: int,
    solver: QpSolver | str = QpSolver.OSQP,
    device: Device = None,
) -> ModeSearchResult:
    """Find activations and contact forces of a step by ``strategy`` (or its name).

    Args:
        program: the QP of the step.
        predicted: predicted contact, from which the search starts.
        directions: number of edges of the friction pyramid of all strategies but ``modes``.
        qp_limit: maximum number of QPs; all strategies but ``modes`` may use ``RESTART_BUDGET`` times as many.
        solver: QP solver, see ``quadratic_program``.
        device: device of the solver ``admm``.
    """
    strategy = Strategy(strategy)
    if strategy is Strategy.MODES:
        options = _SearchOptions(qp_limit, QpSolver(solver), device)
        return _search_with_restart(program, _first_search(program, predicted, options), predicted.forces, options)
    pyramid_program = ContactProgram.of(program, directions)
    predicted_states = states_from_prediction(
        predicted.forces[:, 0], predicted.forces[:, 1:], predicted.velocities[:, 1:], program.friction, directions
    )
    result = find_states(
        pyramid_program,
        strategy,
        predicted_states,
        predicted.activations,
        qp_limit=qp_limit,
        solver=solver,
        device=device,
    )
    x = None if result.y is None else pyramid_program.forces_of(result.y)
    return ModeSearchResult(x, result.objective, result.qp_count, result.infeasible)


def needs_restart(objective: float, contacts: int) -> bool:
    """Return True if a mode search with this ``objective`` should restart from the relaxed optimum."""
    return contacts > 0 and not objective < RESTART_COST


@dataclass(frozen=True)
class _SearchOptions:
    """Options of a mode search."""

    qp_limit: int
    solver: QpSolver
    device: Device


def _first_search(program: CoulombProgram, predicted: PredictedContact, options: _SearchOptions) -> ModeSearchResult:
    """Search from the predicted activations, in the predicted modes."""
    start = np.concatenate([predicted.activations, predicted.forces.ravel()])
    return _search_from(program, start, predicted.forces, options)


def _search_with_restart(
    program: CoulombProgram, result: ModeSearchResult, forces: np.ndarray, options: _SearchOptions
) -> ModeSearchResult:
    """Return ``result``, or the better result of a restart if its objective is high."""
    if not needs_restart(result.objective, program.contact_count):
        return result
    return _restart(program, result, forces, options)


def _search_from(
    program: CoulombProgram, start: np.ndarray, forces: np.ndarray, options: _SearchOptions
) -> ModeSearchResult:
    """Search from ``start`` (m + 3n,), in the modes of ``forces`` (n, 3). ``admm`` searches on the device; after a
    numerical failure there, the host repeats the search with OSQP."""
    modes, solver = ContactModes.of(forces, program.friction), options.solver
    if solver is QpSolver.ADMM:
        result = search_modes_device(
            program, start, modes, qp_limit=options.qp_limit, device=wp.get_device(options.device)
        )
        if result is not None:
            return result
        solver = QpSolver.OSQP
    return search_modes(program, start, modes, qp_limit=options.qp_limit, solver=solver, device=options.device)


def _restart(
    program: CoulombProgram, result: ModeSearchResult, forces: np.ndarray, options: _SearchOptions
) -> ModeSearchResult:
    """Restart from the relaxed optimum, see ``restart_from_relaxation``; the Coulomb solve starts from ``forces`` (n,
    3)."""
    # On the host, because thousands of sequential iterations are slow on a GPU.
    relaxed_solver = QpSolver.OSQP if options.solver is QpSolver.ADMM else options.solver

    def search(activations: np.ndarray) -> ModeSearchResult:
        start = program.contact_response(activations, forces)
        return _search_from(program, start, start[program.activation_count :].reshape(-1, 3), options)

    return restart_from_relaxation(result, solve_relaxed(program, relaxed_solver, device=options.device), search)


def restart_from_relaxation(
    result: ModeSearchResult,
    relaxed: tuple[np.ndarray, float] | None,
    search: Callable[[np.ndarray], ModeSearchResult],
) -> ModeSearchResult:
    """Search again from the relaxed optimum if ``result`` costs more than ``RESTART_GAP`` times its objective.

    Args:
        result: result of the first search.
        relaxed: activations (m,) and objective of the relaxed optimum, see ``solve_relaxed``.
        search: search from activations (m,) and the contact forces that follow from them.

    Returns:
        The better result, with the number of QPs of both.
    """
    result = replace(result, qp_count=result.qp_count + 1)
    if relaxed is None or result.objective <= RESTART_GAP * relaxed[1]:
        return result
    other = search(relaxed[0])
    best = min(result, other, key=lambda one: one.objective)
    return replace(best, qp_count=result.qp_count + other.qp_count, infeasible=result.infeasible + other.infeasible)


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
    """Find contact states and the optimum for them by ``strategy`` (or its name), any but ``modes``.

    If the first states of a strategy have no solution, it starts from the states that follow from ``activations``,
    which always have one.

    Args:
        program: the QP with a friction pyramid.
        predicted: (n,) predicted states (Eq. 12).
        activations: (M,) of the prediction, as fractions of their bounds.
        qp_limit: maximum number of QPs.
        solver: QP solver, see ``quadratic_program``.
        device: device of the solver ``admm``.
    """
    strategy = Strategy(strategy)
    if strategy is Strategy.EXACT:
        result = exact_states(program, starts=(predicted,))
        if result is None:
            return SearchResult(None, True, predicted, float("inf"), 0, 0)
        return SearchResult(result.y, False, result.states, result.objective, result.qp_count, 0)
    qp = quadratic_program(program.P, program.q, program.A, solver=solver, device=device)
    search = _StateSearch(program, qp, qp_limit)
    if strategy is Strategy.RELAXED:
        _start_relaxed(search, predicted, activations)
        _move(search, together=True)
        for start in _other_starts(search, predicted):
            if search.is_good_enough:
                break
            best = search.best, search.states
            search.best = None
            search.try_states(start)
            _move(search, together=True)
            if best[0] is not None and (search.best is None or search.best.objective > best[0].objective):
                search.best, search.states = best
        return search.result()
    search.try_states(predicted if strategy is Strategy.PAPER else np.full(program.layout.contacts, STATIC))
    if search.best is None:
        search.try_activations(activations)
    if strategy is not Strategy.STATIC:
        search.moves = proposed_pivots if strategy is Strategy.QPCC_OUR_MOVES else plain_pivots
        _move(search, together=False)
    return search.result()


def contact_response(program: ContactProgram, activations: np.ndarray) -> np.ndarray | None:
    """Return y (variables,), the contact response to ``activations`` (M,) that satisfies Eq. (9), by Lemke's method;
    None if none is found. A solution always exists, so a step never fails for lack of a start."""
    layout = program.layout
    rows, offset = program.A[layout.variables :], program.offset[layout.variables :]
    x = lemke(rows[:, layout.activations :], offset + rows[:, : layout.activations] @ activations)
    return None if x is None else np.concatenate([activations, x])


def _start_relaxed(search: _StateSearch, predicted: np.ndarray, activations: np.ndarray) -> None:
    """Start from the contact response to the activations of the relaxed optimum, where only 0 <= x and 0 <= w hold. Its
    objective bounds that of all states from below; its activations are mostly right, its forces are not."""
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
    """Yield states (n,) for restarts: contacts static where the relaxed optimum has a normal force, then where the
    prediction has one, and the predicted states."""
    if search.relaxed is not None:
        layout = search.program.layout
        loaded = search.relaxed.x[layout.normal] > LOADED_FORCE
        yield np.where(loaded, STATIC, SEPARATE)
    yield np.where(predicted == SEPARATE, SEPARATE, STATIC)
    yield predicted


def _move(search: _StateSearch, *, together: bool) -> None:
    """Change states by the proposed moves while that lowers the objective: first the best moves of all contacts at once
    if ``together``, then one by one."""
    improved = search.best is not None
    while improved and not search.is_within_gap(STOP_GAP):
        pivots = search.pivots()
        trials = [_moved(search.states, [pivot]) for pivot in pivots]
        if together:
            trials.insert(0, _moved(search.states, pivots[::-1]))  # the last move of a contact counts: its best
        improved = any(search.try_states(trial) for trial in trials)


def _moved(states: np.ndarray, pivots: list[Pivot]) -> np.ndarray:
    moved = states.copy()
    for pivot in pivots:
        moved[pivot.contact] = pivot.state
    return moved
