"""Many worlds in one batch, each of which has the results of a single run, independent of the other worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from egs_warp.contact.detection import ContactGeometry
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.batch import BatchStepper
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.simulated_run import simulate
from tests.support.creatures import coarse_pawn, on_its_rim
from tests.support.waves import wavy_ground

FRICTIONS = (0.8, 0.3, 1.2)
STRENGTHS = (1.0, 0.9, 0.5)
"""Factor of each world on the recorded activations."""
FIRST, STEPS = 29, 30
"""First step and number of steps taken from the recorded jump, in which the body takes off in the 34th step and lands
in the 56th."""


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


@pytest.fixture(scope="module")
def jump(creature: Creature) -> Trajectory:
    return simulate(creature, motion("jump"), frames=FIRST + STEPS + 1).trajectory


def runs_alone(
    creature: Creature, starts: list[BodyState], activations: np.ndarray, dt: float
) -> list[list[list[StepReport]]]:
    """Return the reports of single runs with ``activations`` (steps, worlds, M), m, by world and step."""
    runs = []
    for world, (friction, state) in enumerate(zip(FRICTIONS, starts, strict=True)):
        stepper = creature.stepper.with_friction(friction)
        memory, reports = stepper.initial_memory(), []
        for given in activations[:, world]:
            state, memory, done = stepper.advance_with_activations(state, memory, given, dt)
            reports.append(done)
        runs.append(reports)
    return runs


def runs_together(stepper: BatchStepper, starts: list[BodyState], activations: np.ndarray, dt: float) -> list:
    """Return the reports of the same runs in one batch."""
    runs: list[list[list[StepReport]]] = [[] for _ in starts]
    state = stepper.start(starts)
    for given in activations:
        state, done, lost = stepper.advance_with_activations(state, given, dt)
        assert not lost.any()
        for run in runs:
            run.append([])
        for step in done:
            for world, report in zip(step.worlds.tolist(), step.reports(), strict=True):
                runs[world][-1].append(report)
    return runs


def check(creature: Creature, one: StepReport, other: StepReport) -> None:
    """Assert that both reports describe the same step, to 1e-9 in the units of the body."""
    body = creature.body
    assert (one.dt, one.converged, one.newton_iterations) == (other.dt, other.converged, other.newton_iterations)
    assert np.array_equal(one.contacts.points, other.contacts.points)
    assert np.array_equal(one.contacts.faces, other.contacts.faces)
    assert np.array_equal(one.activations, other.activations)
    assert one.state.time == pytest.approx(other.state.time, abs=1e-12)
    for mine, its, unit in (
        (one.state.positions, other.state.positions, body.height),
        (one.state.velocities, other.state.velocities, body.speed_unit),
        (one.end_gaps, other.end_gaps, body.height),
        (one.contacts.axes, other.contacts.axes, 1.0),
        (one.min_gap, other.min_gap, body.height),
        (one.added_spin, other.added_spin, 1.0 / body.time_unit),
    ):
        np.testing.assert_allclose(mine, its, rtol=0, atol=1e-9 * unit)
    # Nodal forces are compared, because the distribution of a load over redundant points is not unique.
    nodal = [report.contacts.nodal_forces(report.forces) for report in (one, other)]
    np.testing.assert_allclose(*nodal, rtol=0, atol=1e-6 * body.weight)


def test_each_world_equals_a_single_run(creature: Creature, jump: Trajectory) -> None:
    """30 steps of a jump, from before take-off until after landing, in three worlds with different friction and
    activations."""
    dt, _ = solver_steps(creature.body)
    starts = [BodyState(jump.positions[FIRST], jump.velocities[FIRST])] * 3
    activations = np.stack([strength * jump.activations[FIRST:][:STEPS] for strength in STRENGTHS], axis=1)
    expected = runs_alone(creature, starts, activations, dt)
    made = runs_together(BatchStepper(*parts(creature), FRICTIONS), starts, activations, dt)
    for run, its in zip(made, expected, strict=True):
        assert [len(done) for done in run] == [len(done) for done in its] == [1] * STEPS
        for one, other in zip(run, its, strict=True):
            check(creature, one[0], other[0])
    pressed = [[bool((done[0].forces[:, 0] > 0.0).any()) for done in run] for run in made]
    # The body stands, flies and stands again, and the results of the worlds differ.
    assert all(run[0] for run in pressed) and not all(pressed[0]) and pressed[0][-1]
    apart = np.abs(made[0][-1][0].state.positions - made[1][-1][0].state.positions).max()
    assert apart > 1e-4 * creature.body.height


def test_each_world_on_uneven_ground_equals_a_single_run(creature: Creature, jump: Trajectory) -> None:
    """Eight steps in which the body lands on waves and tilts, in each world."""
    dt, _ = solver_steps(creature.body)
    geometry = replace(creature.geometry, field=wavy_ground(0.02 * creature.body.height, spacing=0.04, reach=1.0))
    there = replace(creature, stepper=LocomotionStepper(creature.body, creature.muscles, geometry, device="cpu"))
    nodes = jump.positions[FIRST]
    gaps, _ = there.stepper.detector.gaps(nodes)
    start = BodyState(nodes - np.array([0.0, 0.0, gaps.min()]), np.zeros_like(nodes))
    activations = np.stack([strength * jump.activations[FIRST:][:8] for strength in STRENGTHS], axis=1)
    expected = runs_alone(there, [start] * 3, activations, dt)
    made = runs_together(BatchStepper(*parts(there), FRICTIONS), [start] * 3, activations, dt)
    slopes = []
    for run, its in zip(made, expected, strict=True):
        for reports, others in zip(run, its, strict=True):
            assert len(reports) == len(others) > 0
            for one, other in zip(reports, others, strict=True):
                check(creature, one, other)
                slopes += np.linalg.norm(one.contacts.axes[one.forces[:, 0] > 0.0, 0, :2], axis=1).tolist()
    # The normals of the loaded contacts have different slopes.
    assert len(slopes) > 40 and np.ptp(slopes) > 0.05


def parts(creature: Creature) -> tuple[SoftBody, MuscleSet, ContactGeometry]:
    return creature.body, creature.muscles, creature.stepper.geometry


def rough(creature: Creature) -> tuple[list[BodyState], np.ndarray, float]:
    """Return start states, activations (2, 3, M), m, and the step size, s, of three worlds. The bodies of the first and
    the last one hit the ground with random muscle activations; the middle one stands. The step size is four times the
    usual one, so that steps are halved."""
    body, down = creature.body, creature.body.gravity / np.linalg.norm(creature.body.gravity)
    dt = 4.0 * solver_steps(body)[0]
    starts = [
        BodyState(creature.start.positions - 0.05 * body.height * down, creature.start.velocities + speed * down)
        for speed in (3.0 * body.speed_unit, body.speed_unit)
    ]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (2, 3, len(creature.muscles.bounds)))
    signs[:, 1] = 0.0
    return [starts[0], creature.start, starts[1]], signs * creature.muscles.bounds, dt


def test_a_world_continues_from_its_last_step(creature: Creature, jump: Trajectory) -> None:
    """Contacts and forces of two different worlds are passed to the next step, which equals that of a single world."""
    dt, _ = solver_steps(creature.body)
    begun = [BodyState(jump.positions[step], jump.velocities[step]) for step in (FIRST, FIRST + 1)]
    steppers, memories, states, expected = [], [], [], []
    for state, friction in zip(begun, FRICTIONS, strict=False):
        steppers.append(creature.stepper.with_friction(friction))
        state, memory, _ = steppers[-1].advance_with_activations(
            state, steppers[-1].initial_memory(), jump.activations[FIRST], dt
        )
        states.append(state)
        memories.append(memory)
        expected.append(steppers[-1].advance_with_activations(state, memory, jump.activations[FIRST + 1], dt)[2])
    beside = BatchStepper(*parts(creature), FRICTIONS[:2])
    state = beside.start(states, memories)
    for world, memory in enumerate(memories):
        count = len(memory.points)
        assert count > 4 and int(state.counts[world]) == count
        assert np.array_equal(state.points[world, :count].numpy(), memory.points)
        assert np.array_equal(state.forces[world, :count].numpy(), memory.forces)
    _, done, _ = beside.advance_with_activations(state, np.stack([jump.activations[FIRST + 1]] * 2), dt)
    (step,) = done
    for report, (other,) in zip(step.reports(), expected, strict=True):
        check(creature, report, other)


@pytest.mark.slow
def test_unconverged_steps_are_halved_as_in_single_runs(creature: Creature) -> None:
    starts, activations, dt = rough(creature)
    expected = runs_alone(creature, starts, activations[:1], dt)
    made = runs_together(BatchStepper(*parts(creature), FRICTIONS), starts, activations[:1], dt)
    lengths = [[report.dt / dt for report in run[0]] for run in made]
    assert lengths == [[report.dt / dt for report in run[0]] for run in expected]
    assert lengths[1] == [1.0] and min(lengths[0]) <= 0.25 and sum(lengths[0]) == pytest.approx(1.0)
    for run, its in zip(made, expected, strict=True):
        for one, other in zip(run[0], its[0], strict=True):
            check(creature, one, other)


@pytest.mark.slow
def test_a_world_does_not_depend_on_the_others(creature: Creature) -> None:
    """The steps of a world do not depend on the other worlds, in which bodies stand or fall, steps are halved or fail.
    They are equal to rounding, because products with other numbers of worlds and contacts round differently. The body
    has contact points only at its rim: with 32 points on so coarse a base, the Delassus operator is nearly singular and
    amplifies rounding errors a thousandfold.
    """
    starts, activations, dt = rough(creature)
    geometry = on_its_rim(creature.geometry)
    stood = starts[1]
    broken = replace(stood, velocities=np.full_like(stood.velocities, np.nan))
    given = np.repeat(0.1 * activations[:, :1], 3, axis=1)
    other = activations.copy()
    other[:, 1] = given[:, 1]
    ends = []
    for states, muscles in (([stood] * 3, given), (starts, other), ([broken, stood, stood], given)):
        stepper = BatchStepper(creature.body, creature.muscles, geometry, FRICTIONS)
        state = stepper.start(states)
        for row in muscles:
            state, _, _ = stepper.advance_with_activations(state, row[state.worlds], dt)
        ends.append(state.positions[state.worlds.tolist().index(1)].numpy())
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=0, atol=1e-13 * creature.body.height)


@pytest.mark.slow
def test_small_chunks_change_nothing(creature: Creature) -> None:
    starts, activations, dt = rough(creature)
    whole, cut = (
        runs_together(stepper, starts, activations[:1], dt)
        for stepper in (
            BatchStepper(*parts(creature), FRICTIONS),
            BatchStepper(*parts(creature), FRICTIONS, chunk_bytes=1, panel=100),
        )
    )
    for one, other in zip(whole, cut, strict=True):
        for mine, its in zip(one[0], other[0], strict=True):
            check(creature, mine, its)


def test_a_world_that_cannot_be_solved_is_reported_and_removed(creature: Creature) -> None:
    """The report lists the world with NaN as failed, and the other worlds continue."""
    dt, _ = solver_steps(creature.body)
    broken = replace(creature.start, velocities=np.full_like(creature.start.velocities, np.nan))
    stepper = BatchStepper(*parts(creature), FRICTIONS)
    state = stepper.start([creature.start, broken, creature.start])
    given = np.zeros((3, creature.muscles.segment_count))
    state, done, lost = stepper.advance_with_activations(state, given, dt)
    assert lost.tolist() == [False, True, False] and state.worlds.tolist() == [0, 2]
    assert [step.worlds.tolist() for step in done] == [[0, 2]]
    state, done, lost = stepper.advance_with_activations(state, given[:2], dt)
    assert not lost.any() and torch.isfinite(state.positions).all()


@pytest.mark.slow
def test_a_world_that_never_converges_is_reported(creature: Creature) -> None:
    """With a tolerance of zero, not even the smallest part of the step converges."""
    dt, _ = solver_steps(creature.body)
    stepper = BatchStepper(*parts(creature), FRICTIONS)
    stepper.solver = replace(stepper.solver, tolerance=0.0)
    given = np.zeros((3, creature.muscles.segment_count))
    state, done, lost = stepper.advance_with_activations(stepper.start([creature.start] * 3), given, dt)
    assert lost.all() and len(state.worlds) == 0 and done == []
