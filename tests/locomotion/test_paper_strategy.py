"""The paper's search: pivoting, and the QP of given contact states compared with the QP with complementarity (Eq. 12,
13)."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.contact_states.complementarity import SEPARATE, STATIC, states_of_modes
from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.detection import tangent_directions
from egs_warp.locomotion.contact_modes import (
    FREE,
    SLIDE,
    STICK,
    ContactModes,
    FrictionDirections,
    PredictedContact,
    solve_mode_region,
)
from egs_warp.locomotion.paper_strategy import predicted_modes, search_states
from egs_warp.locomotion.solvers import QpSolver
from tests.support.contact_programs import FRICTION, SmallProblem, optimum_of_each, small_problem


def modes_of(states: tuple[int, ...], directions: int) -> ContactModes:
    """Return the contact modes of ``states``, none of which is between two directions."""
    kind = [FREE if state == SEPARATE else STICK if state == STATIC else SLIDE for state in states]
    return ContactModes(np.array(kind), -tangent_directions(directions)[np.maximum(states, 0)])


def predicted_contact(problem: SmallProblem) -> PredictedContact:
    """Return the predicted contact state for zero activations."""
    program, n = problem.coulomb, problem.coulomb.contact_count
    delassus = program.rows[:, program.activation_count :]
    forces, _ = coulomb_forces(delassus, program.offset, np.zeros(n), FRICTION, np.zeros((n, 3)))
    velocities = (delassus @ forces.ravel() + program.offset).reshape(-1, 3)
    return PredictedContact(np.zeros(program.activation_count), forces, velocities)


def test_predicted_modes() -> None:
    """Eq. (12): a contact without force separates, a contact with its force inside the friction cone sticks, and any
    other contact slides along the nearest -D_k."""
    forces = np.array([[0, 0, 0], [1, 0.3, 0.2], [1, -0.8, 0], [1, 0, 0.8], [1, 0.8, 0.0]])
    slip = np.array([[0, 1.0, 0], [0, 0.1, 0.1], [0, 2.0, 0.3], [0, 0.1, -3.0], [0, -1.0, 0.9]])
    modes = predicted_modes(PredictedContact(np.zeros(0), forces, slip), FRICTION, 4)
    # D_0 = +x, D_1 = +y, D_2 = -x, D_3 = -y.
    assert states_of_modes(modes, 4).tolist() == [SEPARATE, STATIC, 2, 1, 0]


@pytest.mark.parametrize("directions", [4, 6])
def test_a_region_is_the_program_with_complementarity_in_the_same_states(directions: int) -> None:
    """Eq. (9), Eq. (13): for each assignment of states, the objective equals that of the QP over activations, pyramid
    forces and slip speeds in which the rows of these states are fixed to zero."""
    compared = 0
    friction = FrictionDirections.pyramid(directions, np.pi / directions, np.pi / directions)
    for seed in range(6):
        problem = small_problem(seed, directions=directions)
        for states, (objective, y) in optimum_of_each(problem.pyramid).items():
            if max(states) < directions:
                modes = modes_of(states, directions)
                start = problem.pyramid.forces_of(y)
                found = solve_mode_region(problem.coulomb, start, modes, QpSolver.DAQP, friction=friction)
                assert found is not None
                assert found.objective == pytest.approx(objective, rel=1e-4, abs=1e-4)
                compared += 1
    assert compared > 40


def test_pivoting_starts_in_the_predicted_states_and_improves_on_them() -> None:
    """A higher limit of QPs never increases the objective; on average, pivoting reduces it by at least 10 %."""
    first, last = [], []
    for seed in range(40):
        problem = small_problem(seed, contacts=3, directions=8, freedoms=14)
        predicted, objective = predicted_contact(problem), np.inf
        for limit in (1, 2, 4, 16):
            found = search_states(problem.coulomb, predicted, directions=8, qp_limit=limit, solver=QpSolver.DAQP)
            assert found.x is not None and found.qp_count <= max(limit, 2)
            assert found.objective <= objective + 1e-9
            objective = found.objective
            if limit == 1:
                first.append(objective)
        last.append(objective)
    assert np.mean(last) < 0.9 * np.mean(first)


def test_predicted_states_without_a_solution_are_kept_as_far_as_they_were_violated() -> None:
    """If the QP of the predicted states has no solution, there is still a result, and the QP is counted as
    infeasible."""
    infeasible = 0
    for seed in range(40):
        problem = small_problem(seed, contacts=3, directions=4, freedoms=14)
        problem.coulomb.lower[:], problem.coulomb.upper[:] = -1e-3, 1e-3
        found = search_states(
            problem.coulomb, predicted_contact(problem), directions=4, qp_limit=1, solver=QpSolver.DAQP
        )
        assert found.x is not None and np.isfinite(found.x).all()
        assert found.qp_count == 1 + found.infeasible
        infeasible += found.infeasible
    assert infeasible > 3
