"""Search of the paper for the contact states of a step: the QP in the predicted states, then pivoting (Eq. 12, 13).

See docs/concepts/locomotion.md#contact-states.
"""

from __future__ import annotations

import numpy as np

from egs_warp.contact.detection import tangent_directions
from egs_warp.kernels.locomotion import mode_region as kernels
from egs_warp.locomotion.contact_modes import (
    FREE,
    SLIDE,
    STICK,
    ContactModes,
    CoulombProgram,
    FrictionDirections,
    ModeRegionOptimum,
    ModeSearchResult,
    PredictedContact,
    solve_mode_region,
)
from egs_warp.locomotion.solvers import QpSolver

_STATIC_FRACTION = 0.999
"""Fraction of the friction cone's radius up to which a predicted contact is static."""
_MIN_GAIN = 1e-9
"""Minimum decrease of the objective for which a pivot is accepted."""
_ZERO_SPEED = 1e-4
"""Tangential speed in sqrt(g H) up to which a sliding contact may stick."""


def search_states(
    program: CoulombProgram, predicted: PredictedContact, *, directions: int, qp_limit: int, solver: QpSolver | str
) -> ModeSearchResult:
    """Solve the QP in the predicted contact states, then change the state of one contact at a time while the objective
    decreases, in descending order of the constraints' multipliers (Eq. 13; pivoting after Tan, Turk and Liu 2012).

    If the QP in the predicted states has no solution, it is solved again with relaxed constraints: a constraint that
    the predicted activations violate may be violated by the same amount.

    Args:
        program: the QP of the step.
        predicted: predicted contact (Eq. 12).
        directions: number of edges n_d of the friction pyramid.
        qp_limit: maximum number of QPs.
        solver: QP solver, see ``quadratic_program``.
    """
    friction = FrictionDirections.pyramid(directions, np.pi / directions, np.pi / directions)
    start = np.concatenate([predicted.activations, predicted.forces.ravel()])
    modes = predicted_modes(predicted, program.friction, directions)
    count, infeasible = 1, 0
    best = solve_mode_region(program, start, modes, solver, friction=friction, max_violation=0.0)
    if best is None:
        count, infeasible = 2, 1
        best = solve_mode_region(program, start, modes, solver, friction=friction, max_violation=np.inf)
    if best is None:
        return ModeSearchResult(None, float("inf"), count, 2)
    visited = {_key(modes)}
    improved = True
    while improved:
        improved = False
        for trial in _pivots(program, modes, best, directions):
            if count >= qp_limit or _key(trial) in visited:
                continue
            visited.add(_key(trial))
            count += 1
            optimum = solve_mode_region(
                program, best.x, trial, solver, friction=friction, max_violation=0.0, warm_start=True
            )
            infeasible += optimum is None
            if optimum is not None and optimum.objective < best.objective - _MIN_GAIN:
                best, modes, improved = optimum, trial, True
                break
    return ModeSearchResult(best.x, best.objective, count, infeasible)


def predicted_modes(predicted: PredictedContact, friction: float, directions: int) -> ContactModes:
    """Return the predicted states as modes (Eq. 12).

    A contact without load is free. A loaded contact sticks if its force is inside the friction cone. Otherwise it
    slides, with friction along the direction D_k that opposes the predicted slip most.

    Args:
        predicted: predicted contact.
        friction: Coulomb coefficient.
        directions: number of directions n_d.
    """
    table = tangent_directions(directions)
    normal, tangential = predicted.forces[:, 0], np.linalg.norm(predicted.forces[:, 1:], axis=1)
    slide = np.argmin(predicted.velocities[:, 1:] @ table.T, axis=1)
    kind = np.where(normal <= 0.0, FREE, np.where(tangential < _STATIC_FRACTION * friction * normal, STICK, SLIDE))
    return ContactModes(kind, -table[slide])


def _pivots(
    program: CoulombProgram, modes: ContactModes, optimum: ModeRegionOptimum, directions: int
) -> list[ContactModes]:
    """Return the modes after each single change of state that an active constraint of ``optimum`` suggests, in
    descending order of the multipliers."""
    table, trials = tangent_directions(directions), []
    forces = optimum.x[program.activation_count :].reshape(-1, 3)[:, 1:]
    slips = (program.rows @ optimum.x + program.offset).reshape(-1, 3)[:, 1:]
    for index in np.argsort(-optimum.multiplier, kind="stable"):
        i, transition = optimum.contact[index], optimum.transition[index]
        kind, slip = modes.kind.copy(), modes.slip.copy()
        if transition == kernels.TO_FREE:
            kind[i] = FREE
        elif transition == kernels.TO_SLIDE:
            kind[i], slip[i] = SLIDE, -table[np.argmax(table @ forces[i])]
        elif transition == kernels.TO_TOUCHING or np.linalg.norm(slips[i]) <= _ZERO_SPEED:
            kind[i] = STICK
        else:
            # The slip is on the boundary between this direction and the next one.
            others = table[np.linalg.norm(table + slip[i], axis=1) > 1e-9]
            slip[i] = -others[np.argmin(others @ slips[i])]
        trials.append(ContactModes(kind, slip))
    return trials


def _key(modes: ContactModes) -> bytes:
    """Return a key of the modes: their kinds, and the directions of the sliding contacts."""
    return modes.kind.tobytes() + np.where(modes.kind[:, None] == SLIDE, modes.slip, 0.0).tobytes()
