"""Simulation that ends at a step that cannot be solved, and keeps the earlier steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.fem.implicit_step import UnsolvableStepError
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.rollout import REST_FRAMES, BodyRun, RolloutResult
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import box_mesh
from tests.support.props import box_body
from tests.support.runs import roll_out
from tests.support.stances import FORWARD


def run(creature: CoarseCreature, start: BodyState) -> RolloutResult:
    sequence = MotionSequence(creature.place, motion("jump").parts(creature.place.body.height))
    return roll_out(creature.stepper, start, sequence, frames=8)


@pytest.fixture(scope="module")
def creature() -> CoarseCreature:
    return coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD)


@pytest.mark.parametrize("failure", [UnsolvableStepError("singular"), np.linalg.LinAlgError("singular"), None])
def test_earlier_steps_are_kept(
    creature: CoarseCreature, failure: Exception | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fourth step ends with an error, or none of its parts converges."""
    advance, whole = LocomotionStepper.advance, run(creature, creature.start)

    def failing(stepper: LocomotionStepper, state: BodyState, *rest: Any) -> Any:
        end, memory, done = advance(stepper, state, *rest)
        if state.time < 0.049:
            return end, memory, done
        if failure is not None:
            raise failure
        return end, memory, [replace(report, converged=False) for report in done]

    monkeypatch.setattr(LocomotionStepper, "advance", failing)
    cut = run(creature, creature.start)
    assert cut.stopped and not whole.stopped
    assert len(cut.reports) == 3 and cut.frames.tolist() == [0, 1, 2, 3]
    assert np.array_equal(cut.trajectory.positions, whole.trajectory.positions[:4])


