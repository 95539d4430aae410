"""Planned steps of many worlds, each of which equals those of a single stepper, independently of the other worlds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from egs_warp.contact import batch_step, coupled_step
from egs_warp.errors import ArgumentError, UserError
from egs_warp.fem.body import BodyState
from egs_warp.kernels.locomotion.active_set import NUMERICAL_FAILURE
from egs_warp.locomotion import batch, batch_search, strategies
from egs_warp.locomotion import stepper as stepping
from egs_warp.locomotion.batch import BatchStepper
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    LoadObjective,
    centre_of_mass_velocity,
    node_velocities,
)
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn, on_its_rim

FRICTIONS = (0.8, 0.4, 0.6)
"""Friction coefficients of the worlds. With a coefficient of 1.2, the plan of a body that is pushed down would amplify
rounding: a change of the start by 1e-15 m would change the activations of a single stepper by up to 0.09 of their
bounds."""
Goals = Callable[[BodyState, StepReport | None, float], Sequence[AnyObjective]]
"""Function of the state, the last report and the step size that returns the objectives of a step, like
``Motion.objectives``."""


@pytest.fixture(scope="module")
def creature() -> Creature:
    """Return the coarse pawn with contact points only at its rim. With all of its 32 points, the Delassus operator of
    so coarse a base is nearly singular, and rounding decides between contact modes."""
    pawn = coarse_pawn()
    settings, geometry = LocomotionSettings(qp_solver="admm"), on_its_rim(pawn.geometry)
    return replace(pawn, stepper=LocomotionStepper(pawn.body, pawn.muscles, geometry, settings=settings, device="cpu"))


def rising(creature: Creature, speed: float, *, count: int = 4) -> Goals:
    """Return the first ``count`` of four objectives: the centre of mass rises at ``speed``, in units of sqrt(g H), the
    body does not rotate, all nodes rise at ``speed``, and some nodes are unloaded."""
    body = creature.body
    up = -speed * body.speed_unit * body.gravity / np.linalg.norm(body.gravity)
    lifted = np.argsort(creature.start.positions @ body.gravity)[-9::3]
    goals = [
        centre_of_mass_velocity(body, up, 2.0),
        AngularMomentumObjective(np.zeros(3), 1.0),
        node_velocities(body, np.tile(up, (len(body.node_mass), 1)), 1.0),
        LoadObjective(lifted, 0.1),
    ]
    return lambda state, report, dt: goals[:count]


def batch_stepper(creature: Creature, frictions: Sequence[float]) -> BatchStepper:
    stepper = creature.stepper
    return BatchStepper(
        *(creature.body, creature.muscles, stepper.geometry, frictions),
        settings=stepper.settings,
        planner=stepper.planner,
    )


def check_runs(
    creature: Creature,
    goals: Callable[[], list[Goals]],
    *,
    steps: int,
    dt: float | None = None,
    starts: Sequence[BodyState] | None = None,
) -> list[list[list[StepReport]]]:
    """Assert that the steps of all worlds of a batch equal those of single runs to 1e-9 in the units of the body.

    Return their reports by world and step. ``goals`` is called for the batch and for the single runs, because motions
    have a state."""
    dt = solver_steps(creature.body)[0] if dt is None else dt
    starts = starts or [creature.start] * len(goals())
    expected: list[list[list[StepReport]]] = []
    for each, friction, state in zip(goals(), FRICTIONS, starts, strict=False):
        stepper, run = creature.stepper.with_friction(friction), []
        memory, report = stepper.initial_memory(), None
        for _ in range(steps):
            state, memory, done = stepper.advance(state, memory, each(state, report, dt), dt)
            report = done[-1]
            run.append(done)
        expected.append(run)
    together = batch_stepper(creature, FRICTIONS[: len(starts)])
    state, states = together.start(starts), list(starts)
    reports: list[StepReport | None] = [None] * len(starts)
    all_goals, made = goals(), [[] for _ in starts]
    for number in range(steps):
        asked = [each(start, last, dt) for each, start, last in zip(all_goals, states, reports, strict=True)]
        state, steps_done, failed = together.advance(state, asked, dt)
        assert not failed.any()
        for run in made:
            run.append([])
        for step in steps_done:
            for world, report in zip(step.worlds.tolist(), step.reports(), strict=True):
                made[world][-1].append(report)
                reports[world], states[world] = report, report.state
        for run, its in zip(made, expected, strict=True):
            assert len(run[number]) == len(its[number])
            for one, other in zip(run[number], its[number], strict=True):
                check(creature, one, other)
    return made


def check(creature: Creature, one: StepReport, other: StepReport) -> None:
    body = creature.body
    for name in ("dt", "converged", "newton_iterations", "qp_count", "qp_infeasible"):
        assert getattr(one, name) == getattr(other, name), name
    assert np.array_equal(one.contacts.points, other.contacts.points)
    for mine, its, unit in (
        (one.state.positions, other.state.positions, body.height),
        (one.state.velocities, other.state.velocities, body.speed_unit),
        (one.activations / creature.muscles.bounds, other.activations / creature.muscles.bounds, 1.0),
        (one.forces, other.forces, body.weight),
    ):
        np.testing.assert_allclose(mine, its, rtol=0, atol=1e-9 * unit)


@pytest.mark.parametrize("speeds", [(0.3,), (0.3, 0.0, -0.1)])
def test_each_world_plans_as_a_single_stepper(creature: Creature, speeds: tuple[float, ...]) -> None:
    """The worlds have different targets and different numbers of objectives."""
    made = check_runs(
        creature,
        lambda: [rising(creature, speed, count=4 if world == 0 else 3) for world, speed in enumerate(speeds)],
        steps=3,
    )
    strengths = [np.abs(run[-1][-1].activations / creature.muscles.bounds).max() for run in made]
    assert strengths[0] > 0.1


def test_every_step_is_searched_and_planned_again(creature: Creature, monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings make all searches restart from the relaxed optimum and all steps be replanned about their ends."""
    for module in (batch, stepping):
        monkeypatch.setattr(module, "REPLAN_FACTOR", 0.0)
        monkeypatch.setattr(module, "REPLAN_MARGIN", -1.0)
    for module in (batch_search, strategies):
        monkeypatch.setattr(module, "RESTART_COST", 0.0)
        monkeypatch.setattr(module, "RESTART_GAP", 0.0)
    made = check_runs(creature, lambda: [rising(creature, 0.4), rising(creature, 0.2)], steps=2)
    # There are two plans, each with two searches and a relaxed QP.
    assert min(done[0].qp_count for run in made for done in run) >= 6


