"""Strategies against brute force (Eq. 12, 13), on healthy and on degenerate contact sets."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.errors import UserError
from egs_warp.locomotion.complementarity import STATIC
from egs_warp.locomotion.contact_modes import ContactModes, search_modes
from egs_warp.locomotion.program import ContactProgram
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import (
    RESTART_BUDGET,
    RESTART_COST,
    PredictedContact,
    SearchResult,
    Strategy,
    contact_response,
    find_states,
    search_program,
)
from tests.support.contact_programs import FRICTION, optimum_of_each, small_problem

PAIRED = [strategy for strategy in Strategy if strategy is not Strategy.MODES]
"""Strategies over states of complementary pairs."""


def search(
    program: ContactProgram,
    strategy: Strategy | str,
    *,
    limit: int = 100,
    solver: QpSolver = QpSolver.DAQP,
    predicted: np.ndarray | None = None,
) -> SearchResult:
    layout = program.layout
    states = np.full(layout.contacts, STATIC) if predicted is None else predicted
    return find_states(program, strategy, states, np.zeros(layout.activations), qp_limit=limit, solver=solver)


def is_complementary(program: ContactProgram, y: np.ndarray, tolerance: float) -> bool:
    x, w = program.pairs(y)
    return x.min() > -tolerance and w.min() > -tolerance and bool(np.minimum(x, w).max() < tolerance)


@pytest.mark.parametrize("solver", list(QpSolver))
def test_relaxed_against_brute_force(solver: QpSolver) -> None:
    """Eq. (13): within 2 % of brute force in 78 % of 60 problems, never below it, in at most 5 QPs on average.

    These problems are harder than those of a body: in most of them the relaxed optimum is no hint at the true one.
    """
    near, counts = 0, []
    for seed in range(60):
        program = small_problem(seed, directions=4 if seed % 2 else 6).program
        best = min(value for value, _ in optimum_of_each(program).values())
        found = search(program, Strategy.RELAXED, solver=solver)
        assert found.y is not None and not found.relaxed
        assert is_complementary(program, found.y, 1e-5 if solver is QpSolver.DAQP else 2e-2)
        assert found.objective == pytest.approx(program.objective(found.y))
        assert found.objective > best - (1e-5 if solver is QpSolver.DAQP else 1e-2) * (1.0 + abs(best))
        near += found.objective <= 1.02 * best + 1e-6
        counts.append(found.qp_count)
    assert near >= 47 and np.mean(counts) <= 5.0


def test_order_of_the_strategies() -> None:
    """On average over many problems, exact <= relaxed <= qpcc <= static, and relaxed takes far fewer QPs than exact."""
    means, counts = {}, {}
    problems = [small_problem(seed, contacts=3).program for seed in range(30)]
    for strategy in PAIRED:
        found = [search(program, strategy) for program in problems]
        means[strategy] = np.mean([result.objective for result in found])
        counts[strategy] = np.mean([result.qp_count for result in found])
    assert means[Strategy.EXACT] - 1e-6 <= means[Strategy.RELAXED] < means[Strategy.QPCC] < means[Strategy.STATIC]
    assert 5.0 * counts[Strategy.RELAXED] < counts[Strategy.EXACT]


def test_more_qps_are_never_worse() -> None:
    """One more QP never increases the objective. The limit is tripled if the best result is uncertain; at the limit the
    best result so far is returned.
    """
    for seed in range(8):
        program = small_problem(seed, contacts=3).program
        last = np.inf
        for limit in (2, 3, 4, 8):
            found = search(program, Strategy.RELAXED, limit=limit)
            assert found.qp_count <= RESTART_BUDGET * limit and found.objective <= last + 1e-9
            last = found.objective


def test_an_uncertain_search_may_triple_the_limit() -> None:
    """As documented: some of many problems take all of it, none takes more."""
    counts = [search(small_problem(seed, contacts=3).program, Strategy.RELAXED, limit=2).qp_count for seed in range(20)]
    assert max(counts) == 6 and min(counts) <= 3


def test_contact_under_given_activations_obeys_every_pair() -> None:
    """Eq. (9): for any activations there are contact forces, found to rounding."""
    for seed in range(10):
        program = small_problem(seed, contacts=4).program
        activations = np.random.default_rng(seed).uniform(-1, 1, 3)
        y = contact_response(program, activations)
        assert y is not None and np.array_equal(y[:3], activations)
        assert is_complementary(program, y, 1e-9)


def degenerate_frames() -> dict[str, np.ndarray]:
    """Contact Jacobians (3n, 6) of points under a rigid body."""
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
        # Rows with the normal first: velocity of each point along z, x, y for the body's (v_z, v_x, v_y, w_x, w_y,
        # w_z).
        linear = np.tile(np.eye(3), (len(arms), 1))
        turn = np.concatenate([np.cross(np.eye(3), arm).T[[2, 0, 1]] for arm in arms])
        frames[name] = np.hstack([linear, turn])
    return frames


@pytest.mark.parametrize("name", list(degenerate_frames()))
@pytest.mark.parametrize("solver", [QpSolver.OSQP, QpSolver.DAQP, pytest.param(QpSolver.ADMM, marks=pytest.mark.slow)])
def test_degenerate_contact_sets_have_a_solution(name: str, solver: QpSolver) -> None:
    """Contacts in one line, duplicates, one point, 40 points on a rigid base: the result is finite and obeys every
    pair.
    """
    frame = degenerate_frames()[name]
    for seed in range(4):
        program = small_problem(seed, contacts=len(frame) // 3, activations=4, frame=frame).program
        found = search(program, Strategy.RELAXED, limit=4, solver=solver)
        assert found.y is not None and np.isfinite(found.y).all()
        assert found.objective == pytest.approx(program.objective(found.y)) and not found.relaxed
        assert is_complementary(program, found.y, 1e-5 if solver is QpSolver.DAQP else 2e-2)


def test_states_that_contradict_each_other_are_replaced() -> None:
    """Points at one rigid place with different gaps cannot all be static: the search starts from the solution of the
    contact problem instead.
    """
    frame = degenerate_frames()["same"]
    problem = small_problem(1, contacts=6, frame=frame)
    program = replace(problem.program, offset=problem.program.offset.copy())
    program.offset[program.layout.paired(program.layout.normal)] += np.linspace(0.0, 0.5, 6)
    static = search(program, Strategy.STATIC)
    assert static.infeasible == 1 and static.y is not None and not static.relaxed
    assert is_complementary(program, static.y, 1e-5)
    found = search(program, Strategy.RELAXED)
    assert not found.relaxed and found.objective <= static.objective + 1e-9


def test_every_strategy_solves_the_same_program() -> None:
    """Eq. (9), Eq. (13): each strategy gives activations within their bounds, forces within the cone, the correct
    objective, and on average no more than the start; in a few QPs ``modes`` comes nearer to the optimum than the
    strategies that change one contact at a time from the predicted states.
    """
    reached: dict[Strategy, list[float]] = {strategy: [] for strategy in Strategy}
    for seed in range(24):
        problem = small_problem(seed, contacts=3, directions=8, freedoms=14)
        pieces = problem.pieces
        delassus = pieces.rows[:, 3:]
        forces, _ = coulomb_forces(delassus, pieces.offset, np.zeros(3), FRICTION, np.zeros((3, 3)))
        velocities = (delassus @ forces.ravel() + pieces.offset).reshape(-1, 3)
        foreseen = PredictedContact(np.zeros(3), forces, velocities)
        for strategy in Strategy:
            found = search_program(pieces, strategy, foreseen, directions=8, qp_limit=8, solver=QpSolver.DAQP)
            assert found.x is not None and found.qp_count > 0
            forces = found.x[3:].reshape(-1, 3)
            slack = FRICTION * forces[:, 0] - np.linalg.norm(forces[:, 1:], axis=1)
            # The mode regions replace the cone by a pyramid around the start, which may violate a facet by 0.02, and
            # the objective likewise.
            broken = 0.03 if strategy is Strategy.MODES else 1e-5
            assert np.abs(found.x[:3]).max() <= 1.0 + 1e-6 and slack.min() > -broken
            assert found.objective == pytest.approx(pieces.objective(found.x), rel=1e-4, abs=1e-4)
            reached[strategy].append(found.objective)
    means = {strategy: float(np.mean(values)) for strategy, values in reached.items()}
    assert means[Strategy.MODES] < means[Strategy.PAPER] < means[Strategy.STATIC]
    assert means[Strategy.QPCC_OUR_MOVES] < 0.9 * means[Strategy.QPCC]


def test_strategies_and_solvers_are_chosen_by_name() -> None:
    program = small_problem(3).program
    found = [search(program, strategy) for strategy in ("exact", Strategy.EXACT)]
    assert found[0].objective == found[1].objective and found[0].qp_count == found[1].qp_count > 2
    settings = LocomotionSettings(strategy="static", qp_solver="daqp")
    assert Strategy(settings.strategy) is Strategy.STATIC and QpSolver(settings.qp_solver) is QpSolver.DAQP
    assert settings.qp_solver_on(wp.get_device("cpu")) is QpSolver.DAQP
    gpu: Any = SimpleNamespace(is_cuda=True)
    assert LocomotionSettings().qp_solver_on(gpu) is QpSolver.ADMM
    assert LocomotionSettings(qp_solver="osqp").qp_solver_on(gpu) is QpSolver.OSQP
    assert LocomotionSettings().qp_solver_on(wp.get_device("cpu")) is QpSolver.OSQP
    with pytest.raises(UserError, match="strategy 'nonsense' is not known; give one of modes, paper, static, qpcc"):
        LocomotionSettings(strategy="nonsense")
    with pytest.raises(UserError, match="QP solver 'nonsense' is not known; give one of osqp, admm, daqp"):
        LocomotionSettings(qp_solver="nonsense")


def test_start_states_of_the_strategies() -> None:
    """``paper`` starts from the predicted states and only improves on them; ``static`` starts with all contacts static,
    for any prediction."""
    tried = 0
    for seed in range(40):
        program, foreseen = small_problem(seed).program, (0, 1)
        values = optimum_of_each(program)
        if foreseen in values and (STATIC, STATIC) in values:
            tried += 1
            static = search(program, Strategy.STATIC, predicted=np.array(foreseen))
            assert static.states.tolist() == [STATIC, STATIC] and static.qp_count == 1
            assert static.objective == pytest.approx(values[STATIC, STATIC][0], rel=1e-6, abs=1e-6)
            paper = search(program, Strategy.PAPER, predicted=np.array(foreseen))
            assert paper.objective <= values[foreseen][0] + 1e-6
    assert tried >= 3


@pytest.mark.parametrize("bound", [None, 1.0, 0.5])
def test_a_second_search_only_if_uncertain(bound: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the result is within 1.2 times the lower bound, or the bound is not known, there is one more QP; otherwise
    there is a second search."""
    pieces = small_problem(3, contacts=3, directions=8, freedoms=14).pieces
    forces = np.zeros((3, 3))
    foreseen = PredictedContact(np.zeros(3), forces, forces)
    start = np.zeros(12)
    once = search_modes(pieces, start, ContactModes.of(forces, FRICTION), qp_limit=8, solver=QpSolver.DAQP)
    assert once.objective > RESTART_COST
    relaxed = None if bound is None else (np.zeros(3), bound * once.objective)
    monkeypatch.setattr("egs_warp.locomotion.strategies.solve_relaxed", lambda *given, **options: relaxed)
    found = search_program(pieces, Strategy.MODES, foreseen, directions=8, qp_limit=8, solver=QpSolver.DAQP)
    assert found.objective <= once.objective
    assert (found.qp_count > once.qp_count + 1) == (bound == 0.5)
