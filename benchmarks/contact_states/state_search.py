"""Searches over contact states with a friction pyramid, to be compared with the engine's strategies (Eq. 13).

See docs/benchmarks/contact.md#searches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from benchmarks.contact_states.branch_and_bound import exact_states
from benchmarks.contact_states.complementarity import (
    SEPARATE,
    STATIC,
    Pivot,
    plain_pivots,
    proposed_pivots,
    states_of_modes,
    states_of_pairs,
)
from benchmarks.contact_states.lemke import lemke
from benchmarks.contact_states.pyramid_program import PyramidProgram
from egs_warp.locomotion.contact_modes import CoulombProgram, ModeSearchResult, PredictedContact
from egs_warp.locomotion.operator_splitting import QpStatus
from egs_warp.locomotion.paper_strategy import predicted_modes
from egs_warp.locomotion.solvers import QpSolution, QpSolver, QuadraticProgram, quadratic_program

STOP_GAP = 1.005
"""A search ends if the objective is at most this factor times its lower bound."""
RESTART_GAP = 1.2
"""A search restarts from other states, with ``RESTART_BUDGET`` times as many QPs, if the objective is more than this
factor times its lower bound."""
NEGLIGIBLE_GAIN = 0.01
"""Minimum possible gain for which a search restarts, as a fraction of the objective without muscle and contact
forces."""
LOADED_FORCE = 1e-3
"""Minimum normal force of a loaded contact, body weights."""
RESTART_BUDGET = 3
"""Factor by which restarts raise the limit of QPs, because sliding feet have many states with similar objectives."""


class StateSearch(Enum):
    """Search over contact states."""

    STATIC = "static"
    """All contacts static: one QP."""
    QPCC = "qpcc"
    """Start with all contacts static; change one contact at a time by its multipliers (Tan, Turk and Liu 2012)."""
    QPCC_OUR_MOVES = "qpcc-our-moves"
    """``qpcc`` with the moves of ``relaxed``, to measure the effect of the moves alone."""
    RELAXED = "relaxed"
    """Start from the contact response to the activations of the relaxed optimum; change several contacts at a time."""
    EXACT = "exact"
    """Global optimum by branch and bound, for small problems."""


@dataclass(frozen=True)
class SearchResult:
    """Result of a search over contact states."""

    y: np.ndarray | None
    """(variables,) solution that satisfies Eq. (9) to the QP solver's accuracy; None if no QP had a solution."""
    relaxed: bool
    """True if none of the states that were tried was feasible; ``y`` then only satisfies 0 <= x and 0 <= w."""
    states: np.ndarray
    """(n,) contact states of the solution."""
    objective: float
    """Objective, including the QP's constant; infinite if ``y`` is None."""
    qp_count: int
    """Number of QPs that were solved."""
    infeasible: int
    """Number of QPs without a solution."""


@dataclass
class _Search:
    """Search over contact states, which solves and counts QPs and stores the best solution."""

    program: PyramidProgram
    qp: QuadraticProgram
    limit: int
    """Maximum number of QPs; it is multiplied by ``RESTART_BUDGET`` while ``best`` is far from the bound."""
    zero: float = 1e-4
    """Value up to which sides of pairs and multipliers are treated as zero."""
    count: int = 0
    infeasible: int = 0
    relaxed: QpSolution | None = None
    """Optimum without complementarity. Its objective is a lower bound on the objectives of all states."""
    best: QpSolution | None = None
    states: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """(n,) states of ``best``."""
    moves: Callable[..., list[Pivot]] = proposed_pivots
    """Function that proposes changes of state."""
    visited: set[bytes] = field(default_factory=set)
    """Contact states that have been tried."""

    def try_states(self, states: np.ndarray) -> bool:
        """Solve the QP of ``states`` unless it was tried before or the limit is reached.

        Return True if its solution is the best so far.
        """
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
        """Solve the QP of the states that follow from ``activations`` (M,); this QP is always feasible.

        Return False if the contact response to the activations was not found.
        """
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
        """Return True if the best objective is at most ``factor`` times its lower bound, or exceeds it by at most
        ``share`` times the objective without muscle and contact forces."""
        if self.best is None or self.relaxed is None:
            return False
        constant = self.program.constant
        bound = self.relaxed.objective + constant
        return self.best.objective + constant <= max(factor * bound, bound + share * constant)

    @property
    def is_good_enough(self) -> bool:
        """True if the best objective is so close to its lower bound that no restart is needed."""
        return self.is_within_gap(RESTART_GAP, NEGLIGIBLE_GAIN)

    def pivots(self) -> list[Pivot]:
        """Return the changes of state proposed at the best point, largest gain first."""
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


