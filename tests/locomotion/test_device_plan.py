"""Plans of the device planner, which on every device equal those of prediction and planning on the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("torch")

from egs_warp.contact.device_newton import DeviceNewtonIterate
from egs_warp.contact.device_newton_workspace import NewtonWorkspace
from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion import device_plan, device_restart, strategies
from egs_warp.locomotion import stepper as stepping
from egs_warp.locomotion.contact_modes import search_modes, solve_relaxed
from egs_warp.locomotion.device_plan import DevicePlanner, PlanWorkspace
from egs_warp.locomotion.device_restart import DeviceRestart
from egs_warp.locomotion.device_search import ModeSearchWorkspace, RelaxationWorkspace
from egs_warp.locomotion.linear_step import PredictedStep, StepInputs
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    LoadObjective,
    centre_of_mass_velocity,
    node_velocities,
)
from egs_warp.locomotion.planner import Plan, StageClock
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper, WarmStart
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn
from tests.support.device_steps import on_device

DT = 0.01


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


@pytest.fixture
def stepper(creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch) -> LocomotionStepper:
    return on_device(creature, device, monkeypatch, LocomotionSettings(qp_solver="admm"))


def asks(creature: Creature, speed: float) -> list[AnyObjective]:
    """Return the objectives of rising at ``speed`` m/s in the current pose without rotation, with a reduced load on
    some nodes."""
    body = creature.body
    lifted = np.argsort(creature.start.positions @ body.gravity)[-9::3]
    up = -body.gravity / np.linalg.norm(body.gravity)
    return [
        centre_of_mass_velocity(body, speed * up, 2.0),
        node_velocities(body, np.tile(speed * up, (len(body.node_mass), 1)), 1.0),
        AngularMomentumObjective(np.zeros(3), 1.0),
        LoadObjective(lifted, 0.1),
    ]


def begun(stepper: LocomotionStepper, state: BodyState, memory: WarmStart) -> StepInputs:
    problem = StepProblem(stepper.body, state, DT, stepper.settings.drag)
    return stepper.step_inputs(problem, stepper._detect(problem, memory), memory)


def on_its_edge(stepper: LocomotionStepper) -> BodyState:
    """Return a tilted body that touches the ground with few points, so that the contact forces are not sensitive to
    rounding."""
    turned = Rotation.from_rotvec([0.1, 0.03, 0.0]).apply(stepper.body.mesh.nodes)
    up = -stepper.body.gravity / np.linalg.norm(stepper.body.gravity)
    return BodyState(turned - stepper.detector.gaps(turned)[0].min() * up, np.zeros_like(turned))


def planner_of(stepper: LocomotionStepper) -> DevicePlanner:
    planner = stepper._device_planner
    assert isinstance(planner, DevicePlanner)
    return planner


def equals_host_plan(
    stepper: LocomotionStepper, start: StepInputs, memory: WarmStart, objectives: Sequence[AnyObjective]
) -> bool:
    """Assert that the plan and its linearisation equal those of the host; return False if planning is left to the
    host."""
    found = planner_of(stepper).plan(start, objectives)
    if found is None:
        return False
    response, plan = found
    begun_at = response.iterate_at(None, plan.velocities, plan.forces)
    delassus = response.delassus.copy()
    prospect = stepper.predict(start)
    expected = stepper.planner.plan(prospect, memory.activations, objectives, StageClock())
    height = stepper.body.height
    assert plan.qp_count == expected.qp_count and plan.qp_infeasible == expected.qp_infeasible
    np.testing.assert_allclose(plan.activations, expected.activations, rtol=0, atol=1e-7 * height)
    np.testing.assert_allclose(plan.velocities, expected.velocities, rtol=0, atol=1e-7 * stepper.body.speed_unit)
    np.testing.assert_allclose(plan.forces, expected.forces, rtol=0, atol=1e-6 * stepper.body.weight)
    scale = np.abs(delassus).max(initial=1e-300)
    np.testing.assert_allclose(delassus, prospect.linearization.delassus, rtol=0, atol=1e-9 * scale)
    # The current iterate would have the tension of the muscles.
    assert isinstance(begun_at, DeviceNewtonIterate) and begun_at.tension is None
    return True


def test_device_plans_equal_host_plans(creature: Creature, stepper: LocomotionStepper) -> None:
    """Plans of consecutive steps from rest, and of steps in flight, are compared. A GPU records a graph in the first
    plan and replays it in the others."""
    state, memory, at_once = creature.start, stepper.initial_memory(), 0
    objectives = asks(creature, 0.1)
    for number in range(6):
        at_once += equals_host_plan(stepper, begun(stepper, state, memory), memory, objectives)
        state, memory, reports = stepper.advance(state, memory, objectives, DT)
        assert all(report.converged for report in reports), number
    # The contact points of this body are nearly redundant, so that the search sometimes fails numerically.
    assert at_once >= 3
    up = -stepper.body.gravity / np.linalg.norm(stepper.body.gravity)
    flown = BodyState(creature.start.positions + 0.3 * stepper.body.height * up, state.velocities)
    for _ in range(2):
        start = begun(stepper, flown, memory)
        assert start.contacts.count == 0
        assert equals_host_plan(stepper, start, memory, objectives)


def test_the_solve_continues_from_the_end_of_the_plan(
    creature: Creature, stepper: LocomotionStepper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan has already queued the first Newton step, so the solve does not queue it again. The result equals that
    of a step that is queued explicitly."""
    memory = stepper.initial_memory()
    start = begun(stepper, creature.start, memory)
    found = planner_of(stepper).plan(start, asks(creature, 0.1))
    assert found is not None
    response, plan = found
    tension = MuscleEnergy.of(stepper.muscles, plan.activations)
    asked: list[str] = []
    for name in ("start_trial", "start_newton"):
        real = getattr(NewtonWorkspace, name)
        monkeypatch.setattr(
            NewtonWorkspace,
            name,
            lambda *given, name=name, real=real, **named: asked.append(name) or real(*given, **named),
        )
    progress, again = stepper.solver.progress(start.problem), stepper.solver.progress(start.problem)
    first = response.iterate_at(tension, plan.velocities, plan.forces)
    stretch = first.newton_steps(start.normal_bias, start.friction, progress)
    assert asked == [] and first.residual_norm > 0.0 and progress.steps > 1
    second = response.iterate_at(tension, plan.velocities.copy(), plan.forces)
    assert second.residual_norm == pytest.approx(first.residual_norm, rel=1e-7)
    np.testing.assert_allclose(second.free_contact_velocities, first.free_contact_velocities, rtol=0, atol=1e-10)
    other = second.newton_steps(start.normal_bias, start.friction, again)
    ahead, beyond = stretch.trial, other.trial
    assert asked == ["start_trial", "start_newton"] and stretch.coulomb_violation < 1e-10
    np.testing.assert_allclose(again.row, progress.row, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(other.forces, stretch.forces, rtol=0, atol=1e-7 * stepper.body.weight)
    np.testing.assert_allclose(beyond.velocities, ahead.velocities, rtol=0, atol=1e-10)
    assert ahead.penetration is not None and beyond.penetration is not None
    assert ahead.penetration.is_penetrating == beyond.penetration.is_penetrating
    assert ahead.penetration.min_gap == pytest.approx(beyond.penetration.min_gap, abs=1e-12)
    np.testing.assert_allclose(beyond.penetration.internal_torque, ahead.penetration.internal_torque, rtol=1e-6)


@pytest.mark.parametrize("last", [False, True])
def test_a_replan_equals_that_of_the_host(creature: Creature, stepper: LocomotionStepper, last: bool) -> None:
    """Replanning starts from the end of the last Newton step, which is the current iterate on the device, or from its
    start. From any other point, replanning is left to the host."""
    memory, objectives = stepper.initial_memory(), asks(creature, 0.1)
    start = begun(stepper, on_its_edge(stepper), memory)
    found = planner_of(stepper).plan(start, objectives)
    assert found is not None
    response, plan = found
    tension = MuscleEnergy.of(stepper.muscles, plan.activations)
    progress = stepper.solver.progress(start.problem)
    stretch = response.iterate_at(tension, plan.velocities, plan.forces).newton_steps(
        start.normal_bias, start.friction, progress
    )
    end = stretch.trial if last else stretch.base
    prospect = PredictedStep(response, start.normal_bias, plan.activations, end.velocities, end.forces)
    again = planner_of(stepper).replan(prospect, memory.activations, objectives, start.friction)
    assert again is not None
    expected = stepper.planner.plan(prospect, memory.activations, objectives, StageClock())
    assert again.qp_count == expected.qp_count
    np.testing.assert_allclose(again.activations, expected.activations, rtol=0, atol=1e-7 * stepper.body.height)
    np.testing.assert_allclose(again.velocities, expected.velocities, rtol=0, atol=1e-7 * stepper.body.speed_unit)
    np.testing.assert_allclose(again.forces, expected.forces, rtol=0, atol=1e-6 * stepper.body.weight)
    response.iterate_at(None, 0.5 * end.velocities, end.forces)
    assert planner_of(stepper).replan(prospect, memory.activations, objectives, start.friction) is None


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("what", ["costly", "kept", "better", "astray", "no bound", "second astray"])
def test_a_restart_equals_that_of_the_host(
    what: str, beside: bool, creature: Creature, stepper: LocomotionStepper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the result of the first search has a high cost, there is a second search, which runs concurrently or
    afterwards. The plan equals the host's plan, and the contact solve starts from the end of the plan. Only after a
    numerical failure is the search left to the host.
    """
    memory, objectives = stepper.initial_memory(), asks(creature, 0.1)
    monkeypatch.setattr(device_plan, "PARALLEL_RESTART_COST", 0.0 if beside else np.inf)
    if what != "astray":
        monkeypatch.setattr(device_plan, "RESTART_COST", 0.0)
    planner_of(stepper)._workspaces.clear()
    start = begun(stepper, creature.start, memory)
    asked: list[str] = []

    def noted(module: Any, name: str, given: Callable[..., Any]) -> None:
        monkeypatch.setattr(module, name, wraps(given)(lambda *a, **b: asked.append(name) or given(*a, **b)))

    noted(device_restart, "search_modes", search_modes)
    noted(device_restart, "solve_relaxed", solve_relaxed)
    noted(DeviceRestart, "enqueue_restart", DeviceRestart.enqueue_restart)
    noted(DeviceRestart, "enqueue_from_point", DeviceRestart.enqueue_from_point)
    noted(PlanWorkspace, "_replace_end", PlanWorkspace._replace_end)
    if what != "astray":
        monkeypatch.setattr(strategies, "RESTART_COST", 0.0)
        monkeypatch.setattr(strategies, "RESTART_GAP", 0.0)
    if what not in ("costly", "astray"):
        for module in (strategies, device_restart):
            monkeypatch.setattr(
                module,
                "restart_from_relaxation",
                lambda found, relaxed, search: (search(relaxed[0]), found)[what == "kept"],
            )
    if what == "astray":
        monkeypatch.setattr(device_plan, "OPTIMUM_FOUND", -1)
        monkeypatch.setattr(strategies, "search_modes_device", lambda *_, **__: None)
    elif what == "no bound":
        monkeypatch.setattr(RelaxationWorkspace, "parse_result", lambda _: None)
    elif what == "second astray":
        monkeypatch.setattr(ModeSearchWorkspace, "parse_result", lambda *_: None)
    assert equals_host_plan(stepper, start, memory, objectives)
    expected = {
        "costly": ["enqueue_restart", "_replace_end"],
        "better": ["enqueue_restart", "_replace_end"],
        "kept": ["enqueue_restart"],
        "astray": ["search_modes", "_replace_end"],
        "no bound": ["enqueue_restart", "solve_relaxed", "enqueue_from_point", "_replace_end"],
        "second astray": ["enqueue_restart", "search_modes", "_replace_end"],
    }
    again = ["enqueue_restart"] if beside and what in ("astray", "no bound") else []
    assert asked == again + expected[what]
    found = planner_of(stepper).plan(start, objectives)
    assert found is not None
    stretch = (
        found[0]
        .iterate_at(MuscleEnergy.of(stepper.muscles, found[1].activations), found[1].velocities, found[1].forces)
        .newton_steps(start.normal_bias, start.friction, stepper.solver.progress(start.problem))
    )
    assert (
        stretch.coulomb_violation < 1e-9
        and np.isfinite(stretch.trial.residual_norm)
        and stretch.forces.shape == found[1].forces.shape
    )


@pytest.mark.parametrize("what", ["factors", "sizes", "missed", "horizon", "end", "forces"])
def test_failures_are_left_to_the_host(
    what: str, creature: Creature, stepper: LocomotionStepper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The failures are a matrix that is not positive definite, an inverted element, or a violation of Coulomb's law, in
    the prediction or at the end of the search."""
    memory, objectives = stepper.initial_memory(), asks(creature, 0.1)
    start = begun(stepper, creature.start, memory)
    assert planner_of(stepper).plan(start, objectives) is not None
    place, value = {
        **{"factors": ((0, 3), 0.0), "sizes": ((1, 2), np.nan), "missed": ((2, 1), 1.0)},
        **{"horizon": ((3, 0), 0.0), "end": ((3, 1), np.inf), "forces": ((3, 2), 1.0)},
    }[what]
    room = planner_of(stepper)._workspace_for(start)
    told = [part.copy() for part in room._parts]
    told[place[0]][place[1]] = value
    monkeypatch.setattr(room, "_parts", told)
    assert planner_of(stepper).plan(start, objectives) is None
    end, _, reports = stepper.advance(creature.start, memory, objectives, DT)
    stepper._device_planner = None
    expected, _, others = stepper.advance(creature.start, memory, objectives, DT)
    assert reports[0].converged and reports[0].qp_count == others[0].qp_count
    np.testing.assert_array_equal(end.velocities, expected.velocities)


def test_a_compressed_body_is_left_to_the_host(creature: Creature, stepper: LocomotionStepper) -> None:
    squeezed = creature.start.positions * np.array([1.0, 0.4, 1.0])
    memory = stepper.initial_memory()
    assert planner_of(stepper).plan(begun(stepper, BodyState(squeezed, 0.0 * squeezed), memory), []) is None


def test_a_failed_step_is_replanned_on_the_device(
    creature: Creature, stepper: LocomotionStepper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The step is replanned, because the thresholds of replanning are set to zero, and its result equals that of the
    host."""
    monkeypatch.setattr(stepping, "REPLAN_FACTOR", 0.0)
    monkeypatch.setattr(stepping, "REPLAN_MARGIN", -1.0)
    planned: list[bool] = []
    again = DevicePlanner.replan

    def counted(*given: Any) -> Plan | None:
        planned.append((found := again(*given)) is not None)
        return found

    monkeypatch.setattr(DevicePlanner, "replan", counted)
    memory, objectives, state = stepper.initial_memory(), asks(creature, 0.1), on_its_edge(stepper)
    end, _, (report,) = stepper.advance(state, memory, objectives, DT)
    assert planned == [True] and report.converged
    stepper._device_planner = None
    expected, _, (other,) = stepper.advance(state, memory, objectives, DT)
    assert report.qp_count == other.qp_count
    np.testing.assert_allclose(end.positions, expected.positions, rtol=0, atol=1e-8 * stepper.body.height)


def test_steppers_of_one_body_share_the_workspace(creature: Creature, stepper: LocomotionStepper) -> None:
    """Alternating steps on grounds with two friction coefficients equal the steps on each ground alone."""
    slippery = stepper.with_friction(0.1)
    assert slippery._device_planner is stepper._device_planner and slippery.linearizer is stepper.linearizer
    memory, objectives = stepper.initial_memory(), asks(creature, 0.1)
    one, other = ((creature.start, memory), (creature.start, memory))
    turns: list[np.ndarray] = []
    for _ in range(2):
        one = stepper.advance(*one, objectives, DT)[:2]
        other = slippery.advance(*other, objectives, DT)[:2]
        turns += [one[0].positions, other[0].positions]
    alone = []
    for each in (stepper, slippery):
        state, known = creature.start, memory
        for _ in range(2):
            state, known, _ = each.advance(state, known, objectives, DT)
            alone.append(state.positions)
    for turn, place in zip(turns, (0, 2, 1, 3), strict=True):
        np.testing.assert_allclose(turn, alone[place], rtol=0, atol=1e-9 * stepper.body.height)


def test_a_step_is_prefetched_once(
    creature: Creature, stepper: LocomotionStepper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan of the next step is started as soon as a step has ended. If the stepper does other work in between, the
    plan is started again, with the same result."""
    counted: list[StepInputs] = []
    begin = DevicePlanner.start
    monkeypatch.setattr(DevicePlanner, "start", lambda self, start: counted.append(start) or begin(self, start))
    objectives, slippery = asks(creature, 0.1), stepper.with_friction(0.2)
    first = on_its_edge(stepper), stepper.initial_memory()

    def end_after(meanwhile: Callable[[BodyState, WarmStart], object]) -> np.ndarray:
        state, memory, _ = stepper.advance(*first, objectives, DT)
        meanwhile(state, memory)
        counted.clear()
        end, _, (report,) = stepper.advance(state, memory, objectives, DT)
        assert report.converged
        return end.positions

    expected = end_after(lambda state, memory: setattr(stepper, "_prefetched", None))
    assert len(counted) == 2
    for times, meanwhile in [
        (1, lambda state, memory: None),
        (2, lambda state, memory: slippery.advance(state, memory, objectives, DT)),
        (2, lambda state, memory: slippery.advance_with_activations(state, memory, memory.activations, DT)),
        (2, lambda state, memory: slippery.advance(*first, objectives, DT)),
        (2, lambda state, memory: stepper.passive_step(first[0], memory, DT)),
    ]:
        found = end_after(meanwhile)
        assert len(counted) == times
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
