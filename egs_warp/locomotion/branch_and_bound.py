"""The global optimum of a step's program over all contact states, by branch and bound (Eq. 9, 13)."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from enum import Enum
from itertools import count as counter

import numpy as np

from egs_warp.locomotion.complementarity import SEPARATE, Pairs, states_of_pairs
from egs_warp.locomotion.program import ContactProgram
from egs_warp.locomotion.solvers import QpSolution, QpSolver, quadratic_program


class _Decided(Enum):
    """How much is decided about a contact."""

    NOTHING = "nothing"
    SEPARATE = "separate"
    STATIC = "static"
    ARC = "arc"
    """It slides, along directions still to be told apart."""
    SLIDE = "slide"
    """It slides along the given directions."""


_LEAVES = (_Decided.SEPARATE, _Decided.STATIC, _Decided.SLIDE)


@dataclass(frozen=True)
class _Branch:
    """What is decided about one contact; a contact that slides does so along directions ``first`` to ``last`` of the
    ring.
    """

    decided: _Decided = _Decided.NOTHING
    first: int = 0
    last: int = 0

    def children(self, directions: int) -> list[_Branch]:
        """Branches that together hold every state of this one."""
        if self.decided is _Decided.NOTHING:
            half = directions // 2
            return [
                _Branch(_Decided.SEPARATE),
                _Branch(_Decided.STATIC),
                _Branch(_Decided.ARC, 0, half),
                _Branch(_Decided.ARC, half, directions),
            ]
        if self.decided is _Decided.ARC and self.last - self.first > 1:
            # Friction lies on one edge of the pyramid or on a face between two, so the halves share only the middle
            # edge.
            middle = (self.first + self.last) // 2
            return [replace(self, last=middle), replace(self, first=middle)]
        if self.decided is _Decided.ARC:
            return [
                _Branch(_Decided.SLIDE, self.first, self.first),
                _Branch(_Decided.SLIDE, self.last, self.last),
                _Branch(_Decided.SLIDE, self.first, self.last),
            ]
        return []


@dataclass(frozen=True)
class ExactResult:
    """Best point found, and the proof."""

    y: np.ndarray
    """(variables,)."""
    states: np.ndarray
    """(n,)."""
    objective: float
    bound: float
    """No contact states give less than this."""
    qp_count: int

    @property
    def proved(self) -> bool:
        """Whether the search ended before its limit, so that no contact states give less."""
        return self.objective - self.bound <= 1e-6 * (1.0 + abs(self.objective))


def exact_states(
    program: ContactProgram,
    *,
    starts: tuple[np.ndarray, ...] = (),
    qp_limit: int = 20000,
    relative_gap: float = 0.0,
) -> ExactResult | None:
    """Global optimum of ``program``; None if no contact states are feasible (or found within ``qp_limit``).

    ``starts``: states (n,) worth trying first; a good one prunes most of the tree. Each node relaxes the pairs that are
    not decided yet to 0 <= x, 0 <= w, which is a convex QP that bounds all its states from below. The search ends when
    no node is better by more than 1e-7, or ``relative_gap`` of the best objective.
    """
    layout = program.layout
    qp = quadratic_program(program.P, program.q, program.A, solver=QpSolver.DAQP)
    solved = 0
    best: tuple[float, np.ndarray, np.ndarray] | None = None

    def consider(solution: QpSolution, states: np.ndarray) -> None:
        nonlocal best
        if solution.usable and (best is None or solution.objective < best[0]):
            best = (solution.objective, solution.x, states)

    for states in starts:
        solved += 1
        consider(qp.solve(*program.bounds(states)), states)

    order = counter()
    heap: list[tuple[float, int, tuple[_Branch, ...], QpSolution]] = []

    def push(branches: tuple[_Branch, ...]) -> None:
        nonlocal solved
        solved += 1
        lower, upper = _bounds(program, branches)
        solution = qp.solve(lower - program.offset, upper - program.offset)
        if solution.usable and not _hopeless(solution.objective):
            heapq.heappush(heap, (solution.objective, next(order), branches, solution))

    def _hopeless(objective: float) -> bool:
        if best is None:
            return False
        slack = max(1e-7, relative_gap * (best[0] + program.constant))
        return objective >= best[0] - slack

    push(tuple(_Branch() for _ in range(layout.contacts)))
    bound = np.inf
    while heap and solved < qp_limit:
        objective, _, branches, solution = heapq.heappop(heap)
        if _hopeless(objective):
            bound = objective
            break
        violated = _most_violated(program, branches, solution.x)
        if violated is None:
            consider(solution, states_of_pairs(layout, *program.pairs(solution.x)))
            continue
        for child in branches[violated].children(layout.directions):
            push((*branches[:violated], child, *branches[violated + 1 :]))
    if best is None:
        return None
    if heap and solved >= qp_limit:
        bound = heap[0][0]
    bound = min(bound, best[0])
    return ExactResult(best[1], best[2], best[0] + program.constant, bound + program.constant, solved)


def _bounds(program: ContactProgram, branches: tuple[_Branch, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of all rows where undecided pairs are only non-negative."""
    layout = program.layout
    n, nd = layout.contacts, layout.directions
    lower, upper = layout.bounds(np.full(n, SEPARATE))
    upper[layout.activations :] = np.inf
    friction = upper[layout.tangent].reshape(n, nd)
    slip = upper[layout.paired(layout.tangent)].reshape(n, nd)
    for i, branch in enumerate(branches):
        if branch.decided is _Decided.NOTHING:
            continue
        if branch.decided is _Decided.SEPARATE:
            upper[layout.normal][i] = 0.0
            friction[i] = 0.0
            continue
        upper[layout.paired(layout.normal)][i] = 0.0
        if branch.decided is _Decided.STATIC:
            upper[layout.slip][i] = 0.0
            slip[i] = 0.0
            continue
        upper[layout.paired(layout.slip)][i] = 0.0
        allowed = np.arange(branch.first, branch.last + 1) % nd
        friction[i] = 0.0
        friction[i, allowed] = np.inf
        if branch.decided is _Decided.SLIDE:
            slip[i, allowed] = 0.0
    return lower, upper


def _most_violated(program: ContactProgram, branches: tuple[_Branch, ...], y: np.ndarray) -> int | None:
    """Undecided contact whose pairs are furthest from complementary."""
    worst = Pairs.of(program.layout, *program.pairs(y)).violation
    worst[[branch.decided in _LEAVES for branch in branches]] = 0.0
    pick = int(np.argmax(worst))
    return pick if worst[pick] > 1e-7 else None
