"""Global optimum of the QP of a step over all contact states, by branch and bound (Eq. 9, 13)."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from enum import Enum
from itertools import count as counter

import numpy as np

from benchmarks.contact_states.complementarity import SEPARATE, Pairs, states_of_pairs
from benchmarks.contact_states.pyramid_program import PyramidProgram
from egs_warp.locomotion.solvers import QpSolution, QpSolver, quadratic_program


class _Decided(Enum):
    """Decision about a contact in a node of the tree."""

    NOTHING = "nothing"
    SEPARATE = "separate"
    STATIC = "static"
    ARC = "arc"
    """The contact slides in one of a range of directions."""
    SLIDE = "slide"
    """The contact slides in the given direction."""


_LEAVES = (_Decided.SEPARATE, _Decided.STATIC, _Decided.SLIDE)


@dataclass(frozen=True)
class _Branch:
    """Decision about one contact. For a sliding contact, ``first`` to ``last`` are its possible directions, as indices
    in the ring."""

    decided: _Decided = _Decided.NOTHING
    first: int = 0
    last: int = 0

    def children(self, directions: int) -> list[_Branch]:
        """Return smaller branches that together contain every state of this branch."""
        if self.decided is _Decided.NOTHING:
            half = directions // 2
            return [
                _Branch(_Decided.SEPARATE),
                _Branch(_Decided.STATIC),
                _Branch(_Decided.ARC, 0, half),
                _Branch(_Decided.ARC, half, directions),
            ]
        if self.decided is _Decided.ARC and self.last - self.first > 1:
            # Friction acts along one edge of the pyramid or on a face between two edges, so the halves share only the
            # middle edge.
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
    """Best point that was found, and a proved lower bound on the objective."""

    y: np.ndarray
    """(variables,) unknowns of ``PyramidProgram``."""
    states: np.ndarray
    """(n,) contact states of the best point."""
    objective: float
    bound: float
    """Lower bound on the objective of all contact states."""
    qp_count: int

    @property
    def proved(self) -> bool:
        """True if the objective equals its lower bound to within 1e-6, so that no contact states have a lower
        objective."""
        return self.objective - self.bound <= 1e-6 * (1.0 + abs(self.objective))


def exact_states(
    program: PyramidProgram,
    *,
    starts: tuple[np.ndarray, ...] = (),
    qp_limit: int = 20000,
    relative_gap: float = 0.0,
) -> ExactResult | None:
    """Find the global optimum of ``program``.

    Each node of the tree relaxes the undecided pairs to 0 <= x, 0 <= w. The optimum of this convex QP bounds the
    objective of all states in the node from below.

    Args:
        program: the QP with a friction pyramid.
        starts: states (n,) that are tried first; good states prune most of the tree.
        qp_limit: maximum number of QPs.
        relative_gap: the search ends when no node can lower the best objective by more than 1e-7 or, if that is larger,
            by more than this fraction of it.

    Returns:
        The optimum; None if no contact states are feasible, or none were found within ``qp_limit``.
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
        if solution.usable and not is_pruned(solution.objective):
            heapq.heappush(heap, (solution.objective, next(order), branches, solution))

    def is_pruned(objective: float) -> bool:
        if best is None:
            return False
        slack = max(1e-7, relative_gap * (best[0] + program.constant))
        return objective >= best[0] - slack

    push(tuple(_Branch() for _ in range(layout.contacts)))
    bound = np.inf
    while heap and solved < qp_limit:
        objective, _, branches, solution = heapq.heappop(heap)
        if is_pruned(objective):
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


def _bounds(program: PyramidProgram, branches: tuple[_Branch, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds of all rows; both sides of an undecided pair are only required to be
    non-negative."""
    layout = program.layout
    n, nd = layout.contacts, layout.directions
    lower, upper = layout.bounds(np.full(n, SEPARATE), program.lower, program.upper)
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


def _most_violated(program: PyramidProgram, branches: tuple[_Branch, ...], y: np.ndarray) -> int | None:
    """Return the undecided contact whose pairs are furthest from complementary; None if all are complementary."""
    worst = Pairs.of(program.layout, *program.pairs(y)).violation
    worst[[branch.decided in _LEAVES for branch in branches]] = 0.0
    pick = int(np.argmax(worst))
    return pick if worst[pick] > 1e-7 else None
