"""Strategies that choose the contact states of a step's program (Eq. 13): static, QPCC, two-stage, exact.

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from egs_warp.errors import UserError
from egs_warp.locomotion.branch_and_bound import exact_states
from egs_warp.locomotion.complementarity import SEPARATE, STATIC, Pivot, plain_pivots, proposed_pivots, states_of_pairs
from egs_warp.locomotion.lemke import lemke
from egs_warp.locomotion.program import ContactProgram
from egs_warp.locomotion.solvers import QpSolution, QpSolver, QpStatus, QuadraticProgram, quadratic_program

GOOD_ENOUGH = 1.005
"""A search ends when the objective is within this factor of its bound."""
DOUBTFUL = 1.2
"""A search that ends further than this factor from its bound is done again from other states,
with ``PATIENCE`` times as many QPs.
"""
IMMATERIAL = 0.01
"""Unless there is no more to gain than this share of what it costs to do nothing,
to fall without muscles and ground.
"""
PRESSED = 1e-3
"""Body weights, of a contact that holds."""
PATIENCE = 3
"""Feet that slide have many states that are nearly as likely."""


class Strategy(Enum):
    """How the contact states are found; all solve the same programs."""

    STATIC = "static"
    """Every contact stays static: one QP."""
    QPCC = "qpcc"
    """From all-static, one contact at a time, as its own multipliers say (after Tan, Turk and Liu 2012)."""
    QPCC_OUR_MOVES = "qpcc-our-moves"
    """The same from all-static with the moves of two-stage: what the moves alone are worth."""
    TWO_STAGE = "two-stage"
    """From the states that stage 1 predicts, several contacts at a time (the paper's Eq. 12 and 13)."""
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
class _Search:
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

    def attempt(self, states: np.ndarray) -> bool:
        """Solve for ``states`` unless that was done before; whether it is the best so far."""
        limit = self.limit if self.settled else PATIENCE * self.limit
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

    def attempt_contact(self, activations: np.ndarray) -> bool:
        """Solve for the states that follow from ``activations`` (M,), which have a solution; whether there is one."""
        y = contact_under(self.program, activations)
        if y is None:
            return False
        states = states_of_pairs(self.program.layout, *self.program.pairs(y))
        objective = self.program.objective(y)
        self.best = QpSolution(QpStatus.SOLVED, y, np.zeros(len(self.program.A)), objective - self.program.constant)
        self.states = states
        if not self.within(GOOD_ENOUGH):
            self.attempt(states)
        return True

    def within(self, factor: float, share: float = 0.0) -> bool:
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
        return self.within(DOUBTFUL, IMMATERIAL)

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


def find_states(
    program: ContactProgram,
    strategy: Strategy | str,
    predicted: np.ndarray,
    activations: np.ndarray,
    *,
    qp_limit: int,
    solver: QpSolver | str = QpSolver.OSQP,
) -> SearchResult:
    """Contact states and the optimum for them by ``strategy`` (or its name).

    ``predicted`` (n,) states of stage 1 (Eq. 12); ``activations`` (M,) of the last step, in their bounds. Where a
    strategy's own first states have no solution, it starts from those that follow from ``activations``, which always
    have one.
    """
    strategy = Strategy(strategy)
    if strategy is Strategy.EXACT:
        found = exact_states(program, starts=(predicted,))
        if found is None:
            return SearchResult(None, True, predicted, float("inf"), 0, 0)
        return SearchResult(found.y, False, found.states, found.objective, found.qp_count, 0)
    qp = quadratic_program(program.P, program.q, program.A, solver=solver)
    search = _Search(program, qp, qp_limit)
    if strategy is Strategy.TWO_STAGE:
        _start_relaxed(search, predicted, activations)
        _move(search, together=True)
        for start in _other_starts(search, predicted):
            if search.settled:
                break
            kept = search.best, search.states
            search.best = None
            search.attempt(start)
            _move(search, together=True)
            if kept[0] is not None and (search.best is None or search.best.objective > kept[0].objective):
                search.best, search.states = kept
        return search.result()
    search.attempt(np.full(program.layout.contacts, STATIC))
    if search.best is None:
        search.attempt_contact(activations)
    if strategy is not Strategy.STATIC:
        search.moves = plain_pivots if strategy is Strategy.QPCC else proposed_pivots
        _move(search, together=False)
    return search.result()


def contact_under(program: ContactProgram, activations: np.ndarray) -> np.ndarray | None:
    """(variables,) what contact and friction make of given ``activations`` (M,): the y that obeys Eq. (9); None if none
    is found.

    There always is one, whatever the contacts: the starts that it gives never lose a frame.
    """
    layout = program.layout
    rows, offset = program.A[layout.variables :], program.offset[layout.variables :]
    x = lemke(rows[:, layout.activations :], offset + rows[:, : layout.activations] @ activations)
    return None if x is None else np.concatenate([activations, x])


def _start_relaxed(search: _Search, predicted: np.ndarray, activations: np.ndarray) -> None:
    """Begin where the optimum without complementarity, 0 <= x and 0 <= w alone, would end up under true contact.

    Its objective is a bound on every state's; its activations are mostly right, its forces are not.
    """
    program, layout = search.program, search.program.layout
    lower, upper = layout.bounds(np.full(layout.contacts, STATIC))
    upper[layout.activations :] = np.inf
    search.count += 1
    relaxed = search.qp.solve(lower - program.offset, upper - program.offset)
    if relaxed.usable:
        search.relaxed = relaxed
        activations = np.clip(relaxed.x[: layout.activations], -1.0, 1.0)
    if not search.attempt_contact(activations):
        search.attempt(predicted)


def _other_starts(search: _Search, predicted: np.ndarray) -> Iterator[np.ndarray]:
    """States (n,) worth another search: feet that hold where the best point without complementarity presses, or where
    the prediction does, and the predicted states themselves."""
    if search.relaxed is not None:
        layout = search.program.layout
        pressed = search.relaxed.x[layout.normal] > PRESSED
        yield np.where(pressed, STATIC, SEPARATE)
    yield np.where(predicted == SEPARATE, SEPARATE, STATIC)
    yield predicted


def _move(search: _Search, *, together: bool) -> None:
    """Move contacts to their better states while that lowers the objective:
    each contact's best move ``together``, else one by one.
    """
    improved = search.best is not None
    while improved and not search.within(GOOD_ENOUGH):
        pivots = search.pivots()
        trials = [_moved(search.states, [pivot]) for pivot in pivots]
        if together:
            trials.insert(0, _moved(search.states, pivots[::-1]))  # the last word on a contact is its best
        improved = any(search.attempt(trial) for trial in trials)


def _moved(states: np.ndarray, pivots: list[Pivot]) -> np.ndarray:
    moved = states.copy()
    for pivot in pivots:
        moved[pivot.contact] = pivot.state
    return moved