def test_failed_searches_are_repeated_on_the_host(creature: Creature, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the kernel fails numerically, the host computes the plan."""
    goals = [rising(creature, 0.3), rising(creature, 0.1)]
    asked, dt = [each(creature.start, None, 0.0) for each in goals], solver_steps(creature.body)[0]
    run, ends = batch_search.SearchPool.run, []

    def failing(
        pool: batch_search.SearchPool, packed: wp.array, result: wp.array, *others: wp.array, **cost: float
    ) -> None:
        run(pool, packed, result, *others, **cost)
        result.numpy()[:, 0] = NUMERICAL_FAILURE

    for fails in (False, True):
        stepper = batch_stepper(creature, FRICTIONS[:2])
        if fails:
            monkeypatch.setattr(batch_search.SearchPool, "run", failing)
        state, _, failed = stepper.advance(stepper.start([creature.start] * 2), asked, dt)
        assert not failed.any()
        ends.append(state.positions.numpy())
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-6 * creature.body.height)
    assert (ends[1] != ends[0]).any()


def test_a_world_that_cannot_be_planned_is_reported_and_removed(creature: Creature) -> None:
    dt, _ = solver_steps(creature.body)
    broken = replace(creature.start, velocities=np.full_like(creature.start.velocities, np.nan))
    stepper = batch_stepper(creature, FRICTIONS)
    asked = [rising(creature, 0.2)(creature.start, None, dt)] * 3
    state, done, failed = stepper.advance(stepper.start([creature.start, broken, creature.start]), asked, dt)
    assert failed.tolist() == [False, True, False] and state.worlds.tolist() == [0, 2]
    assert [step.worlds.tolist() for step in done] == [[0, 2]]
    state, _, failed = stepper.advance(state, asked[:2], dt)
    assert not failed.any() and torch.isfinite(state.positions).all()


def test_planning_needs_a_planner_with_the_strategy_modes(creature: Creature) -> None:
    given = creature.body, creature.muscles, creature.geometry, FRICTIONS[:1]
    stepper = BatchStepper(*given)
    with pytest.raises(ArgumentError, match="planner: give BatchStepper the planner of a LocomotionStepper"):
        stepper.advance(stepper.start([creature.start]), [[]], 0.01)
    paper = replace(creature.stepper.planner, settings=LocomotionSettings(strategy="paper"))
    with pytest.raises(UserError, match="strategy 'paper' does not run in batches; set worlds=0, or use the strategy"):
        BatchStepper(*given, planner=paper)


@pytest.mark.slow
def test_unconverged_steps_are_halved_as_in_single_runs(creature: Creature, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two bodies hit the ground in a step that needs more Newton steps than are allowed; one body stands."""
    for module in (batch_step, coupled_step):
        monkeypatch.setattr(module, "MAX_NEWTON_STEPS", 15)
    body, down = creature.body, creature.body.gravity / np.linalg.norm(creature.body.gravity)
    starts = [
        BodyState(creature.start.positions - 0.05 * body.height * down, creature.start.velocities + speed * down)
        for speed in (3.0 * body.speed_unit, body.speed_unit)
    ]
    dt = 4.0 * solver_steps(body)[0]
    goals = [rising(creature, speed) for speed in (2.0, 0.0, 1.0)]
    made = check_runs(creature, lambda: goals, steps=1, dt=dt, starts=[starts[0], creature.start, starts[1]])
    assert len(made[0][0]) > 1 and len(made[1][0]) == 1