def test_a_divided_step_passes_on_its_last_part(creature: CoarseCreature, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second step begins at the end of the second part of the first step, with its contacts and activations."""
    advance, given, parts = LocomotionStepper.advance, [], []

    def halved(stepper: LocomotionStepper, state: BodyState, memory: WarmStart, *rest: Any) -> Any:
        given.append((state, memory))
        end, after, done = advance(stepper, state, memory, *rest)
        if len(given) == 1:
            end, after, more = advance(stepper, end, after, *rest)
            done = [*done, *more]
            parts.extend(done)
        return end, after, done

    monkeypatch.setattr(LocomotionStepper, "advance", halved)
    run(creature, creature.start)
    state, memory = given[1]
    assert len(parts) == 2 and state is parts[1].state
    for name in ("points", "forces", "activations"):
        expected = getattr(WarmStart.from_report(parts[1]), name)
        np.testing.assert_array_equal(getattr(memory, name), expected)
    assert not np.array_equal(memory.activations, parts[0].activations)


@pytest.mark.parametrize("before", [[], [True] * 5 + [False]], ids=["at once", "and goes on"])
def test_a_finished_motion_rests_before_it_ends(creature: CoarseCreature, before: list[bool]) -> None:
    """The run ends after ``REST_FRAMES`` consecutive frames in which the motion is finished; a frame in which it is not
    resets the count."""
    frames = iter(before + [True] * 100)
    nothing = np.zeros((100, creature.stepper.muscles.segment_count))
    done = roll_out(
        creature.stepper,
        creature.start,
        MotionSequence(creature.place, motion("stand 1").parts(creature.place.body.height)),
        frames=100,
        finished=lambda: next(frames),
        activations=nothing,
    )
    assert len(done.frames) == 1 + len(before) + REST_FRAMES and not done.stopped


@pytest.mark.slow
def test_steps_that_have_no_solution(creature: CoarseCreature) -> None:
    """A start state with NaN, or with values too large for double precision, stops the run before the first step."""
    still, positions = np.zeros_like(creature.start.velocities), creature.start.positions
    for start in (
        BodyState(positions, still * np.nan),
        BodyState(positions, still - [0.0, 0.0, 1e20]),
        BodyState(positions + [1e9, 0.0, 0.0], still),
    ):
        done = run(creature, start)
        assert done.stopped and len(done.reports) == 0 and done.frames.tolist() == [0]
        assert done.trajectory.activations.shape == (0, creature.stepper.muscles.segment_count)


def test_a_body_that_stands_still_is_settled_in_few_steps(
    creature: CoarseCreature, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Settling ends before its limit of twelve steps, when a further long step would move the body by less than 2e-4 of
    its height and the contact forces equal its weight to 1 %.
    """
    steps, passive = [], LocomotionStepper.passive_step
    monkeypatch.setattr(LocomotionStepper, "passive_step", lambda *given: steps.append(1) or passive(*given))
    state, body = settle(creature.stepper), creature.stepper.body
    assert 1 < len(steps) < 12
    more = creature.stepper.passive_step(state, creature.stepper.initial_memory(), 0.25 * body.time_unit)
    assert 0.25 * body.time_unit * np.abs(more.velocities).max() < 2e-4 * body.height
    assert more.forces[:, 0].sum() == pytest.approx(body.weight, rel=0.01)


def test_a_body_over_no_ground_is_not_followed_down(creature: CoarseCreature) -> None:
    """Each step of dt = sqrt(H / g) / 4 starts without velocity, so the body falls by g dt^2 = H / 16. Settling ends
    after two steps, because the centre of mass has then moved by more than 0.1 H."""
    body, geometry = creature.stepper.body, creature.stepper.geometry
    (floor,) = geometry.planes
    below = replace(geometry, planes=(replace(floor, offset=floor.offset + 100.0),))
    state = settle(LocomotionStepper(body, creature.stepper.muscles, below, device="cpu"))
    fallen = body.centre_of_mass(state.positions) - body.centre_of_mass(body.mesh.nodes)
    np.testing.assert_allclose(fallen, [0.0, 0.0, -body.height / 8.0], atol=1e-6)


def test_zero_frames(creature: CoarseCreature) -> None:
    """The start is the only state, and the run does not count as stopped by an error."""
    sequence = MotionSequence(creature.place, motion("jump").parts(creature.place.body.height))
    done = roll_out(creature.stepper, creature.start, sequence, frames=0)
    assert not done.stopped and done.reports == () and done.frames.tolist() == [0]
    assert len(done.trajectory.time) == 1


def test_pushes_from_the_side_and_self_contact_are_no_support() -> None:
    stepper = box_body((0.4, 0.4, 0.4)).stepper
    nodes = stepper.body.mesh.nodes
    start = BodyState(nodes, np.zeros_like(nodes))
    seen: list[StepReport | None] = []

    class Watcher:
        def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
            seen.append(report)
            return []

    run = BodyRun(stepper, start, Watcher(), index=1)
    _, _, reports = stepper.advance(start, run.memory, [], 1.0 / 60.0)
    contacts = reports[-1].contacts
    assert contacts.count >= 4
    axes, faces = contacts.axes.copy(), contacts.faces.copy()
    # In the changed report, contact 0 is a push from the side, contact 1 a contact with another body below, and the
    # last contact one with the body itself.
    faces[:2], faces[-1] = -1, -2
    axes[0] = axes[0, [1, 2, 0]]
    pushed = replace(reports[-1], contacts=replace(contacts, axes=axes, faces=faces), min_gap=-0.1)
    run.finish_step([pushed])
    run.objectives(1.0 / 60.0)
    report = seen[-1]
    assert report is not None and report.contacts.count == contacts.count - 2
    np.testing.assert_array_equal(report.contacts.weights, contacts.weights[1:-1])
    np.testing.assert_array_equal(report.forces, reports[-1].forces[1:-1])
    assert report.min_gap == reports[-1].min_gap
    # Lifted by 0.3 m, the body touches only the body below: its minimum gap is that of contact 1.
    lifted = replace(pushed.state, positions=pushed.state.positions + np.array([0.0, 0.0, 0.3]))
    gaps = np.full(contacts.count, 0.3)
    gaps[:2] = -0.2, -1e-4
    run.finish_step([replace(pushed, state=lifted, end_gaps=gaps)])
    run.objectives(1.0 / 60.0)
    report = seen[-1]
    assert report is not None and report.min_gap == -1e-4
    t = run.result(stopped=False).trajectory
    assert t.world_index == 1 and np.flatnonzero(t.is_self_contact).tolist() == [
        contacts.count - 1,
        2 * contacts.count - 1,
    ]
