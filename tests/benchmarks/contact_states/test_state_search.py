"""Searches over contact states compared with brute force (Eq. 13), for regular and for degenerate contact sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.contact_states.complementarity import STATIC
from benchmarks.contact_states.pyramid_program import PyramidProgram
from benchmarks.contact_states.state_search import (
    RESTART_BUDGET,
    SearchResult,
    StateSearch,
    contact_response,
    find_states,
    search_pyramid,
)
from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.locomotion.contact_modes import PredictedContact
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy, search_program
from tests.support.contact_programs import FRICTION, optimum_of_each, small_problem


def search(
    program: PyramidProgram,
    kind: StateSearch,
    *,
    limit: int = 100,
    solver: QpSolver = QpSolver.DAQP,
    predicted: np.ndarray | None = None,
) -> SearchResult:
    layout = program.layout
    states = np.full(layout.contacts, STATIC) if predicted is None else predicted
    return find_states(program, kind, states, np.zeros(layout.activations), qp_limit=limit, solver=solver)


def is_complementary(program: PyramidProgram, y: np.ndarray, tolerance: float) -> bool:
    x, w = program.pairs(y)
    return x.min() > -tolerance and w.min() > -tolerance and bool(np.minimum(x, w).max() < tolerance)


@pytest.mark.parametrize("solver", [QpSolver.OSQP, QpSolver.DAQP])
def test_relaxed_against_brute_force(solver: QpSolver) -> None:
    """Eq. (13): the objective is within 2 % of brute force in at least 47 of 60 problems, and never below it. The
    search takes at most 5 QPs on average.

    These problems are harder than the problems of a body: in most of them, the relaxed optimum is far from the true
    one.
    """
    near, counts = 0, []
    for seed in range(60):
        program = small_problem(seed, directions=4 if seed % 2 else 6).pyramid
        best = min(value for value, _ in optimum_of_each(program).values())
        found = search(program, StateSearch.RELAXED, solver=solver)
        assert found.y is not None and not found.relaxed
        assert is_complementary(program, found.y, 1e-5 if solver is QpSolver.DAQP else 2e-2)
        assert found.objective == pytest.approx(program.objective(found.y))
        assert found.objective > best - (1e-5 if solver is QpSolver.DAQP else 1e-2) * (1.0 + abs(best))
        near += found.objective <= 1.02 * best + 1e-6
        counts.append(found.qp_count)
    assert near >= 47 and np.mean(counts) <= 5.0


def test_order_of_the_searches() -> None:
    """The mean objectives over many problems satisfy exact <= relaxed <= qpcc <= static, and ``relaxed`` takes far
    fewer QPs than ``exact``."""
    means, counts = {}, {}
    problems = [small_problem(seed, contacts=3).pyramid for seed in range(30)]
    for kind in StateSearch:
        found = [search(program, kind) for program in problems]
        means[kind] = np.mean([result.objective for result in found])
        counts[kind] = np.mean([result.qp_count for result in found])
    assert (
        means[StateSearch.EXACT] - 1e-6
        <= means[StateSearch.RELAXED]
        < means[StateSearch.QPCC]
        < means[StateSearch.STATIC]
    )
    assert 5.0 * counts[StateSearch.RELAXED] < counts[StateSearch.EXACT]


def test_more_qps_are_never_worse() -> None:
    """One more QP never increases the objective. The limit is tripled if the best objective is far above its lower
    bound; at the limit, the best result so far is returned.
    """
    for seed in range(8):
        program = small_problem(seed, contacts=3).pyramid
        last = np.inf
        for limit in (2, 3, 4, 8):
            found = search(program, StateSearch.RELAXED, limit=limit)
            assert found.qp_count <= RESTART_BUDGET * limit and found.objective <= last + 1e-9
            last = found.objective


def test_an_uncertain_search_may_triple_the_limit() -> None:
    """With a limit of 2 QPs, which a restart triples, no search takes more than 6 QPs, and some take all 6."""
    programs = [small_problem(seed, contacts=3).pyramid for seed in range(20)]
    counts = [search(program, StateSearch.RELAXED, limit=2).qp_count for program in programs]
    assert max(counts) == 6 and min(counts) <= 3


def test_contact_under_given_activations_obeys_every_pair() -> None:
    """Eq. (9): for any activations, the contact forces satisfy all complementarity conditions to rounding."""
    for seed in range(10):
        program = small_problem(seed, contacts=4).pyramid
        activations = np.random.default_rng(seed).uniform(-1, 1, 3)
        y = contact_response(program, activations)
        assert y is not None and np.array_equal(y[:3], activations)
        assert is_complementary(program, y, 1e-9)


def degenerate_frames() -> dict[str, np.ndarray]:
    """Return contact Jacobians (3n, 6) of points under a rigid body, by name."""
    rng = np.random.default_rng(0)
    points = {
        "line": np.column_stack([np.linspace(-0.5, 0.5, 8), np.zeros(8)]),
        "duplicates": np.tile(rng.uniform(-0.5, 0.5, (3, 2)), (3, 1)),
        "one": np.array([[0.1, 0.0]]),
        "forty": rng.uniform(-0.5, 0.5, (40, 2)),
        "same": np.zeros((6, 2)),
    }
    frames = {}
    for name, places in points.items():
        arms = np.column_stack([places, np.full(len(places), -0.5)])
        # The rows, normal first, give the velocity of each point along z, x, y from the body's velocities (v_z, v_x,
        # v_y, w_x, w_y, w_z).
        linear = np.tile(np.eye(3), (len(arms), 1))
        turn = np.concatenate([np.cross(np.eye(3), arm).T[[2, 0, 1]] for arm in arms])
        frames[name] = np.hstack([linear, turn])
    return frames


@pytest.mark.parametrize("name", list(degenerate_frames()))
@pytest.mark.parametrize("solver", [QpSolver.OSQP, QpSolver.DAQP])
def test_degenerate_contact_sets_have_a_solution(name: str, solver: QpSolver) -> None:
    """For contacts in one line, duplicate contacts, a single point and 40 points on a rigid base, the result is finite
    and satisfies all complementarity conditions.
    """
    frame = degenerate_frames()[name]
    for seed in range(4):
        program = small_problem(seed, contacts=len(frame) // 3, activations=4, frame=frame).pyramid
        found = search(program, StateSearch.RELAXED, limit=4, solver=solver)
        assert found.y is not None and np.isfinite(found.y).all()
        assert found.objective == pytest.approx(program.objective(found.y)) and not found.relaxed
        assert is_complementary(program, found.y, 1e-5 if solver is QpSolver.DAQP else 2e-2)


def test_states_that_contradict_each_other_are_replaced() -> None:
    """Contacts at the same point of a rigid body with different gaps cannot all stick, so the search starts from the
    solution of the contact problem instead.
    """
    frame = degenerate_frames()["same"]
    problem = small_problem(1, contacts=6, frame=frame)
    program = replace(problem.pyramid, offset=problem.pyramid.offset.copy())
    program.offset[program.layout.paired(program.layout.normal)] += np.linspace(0.0, 0.5, 6)
    static = search(program, StateSearch.STATIC)
    assert static.infeasible == 1 and static.y is not None and not static.relaxed
    assert is_complementary(program, static.y, 1e-5)
    found = search(program, StateSearch.RELAXED)
    assert not found.relaxed and found.objective <= static.objective + 1e-9


def test_every_search_solves_the_same_program() -> None:
    """Eq. (9), Eq. (13): each search gives activations within their bounds, forces within the cone and the correct
    objective. With few QPs, the mean objective of the engine's strategies is lower than that of ``qpcc``.
    """
    reached: dict[Strategy | StateSearch, list[float]] = {kind: [] for kind in (*Strategy, *StateSearch)}
    for seed in range(24):
        program = small_problem(seed, contacts=3, directions=8, freedoms=14).coulomb
        delassus = program.rows[:, 3:]
        forces, _ = coulomb_forces(delassus, program.offset, np.zeros(3), FRICTION, np.zeros((3, 3)))
        velocities = (delassus @ forces.ravel() + program.offset).reshape(-1, 3)
        predicted = PredictedContact(np.zeros(3), forces, velocities)
        for kind in reached:
            if isinstance(kind, Strategy):
                found = search_program(program, kind, predicted, directions=8, qp_limit=8, solver=QpSolver.DAQP)
            else:
                found = search_pyramid(program, kind, predicted, directions=8, qp_limit=8, solver=QpSolver.DAQP)
            assert found.x is not None and found.qp_count > 0
            forces = found.x[3:].reshape(-1, 3)
            slack = FRICTION * forces[:, 0] - np.linalg.norm(forces[:, 1:], axis=1)
            # A mode region replaces the cone by a pyramid around the start, whose facets forces may violate by 0.02.
            broken = 0.03 if isinstance(kind, Strategy) else 1e-5
            assert np.abs(found.x[:3]).max() <= 1.0 + 1e-6 and slack.min() > -broken, kind
            assert found.objective == pytest.approx(program.objective(found.x), rel=1e-4, abs=1e-4)
            reached[kind].append(found.objective)
    means = {kind: float(np.mean(values)) for kind, values in reached.items()}
    assert max(means[Strategy.MODES], means[Strategy.PAPER]) < means[StateSearch.QPCC] < means[StateSearch.STATIC]
    assert means[StateSearch.QPCC_OUR_MOVES] < 0.9 * means[StateSearch.QPCC]


def test_static_starts_with_all_contacts_static() -> None:
    """The search ``STATIC`` ignores the predicted states and solves one QP in which all contacts stick."""
    tried = 0
    for seed in range(40):
        program = small_problem(seed).pyramid
        values = optimum_of_each(program)
        if (STATIC, STATIC) in values:
            tried += 1
            static = search(program, StateSearch.STATIC, predicted=np.array([0, 1]))
            assert static.states.tolist() == [STATIC, STATIC] and static.qp_count == 1
            assert static.objective == pytest.approx(values[STATIC, STATIC][0], rel=1e-6, abs=1e-6)
    assert tried >= 3
