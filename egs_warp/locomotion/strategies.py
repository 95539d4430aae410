"""Strategies that search the activations of a step over contact modes (Eq. 13).

``search_program`` is the entry point. See docs/concepts/locomotion.md#modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import Enum

import numpy as np
import warp as wp

from egs_warp.errors import UserError, did_you_mean
from egs_warp.launching import Device
from egs_warp.locomotion.contact_modes import (
    ContactModes,
    CoulombProgram,
    ModeSearchResult,
    PredictedContact,
    search_modes,
    solve_relaxed,
)
from egs_warp.locomotion.device_search import search_modes_device
from egs_warp.locomotion.paper_strategy import search_states
from egs_warp.locomotion.solvers import QpSolver

RESTART_GAP = 1.2
"""Factor of the relaxed objective above which a mode search restarts from the relaxed optimum."""
RESTART_COST = 0.3
"""Minimum objective for which a mode search restarts."""


class Strategy(Enum):
    """Strategy that searches for the contact modes of a step."""

    MODES = "modes"
    """Search from the predicted modes, changing all contacts at once, with the exact friction cone (``search_modes``).
    """
    PAPER = "paper"
    """Search of the paper: from the predicted states, one contact at a time, with a friction pyramid
    (``search_states``)."""

    @classmethod
    def _missing_(cls, value: object) -> Strategy:
        names = [one.value for one in cls]
        raise UserError(f"strategy {value!r} is not known{did_you_mean(value, names)}; give one of {', '.join(names)}")


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
    """Find activations and contact forces of a step.

    Args:
        program: the QP of the step.
        strategy: the strategy, or its name.
        predicted: predicted contact, from which the search starts.
        directions: number of edges of the friction pyramid of the strategy ``paper``.
        qp_limit: maximum number of QPs of a search.
        solver: QP solver, or its name; the strategy ``paper`` uses ``osqp`` in place of ``admm``.
        device: device of the solver ``admm``.
    """
    solver = QpSolver(solver)
    if Strategy(strategy) is Strategy.PAPER:
        return search_states(program, predicted, directions=directions, qp_limit=qp_limit, solver=solver.on_host)

    def search_from(start: np.ndarray, forces: np.ndarray) -> ModeSearchResult:
        """Search from ``start`` (m + 3n,), in the modes of ``forces`` (n, 3) body weights."""
        modes = ContactModes.of(forces, program.friction)
        if solver is QpSolver.ADMM:
            result = search_modes_device(program, start, modes, qp_limit=qp_limit, device=wp.get_device(device))
            if result is not None:
                return result
            # After a numerical failure of the kernel, the host repeats the search.
        return search_modes(program, start, modes, qp_limit=qp_limit, solver=solver.on_host)

    def search_again(activations: np.ndarray) -> ModeSearchResult:
        start = program.contact_response(activations, predicted.forces)
        return search_from(start, start[program.activation_count :].reshape(-1, 3))

    result = search_from(np.concatenate([predicted.activations, predicted.forces.ravel()]), predicted.forces)
    if not needs_restart(result.objective, program.contact_count):
        return result
    return restart_from_relaxation(result, solve_relaxed(program, solver.on_host), search_again)


def needs_restart(objective: float, contacts: int) -> bool:
    """Return True if a mode search with this ``objective`` should restart from the relaxed optimum."""
    return contacts > 0 and not objective < RESTART_COST


def restart_from_relaxation(
    result: ModeSearchResult, relaxed: tuple[np.ndarray, float] | None, search: Callable[[np.ndarray], ModeSearchResult]
) -> ModeSearchResult:
    """Search again from the relaxed optimum if the objective of ``result`` exceeds ``RESTART_GAP`` times the relaxed
    objective.

    Args:
        result: result of the first search.
        relaxed: activations (m,) and objective of the relaxed optimum, see ``solve_relaxed``.
        search: function that searches from activations (m,) and the contact forces that they cause.

    Returns:
        The better of the two results, with the QP counts of both searches.
    """
    result = replace(result, qp_count=result.qp_count + 1)
    if relaxed is None or result.objective <= RESTART_GAP * relaxed[1]:
        return result
    other = search(relaxed[0])
    best = min(result, other, key=lambda one: one.objective)
    return replace(best, qp_count=result.qp_count + other.qp_count, infeasible=result.infeasible + other.infeasible)
