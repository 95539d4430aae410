"""Detection of falls by tilt and by contacts; flights, landings and intended tilts do not count as falls."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact.detection import ContactGeometry
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AngularMomentumObjective
from egs_warp.locomotion.rollout import REST_FRAMES
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.motions.fall_monitor import FALLEN_TILT, FALLEN_TIME, LOST_TIME, FallMonitor
from egs_warp.motions.follow import Follow
from egs_warp.motions.get_up import GetUpPhase
from egs_warp.motions.keyframes import Key, Quantity
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence, MotionTask
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import box_mesh
from tests.support.runs import roll_out
from tests.support.stances import DT, FLOOR, FORWARD


@pytest.fixture(scope="module")
def creature() -> CoarseCreature:
    return coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD)


class Stands:
    """Motion with objectives that never rests."""

    is_at_rest = False

    def __init__(self, _: object) -> None:
        pass

    def objectives(self, *_: object) -> list[AngularMomentumObjective]:
        return [AngularMomentumObjective(np.zeros(3), 1.0)]


def watched(creature: CoarseCreature, begin: Any = Stands) -> FallMonitor:
    return FallMonitor(MotionSequence(creature.place, [MotionTask("stand", {}, begin)]), creature.place)


def feed_monitor(
    creature: CoarseCreature, watch: FallMonitor, *, degrees: float, load: float, seconds: float, on: str = "base"
) -> None:
    """Pass to the monitor, for some ``seconds``, a body that is rotated by ``degrees`` and has ``load`` times its
    weight on its base or its top."""
    body, start = creature.place.body, creature.start
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    state = BodyState(start.positions @ turn.T, start.velocities)
    height = creature.place.standing[:, 2]
    node = int(np.argmin(height) if on == "base" else np.argmax(height))
    contacts = SimpleNamespace(nodes=np.array([[node] * 4]), count=0)
    report = SimpleNamespace(forces=np.array([[load * body.weight, 0.0, 0.0]]), contacts=contacts, min_gap=0.0)
    watch.objectives(state, None, DT)
    for step in range(1, int(np.ceil(seconds / DT)) + 1):
        watch.objectives(replace(state, time=step * DT), cast(Any, report), DT)


def test_tilt_and_what_a_body_lies_on(creature: CoarseCreature) -> None:
    long = FALLEN_TIME * np.sqrt(creature.place.body.height / 9.81)
    cases: list[tuple[dict[str, Any], str | None]] = [
        ({"degrees": FALLEN_TILT + 1, "load": 1.0, "seconds": long}, "tilted by 61 degrees at 0.17 s"),
        ({"degrees": -170.0, "load": 0.2, "seconds": long}, "tilted by 170 degrees at 0.17 s"),
        ({"degrees": FALLEN_TILT - 1, "load": 1.0, "seconds": 1.0}, None),
        ({"degrees": FALLEN_TILT + 1, "load": 1.0, "seconds": long - 2 * DT}, None),
        ({"degrees": 90.0, "load": 0.0, "seconds": 1.0}, None),
        ({"degrees": 0.0, "load": 0.6, "seconds": long, "on": "top"}, "its base off the ground at 0.17 s"),
        ({"degrees": 0.0, "load": 0.4, "seconds": 1.0, "on": "top"}, None),
    ]
    for given, said in cases:
        watch = watched(creature)
        feed_monitor(creature, watch, **given)
        assert watch.fallen == said and watch.is_finished == (said is not None)


@pytest.mark.parametrize(
    ("speeds", "time", "falls"),
    [
        # The capture point is v sqrt(h / g) = 0.226 v ahead, and the half width of the base is 0.25 m.
        ([1.3], 1.1 * LOST_TIME, True),
        ([1.3], 0.9 * LOST_TIME, False),
        ([1.0], 5.0, False),
        ([1.3, 1.0], 1.1 * LOST_TIME, False),
        ([1.0, -1.3], 1.1 * LOST_TIME, True),
    ],
)
def test_a_body_that_ends_outside_its_support_has_fallen(
    creature: CoarseCreature, speeds: list[float], time: float, falls: bool
) -> None:
    """The start of a fall does not end the motion. It is reported if the run ends, unless the body is back over its
    feet."""
    watch, body = watched(creature), creature.place.body
    base = np.flatnonzero(creature.place.standing[:, 2] < 1e-3)
    contacts = SimpleNamespace(nodes=np.repeat(base[:, None], 4, 1), weights=np.full((len(base), 4), 0.25))
    contacts.count = len(base)
    forces = np.tile([body.weight / len(base), 0.0, 0.0], (len(base), 1))
    report = SimpleNamespace(forces=forces, contacts=contacts, min_gap=0.0)
    steps, now = round(time * np.sqrt(body.height / 9.81) / DT), 0.0
    watch.objectives(creature.start, None, DT)
    for speed in speeds:
        velocities = np.tile(speed * FORWARD, (len(creature.start.positions), 1))
        for _ in range(steps):
            now += DT
            watch.objectives(replace(creature.start, velocities=velocities, time=now), cast(Any, report), DT)
    assert watch.fallen is None and not watch.is_finished
    assert (watch.fall_note is not None) == falls
    if falls:
        assert watch.fall_note == f"tipping over, with its capture point outside its feet, at {now:.2f} s"


def test_a_fall_of_a_body_that_could_not_stand_names_the_cause(creature: CoarseCreature) -> None:
    """Without the contact points up to 0.25 m behind it, the centre of mass in the middle of the base is 0.1 m behind
    its support."""
    place = creature.place
    ahead = place.contact_points @ FORWARD
    points = place.contact_points + np.maximum(ahead.mean() + 0.1 - ahead, 0.0)[:, None] * FORWARD
    watch = FallMonitor(
        MotionSequence(place, [MotionTask("stand", {}, cast(Any, Stands))]), replace(place, contact_points=points)
    )
    feed_monitor(creature, watch, degrees=90.0, load=1.0, seconds=1.0)
    assert watch.fallen is not None and watch.fallen.startswith("tilted by 90 degrees at 0.17 s; at the start, its")
    assert watch.fallen.endswith(" its centre of mass was 0.1 body heights outside its support")


def test_a_fallen_body_has_no_objectives(creature: CoarseCreature) -> None:
    watch = watched(creature)
    assert len(watch.objectives(creature.start, None, DT)) == 1
    feed_monitor(creature, watch, degrees=90.0, load=1.0, seconds=1.0)
    assert watch.objectives(creature.start, None, DT) == []


def test_a_body_that_gets_up_is_not_monitored(creature: CoarseCreature) -> None:
    """A motion in which the body falls is marked and replaced by getting up; the monitor reports a fall only if getting
    up fails."""
    sequence = MotionSequence(creature.place, [MotionTask("stand", {}, cast(Any, Stands))])
    watch = FallMonitor(sequence, creature.place, gets_up=True)
    feed_monitor(creature, watch, degrees=90.0, load=1.0, seconds=1.0)
    assert watch.fallen is None and not watch.is_finished
    fell, get_up = sequence.done
    assert fell.fall_note == "tilted by 90 degrees at 0.17 s" and not fell.got_up and get_up.name == "get up"
    assert sequence.time_left(1.0, [5.0]) > 0.0 and sequence.unstarted_note() == []
    get_up.motion.phase = GetUpPhase.GIVEN_UP  # type: ignore[attr-defined]
    watch.objectives(replace(creature.start, time=1.1), cast(Any, SimpleNamespace()), DT)
    assert watch.fallen == fell.fall_note and watch.is_finished


def test_keys_may_tip_the_body(creature: CoarseCreature) -> None:
    key = Key(0.5, "body", Quantity.ORIENTATION, (90.0, 0.0, 0.0))
    for keys, falls in (([key], False), ([replace(key, quantity=Quantity.POSITION, value=(0.1, 0.0, 0.0))], True)):
        watch = watched(creature, lambda place, keys=keys: Follow(place, keys))
        feed_monitor(creature, watch, degrees=90.0, load=1.0, seconds=0.4)
        assert (watch.fallen is not None) == falls


def test_a_body_on_its_side_has_fallen() -> None:
    """In a simulation with weak muscles, a body on its side is reported as fallen; its muscles relax, and the run ends
    after ``REST_FRAMES``."""
    creature = coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD, strength=0.2)
    turn = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()
    positions = creature.start.positions @ turn.T
    start = BodyState(positions - [0.0, 0.0, positions[:, 2].min()], creature.start.velocities)
    watch = FallMonitor(MotionSequence(creature.place, motion("jump").parts(1.0)), creature.place)
    body, muscles = creature.place.body, creature.stepper.muscles
    everywhere = embed_points(body.mesh, body.mesh.nodes, device="cpu")
    geometry = ContactGeometry(body.mesh, (FLOOR,), 0.8, everywhere.tets.numpy(), everywhere.weights.numpy(), 0, 0.0)
    stepper = LocomotionStepper(body, muscles, geometry, device="cpu")
    done = roll_out(stepper, start, watch, frames=60, finished=lambda: watch.is_finished)
    assert watch.fallen is not None and watch.fallen.startswith("tilted by ") and watch.is_finished
    first = round(60.0 * float(watch.fallen.split()[-2]))
    assert len(done.frames) == first + 1 + REST_FRAMES
    asked = np.abs([report.activations for report in done.reports]).max(axis=1)
    assert asked[-1] < 0.75 * asked[first - 1]