def search_pyramid(
    program: CoulombProgram,
    kind: StateSearch,
    predicted: PredictedContact,
    *,
    directions: int,
    qp_limit: int,
    solver: QpSolver | str,
) -> ModeSearchResult:
    """Find activations and contact forces of a step with the search ``kind``.

    Args:
        program: the QP of the step.
        kind: search to run.
        predicted: predicted contact, from which the search starts.
        directions: number of edges of the friction pyramid.
        qp_limit: maximum number of QPs; a search may use ``RESTART_BUDGET`` times as many.
        solver: QP solver, see ``quadratic_program``.
    """
    pyramid = PyramidProgram.of(program, directions)
    states = states_of_modes(predicted_modes(predicted, program.friction, directions), directions)
    result = find_states(pyramid, kind, states, predicted.activations, qp_limit=qp_limit, solver=solver)
    x = None if result.y is None else pyramid.forces_of(result.y)
    return ModeSearchResult(x, result.objective, result.qp_count, result.infeasible)


def find_states(
    program: PyramidProgram,
    kind: StateSearch,
    predicted: np.ndarray,
    activations: np.ndarray,
    *,
    qp_limit: int,
    solver: QpSolver | str = QpSolver.OSQP,
) -> SearchResult:
    """Find contact states and the optimum of their QP with the search ``kind``.

    If the first states of a search have no solution, it starts from the states that follow from ``activations``,
    which always have one.

    Args:
        program: the QP with a friction pyramid.
        kind: search to run.
        predicted: (n,) predicted states (Eq. 12).
        activations: (M,) predicted activations, as fractions of their bounds.
        qp_limit: maximum number of QPs.
        solver: QP solver, see ``quadratic_program``.
    """
    if kind is StateSearch.EXACT:
        result = exact_states(program, starts=(predicted,))
        if result is None:
            return SearchResult(None, True, predicted, float("inf"), 0, 0)
        return SearchResult(result.y, False, result.states, result.objective, result.qp_count, 0)
    qp = quadratic_program(program.P, program.q, program.A, solver=solver)
    search = _Search(program, qp, qp_limit)
    if kind is StateSearch.RELAXED:
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
    search.try_states(np.full(program.layout.contacts, STATIC))
    if search.best is None:
        search.try_activations(activations)
    if kind is not StateSearch.STATIC:
        search.moves = proposed_pivots if kind is StateSearch.QPCC_OUR_MOVES else plain_pivots
        _move(search, together=False)
    return search.result()


def contact_response(program: PyramidProgram, activations: np.ndarray) -> np.ndarray | None:
    """Return y (variables,): ``activations`` (M,) and the contact response to them that satisfies Eq. (9).

    The response is computed by Lemke's method. A solution always exists; the result is None if rounding or the pivot
    limit stops the method before it finds one.
    """
    layout = program.layout
    rows, offset = program.A[layout.variables :], program.offset[layout.variables :]
    x = lemke(rows[:, layout.activations :], offset + rows[:, : layout.activations] @ activations)
    return None if x is None else np.concatenate([activations, x])


def _start_relaxed(search: _Search, predicted: np.ndarray, activations: np.ndarray) -> None:
    """Start from the contact response to the activations of the relaxed optimum, which only satisfies 0 <= x and 0 <=
    w. Its objective bounds the objective of all states from below. Its activations are usually near the optimum; its
    forces are not."""
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


def _other_starts(search: _Search, predicted: np.ndarray) -> Iterator[np.ndarray]:
    """Yield states (n,) for restarts: first, contacts are static where the relaxed optimum has a normal force; second,
    where the prediction has one; last, the predicted states."""
    if search.relaxed is not None:
        layout = search.program.layout
        loaded = search.relaxed.x[layout.normal] > LOADED_FORCE
        yield np.where(loaded, STATIC, SEPARATE)
    yield np.where(predicted == SEPARATE, SEPARATE, STATIC)
    yield predicted


def _move(search: _Search, *, together: bool) -> None:
    """Change states by the proposed moves while this lowers the objective. With ``together``, first try the best moves
    of all contacts at once, then one move at a time."""
    improved = search.best is not None
    while improved and not search.is_within_gap(STOP_GAP):
        pivots = search.pivots()
        trials = [_moved(search.states, [pivot]) for pivot in pivots]
        if together:
            # Reverse the order, so that the best move of each contact is applied last.
            trials.insert(0, _moved(search.states, pivots[::-1]))
        improved = any(search.try_states(trial) for trial in trials)


def _moved(states: np.ndarray, pivots: list[Pivot]) -> np.ndarray:
    moved = states.copy()
    for pivot in pivots:
        moved[pivot.contact] = pivot.state
    return moved
