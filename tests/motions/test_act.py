"""Gestures during a motion: objectives for a posed figure, measured sizes, and the end of the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.fem.soft_parts import stiffness_at_nodes, with_soft_parts
from egs_warp.locomotion.objectives import Objective
from egs_warp.motions.act import Act, sum_postures
from egs_warp.motions.acting import ACTING
from egs_warp.motions.dance import Dance
from egs_warp.motions.flip import Flip
from egs_warp.motions.gestures import Gesture, groove, nod
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.layer import CORRECTION_RATE
from egs_warp.motions.route import straight_route
from egs_warp.motions.sequence import Stance
from egs_warp.motions.skip import Skip, SkipTo
from egs_warp.motions.stand import PostureTarget
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk
from tests.support.creatures import coarse_creature
from tests.support.meshes import figure
from tests.support.stances import DT, block_place, standing_stance

NOD = {"degrees": 20.0, "count": 1.0}


@pytest.fixture(scope="module")
def person() -> Stance:
    """Return the stance of a figure; forward is +y, left is -x."""
    return standing_stance(figure())


def nodding(person: Stance, degrees: float, heading: float = 0.0) -> np.ndarray:
    """Return the nodes (N, 3) with the head rotated forward about its middle, and the body about the up axis."""
    head = nod(person, NOD).parts[0]
    nodes = person.standing.copy()
    centre, left = head.centre(nodes), person.ground.axes[1]
    nodes[head.nodes] = centre + Rotation.from_rotvec(np.radians(degrees) * left).apply(nodes[head.nodes] - centre)
    return nodes @ person.ground.rotation_about_up(np.radians(heading)).T


def head_objective(act: Act, state: BodyState, name: str = "head turning") -> Objective:
    (found,) = [o for o in act.objectives(state, None, DT) if isinstance(o, Objective) and o.name == name]
    return found


def test_the_head_is_turned_at_the_rate_of_the_curve_and_towards_it(person: Stance) -> None:
    """Before the lowest point of a nod, the target of a head on its curve is a rotation forward and down; the target of
    a head that is ahead of the curve is slower."""
    gesture = nod(person, NOD)
    channel = gesture.channels[0]
    time = float(0.5 * (channel.times[1] + channel.times[2]))
    value, rate = channel.at(time + DT)
    asked = []
    for ahead in (0.0, 5.0):
        act = Act(person, [(0.0, gesture)])
        act.objectives(BodyState(person.standing, 0 * person.standing), None, DT)
        nodes = nodding(person, float((value - DT * rate)[1]) + ahead)
        target = head_objective(act, BodyState(nodes, 0 * nodes, time)).target
        assert np.allclose(target[[0, 2]], 0.0, atol=1e-6 * abs(target[1]))
        asked.append(target[1])
    radius = asked[0] / np.radians(rate[1])
    assert 0.0 < radius < person.body.height and asked[1] < asked[0]


@pytest.mark.parametrize("heading", [0.0, 40.0, -170.0])
def test_a_gesture_is_measured_relative_to_the_heading(person: Stance, heading: float) -> None:
    gesture = nod(person, NOD)
    act = Act(person, [(0.5, gesture)])
    dip = float(gesture.channels[0].times[2])
    for time, degrees in ((0.0, 0.0), (0.5 + dip - DT, 12.0), (0.5 + dip, 17.0), (0.5 + gesture.duration, 30.0)):
        nodes = nodding(person, degrees, heading)
        act.objectives(BodyState(nodes, 0 * nodes, time), None, DT)
    (outcome,) = act.outcome_record(None, 0, 0).gestures  # pyright: ignore[reportArgumentType]
    assert outcome.requested == 20.0 and outcome.reached == pytest.approx(17.0, abs=0.01)
    assert outcome.text == "nod angle 17 of 20 degrees"


def test_a_soft_ear_belongs_to_the_head_but_is_not_driven(person: Stance) -> None:
    """In a shake, the head rotates with its ear; the heading of the rest of the body is unchanged. The objective of
    the head does not move the ear."""
    head = gesture_of("shake", person).parts[0]
    across = person.ground.local(person.standing)[head.nodes, 1]
    ear = head.nodes[across > np.quantile(across, 0.8)]
    person = replace(person, body=with_soft_parts(person.body, [ear], [0.01]))
    is_soft = stiffness_at_nodes(person.body)[head.nodes] <= 0.5
    assert 0.1 < is_soft.mean() < 0.5
    gesture = gesture_of("shake", person)
    time = float(gesture.channels[0].times[1])
    act, nodes = Act(person, [(0.0, gesture)]), person.standing.copy()
    act.objectives(BodyState(nodes, 0 * nodes), None, DT)
    centre, up = head.centre(nodes), person.ground.axes[2]
    nodes[head.nodes] = centre + Rotation.from_rotvec(np.radians(20.0) * up).apply(nodes[head.nodes] - centre)
    driven = head_objective(act, BodyState(nodes, 0 * nodes, time)).rows
    (outcome,) = act.outcome_record(None, 0, 0).gestures  # pyright: ignore[reportArgumentType]
    assert outcome.requested == 25.0 and act._layers[0]._reached[1] == pytest.approx(20.0, abs=1e-6)
    moved = np.flatnonzero(np.abs(np.asarray(driven)).sum(axis=0).reshape(-1, 3).any(axis=1))
    np.testing.assert_array_equal(moved, head.nodes[~is_soft])


def test_a_stretched_head_returns_to_its_shape(person: Stance) -> None:
    """In the pause of a look to the left, the target of a head on its curve that is 1 % too large in all directions is
    1 % of its size at the rate of correction."""
    gesture = gesture_of("look around", person)
    channel, head = gesture.channels[0], gesture.parts[0]
    time = float(0.5 * (channel.times[2] + channel.times[3]))
    act, nodes = Act(person, [(0.0, gesture)]), person.standing.copy()
    act.objectives(BodyState(nodes, 0 * nodes), None, DT)
    turn = Rotation.from_rotvec(person.ground.axes.T @ channel.at(time)[0], degrees=True)
    centre = head.centre(nodes)
    nodes[head.nodes] = centre + turn.apply(nodes[head.nodes] - centre)
    outer = act._layers[0]._outer[0]
    arms = nodes[outer.nodes] - outer.centre(nodes)
    nodes[head.nodes] = centre + 1.01 * (nodes[head.nodes] - centre)
    target = head_objective(act, BodyState(nodes, 0 * nodes, time), "head shape").target
    rate = CORRECTION_RATE * np.sqrt(np.linalg.norm(person.body.gravity) / person.body.height)
    roots = np.sqrt(outer.masses / outer.masses.sum())[:, None]
    np.testing.assert_allclose(target.reshape(-1, 3), -0.01 * rate * roots * arms, rtol=1e-6, atol=1e-9)


def test_the_rotation_of_a_part_is_no_error_of_the_body(person: Stance) -> None:
    """A body counts as upright if only its head is rotated, as the gesture requests."""
    gesture = nod(person, NOD)
    act, time = Act(person, [(0.0, gesture)]), float(gesture.channels[0].times[2]) - DT
    act.objectives(BodyState(person.standing, 0 * person.standing), None, DT)
    state = BodyState(person.standing, 0 * person.standing, time)
    act.objectives(state, None, DT)
    stand = act._stand
    assert stand is not None
    turn = stand.gesture_turn
    assert turn[1] > np.radians(0.5) and np.allclose(turn[[0, 2]], 0.0, atol=1e-3)
    layer = act._layers[0]
    nodes = person.ground.world(layer.pose(time + DT, person.ground.local(person.standing)))
    controller = stand.controller

    def tilt(excluded: np.ndarray) -> float:
        controller.gesture_turn = excluded
        return Rotation.from_matrix(controller.measure(BodyState(nodes, 0 * nodes), None).rotation).magnitude()

    apart, tilted = tilt(turn), tilt(np.zeros(3))
    assert apart < 0.1 * tilted


def test_overlapping_gestures_of_one_part_are_added(person: Stance) -> None:
    """The head has one objective, whose target is the sum of both curves. If a part has turned with the body before the
    start of the gesture, its target at the start is zero."""
    shakes = gesture_of("shake", person)
    state = BodyState(person.standing, 0 * person.standing)
    targets = []
    for gestures in ([nod(person, NOD)], [shakes], [nod(person, NOD), shakes]):
        act = Act(person, [(0.0, gesture) for gesture in gestures])
        act.objectives(state, None, DT)
        targets.append(head_objective(act, BodyState(person.standing, 0 * person.standing, 10 * DT)).target)
    # The tolerance is needed because rotations about different axes commute only to first order.
    assert np.allclose(targets[2], targets[0] + targets[1], atol=0.01 * np.abs(targets[2]).max())
    nodes = nodding(person, 0.0, 60.0)
    late = Act(person, [(1.0, nod(person, NOD))])
    late.objectives(BodyState(nodes, 0 * nodes), None, DT)
    first = head_objective(late, BodyState(nodes, 0 * nodes, 1.0)).target
    assert abs(first[2]) < 1e-6 and np.abs(first).max() < 1.0


def test_the_pose_of_a_walk_contains_its_gestures(person: Stance) -> None:
    walk = Walk(person, straight_route(0.3), 0.1)
    gesture = nod(person, NOD)
    act = Act(person, [(0.0, gesture)], walk)
    state = BodyState(person.standing, 0 * person.standing)
    act.objectives(state, None, DT)
    assert walk.with_gestures is not None
    local = person.ground.local(person.standing)
    still = walk.with_gestures(local)
    assert np.abs(still - local).max() < 0.01 * person.body.height
    act.objectives(BodyState(state.positions, state.velocities, float(gesture.channels[0].times[2])), None, DT)
    moved = walk.with_gestures(local) - local
    head = gesture.parts[0].nodes
    assert np.allclose(np.delete(moved, head, axis=0), 0.0) and moved[head, 0].mean() > 0.0


def test_a_motion_below_is_completed_before_the_body_stands(person: Stance) -> None:
    jump = Jump(person, JumpTarget(0.1, 0.1))
    act = Act(person, [(0.0, nod(person, NOD))], jump)
    assert act.plan_record() is jump.plan and act.expected_time >= jump.expected_time
    state = BodyState(person.standing, 0 * person.standing, 100.0)
    act.objectives(BodyState(person.standing, 0 * person.standing), None, DT)
    act.objectives(state, None, DT)
    assert not act.is_at_rest and act._stand is None
    jump.phase = type(jump.phase).REST
    assert act.is_at_rest
    act.objectives(state, None, DT)
    assert act._stand is not None and act.is_at_rest


def test_the_current_jump_below_excludes_the_rotation_that_gestures_cause(person: Stance) -> None:
    jumps = (
        Jump(person, JumpTarget(0.1, 0.1)),
        Skip(person, 0.2, 0.1),
        SkipTo(person, np.array([0.2, 0.1]), 0.1),
        Turn(person, JumpTarget(0.0, 0.1), 1.0),
    )
    rotations = []
    for below in jumps:
        act = Act(person, [(0.0, nod(person, NOD))], below)
        for time in (0.0, 0.2):
            act.objectives(BodyState(person.standing, 0 * person.standing, time), None, DT)
        jump = below.parts[-1] if isinstance(below, SkipTo) else below
        jump = jump.jumps[-1] if isinstance(jump, Skip | Turn) else jump
        rotations.append(jump.gesture_turn.copy())
    assert np.linalg.norm(rotations[0]) > 1e-4
    np.testing.assert_allclose(rotations, [rotations[0]] * len(jumps))


def test_a_gesture_on_top_of_a_dance_replaces_the_accents_of_its_part(person: Stance) -> None:
    """The head of a dancing body has one objective, that of a nod, and an arm that of a wave. The other arm keeps its
    accents, and the body compensates for the rotation that all of them cause."""
    gestures = [(0.0, nod(person, NOD)), (0.0, gesture_of("wave", person))]
    dances = [Dance(person, (1.0, 1.6)) for _ in range(2)]
    motions = (dances[0], Act(person, gestures, dances[1]), Act(person, gestures))
    targets = []
    for motion in motions:
        motion.objectives(BodyState(person.standing, 0 * person.standing), None, DT)
        found = motion.objectives(BodyState(person.standing, 0 * person.standing, 0.8), None, DT)
        turning = [o for o in found if isinstance(o, Objective) and o.name.endswith(" turning")]
        targets.append({o.name: o.target for o in turning})
        assert len(targets[-1]) == len(turning), "each part has one objective"
    accents, both, alone = targets
    assert len(alone) == 2 and len(accents) == 3 and both.keys() == accents.keys()
    for name, target in both.items():
        np.testing.assert_allclose(target, alone.get(name, accents[name]))
        assert name not in alone or not np.allclose(target, accents[name])
    turns = [dance._current_step.jump.gesture_turn for dance in dances if dance._current_step is not None]
    assert len(turns) == 2 and np.abs(turns[1] - turns[0]).max() > np.radians(0.1)


def test_a_gesture_of_the_whole_body_needs_a_body_that_stands(person: Stance) -> None:
    sway = groove(person, {"tempo": 100.0, "beats": 4.0, "sway": 0.04})
    with pytest.raises(UserError) as error:
        Act(person, [(0.0, sway)], Walk(person, straight_route(0.3), 0.1))
    assert str(error.value) == "groove: it and the motion below it both move the whole body; give one after the other"
    Act(person, [(0.0, sway), (0.5, nod(person, NOD))])
    on_top = Act(person, [(0.0, nod(person, NOD))], Walk(person, straight_route(0.3), 0.1))
    assert not any(layer.gesture.moves_whole_body for layer in on_top._layers), "the body does not follow the head"


def test_a_somersault_allows_no_gesture(person: Stance) -> None:
    with pytest.raises(UserError) as error:
        Act(person, [(0.0, nod(person, NOD))], Flip(block_place(), 4.0))
    assert str(error.value) == "nod: a somersault allows no gesture; give one after the other"


def test_postures_are_added() -> None:
    one = PostureTarget(*np.arange(12.0).reshape(4, 3))
    both = sum_postures([one, one])
    assert np.array_equal(both.turn, 2.0 * one.turn) and np.array_equal(both.velocity, 2.0 * one.velocity)


def gesture_of(name: str, stance: Stance) -> Gesture:
    kind = ACTING[name]
    assert kind.gesture is not None
    return kind.gesture(stance, {value.name: value.default for value in kind.parameters})


@pytest.mark.slow
def test_a_figure_looks_waves_and_nods_with_overlap() -> None:
    """Each gesture reaches at least nine tenths of its size, and the figure stands at the end."""
    made = coarse_creature(figure(), forward=np.array([0.0, 1.0, 0.0]))
    act = Act(made.place, [(begin, gesture_of(name, made.place)) for begin, name in ((0.0, "nod"), (0.8, "wave"))])
    state, memory, report = made.start, made.stepper.initial_memory(), None
    for _ in range(300):
        if act.is_at_rest:
            break
        state, memory, reports = made.stepper.advance(state, memory, act.objectives(state, report, DT), DT)
        report = reports[-1]
    assert act.is_at_rest
    for outcome in act.outcome_record(None, 0, 0).gestures:  # pyright: ignore[reportArgumentType]
        assert outcome.reached == pytest.approx(outcome.requested, rel=0.1), outcome.name
    drift = made.place.body.centre_of_mass(state.positions) - made.place.body.centre_of_mass(made.start.positions)
    assert np.linalg.norm(drift) < 0.05 * made.place.body.height
