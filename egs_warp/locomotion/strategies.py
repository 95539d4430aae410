"""Strategies that search the activations of a step over contact modes (Eq. 13).

``search_program`` is the entry point. See docs/concepts/locomotion.md#modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
    (``search_states``).
    """

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
    options = _SearchOptions(qp_limit, solver, device)
    return _search_with_restart(program, _first_search(program, predicted, options), predicted.forces, options)


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
    """Return ``result``; if its objective is high, restart and return the better of both results."""
    if not needs_restart(result.objective, program.contact_count):
        return result
    return _restart(program, result, forces, options)


def _search_from(
    program: CoulombProgram, start: np.ndarray, forces: np.ndarray, options: _SearchOptions
) -> ModeSearchResult:
    """Search from ``start`` (m + 3n,), in the modes of ``forces`` (n, 3) body weights. ``admm`` searches on the device;
    after a numerical failure of the kernel, the host repeats the search with OSQP.
    """
    modes = ContactModes.of(forces, program.friction)
    if options.solver is QpSolver.ADMM:
        result = search_modes_device(
            program, start, modes, qp_limit=options.qp_limit, device=wp.get_device(options.device)
        )
        if result is not None:
            return result
    return search_modes(program, start, modes, qp_limit=options.qp_limit, solver=options.solver.on_host)


def _restart(
    program: CoulombProgram, result: ModeSearchResult, forces: np.ndarray, options: _SearchOptions
) -> ModeSearchResult:
    """Restart from the relaxed optimum (``restart_from_relaxation``). The Coulomb solve for the relaxed activations
    starts from ``forces`` (n, 3) body weights.
    """

    def search(activations: np.ndarray) -> ModeSearchResult:
        start = program.contact_response(activations, forces)
        return _search_from(program, start, start[program.activation_count :].reshape(-1, 3), options)

    return restart_from_relaxation(result, solve_relaxed(program, options.solver.on_host), search)


def restart_from_relaxation(
    result: ModeSearchResult,
    relaxed: tuple[np.ndarray, float] | None,
    search: Callable[[np.ndarray], ModeSearchResult],
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
