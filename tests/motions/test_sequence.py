"""Motions in a row, and leaps to a place, on a block that is posed by hand:
geometry and bookkeeping without a simulation.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid, step
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState, make_body
from egs_warp.geometry.plane import Plane
from egs_warp.motions.hop import Hop, Squares
from egs_warp.motions.jump import JumpPhase, JumpTarget
from egs_warp.motions.leap import Leap
from egs_warp.motions.repertoire import check_possible, longest, parts_of
from egs_warp.motions.script import parse_script
from egs_warp.motions.sequence import MotionSequence, Part, Place
from egs_warp.motions.stance import Ground, sole_shares
from egs_warp.motions.turn import Turn
from egs_warp.motions.twist import Twist
from tests.support.meshes import block_mesh

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
FORWARD = np.array([1.0, 0.0, 0.0])
DT = 1 / 60


@pytest.fixture
def place() -> Place:
    mesh = block_mesh()
    body = make_body(mesh, FLOOR, device="cpu")
    standing = mesh.nodes - [0.0, 0.0, mesh.nodes[:, 2].min()]
    ground = Ground.on(FLOOR, FORWARD, body.centre_of_mass(standing))
    return Place(body, ground, standing, standing[standing[:, 2] < 1e-9], DT, (Solid((FLOOR,)),))


def moved(place: Place, angle: float, shift: np.ndarray) -> np.ndarray:
    com = place.body.centre_of_mass(place.standing)
    return com + (place.standing - com) @ place.ground.turn(angle).T + shift


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5, np.pi])
def test_a_place_follows_the_feet(place: Place, angle: float) -> None:
    """Turned and moved, to another level too, the stance is the body's own again and forward turns with it."""
    shift = np.array([0.4, -1.2, 0.25])
    now = place.now(moved(place, angle, shift))
    assert np.abs(now.standing - moved(place, angle, shift)).max() < 1e-12
    assert np.allclose(now.ground.axes[0], [np.cos(angle), np.sin(angle), 0.0])
    assert np.allclose(now.ground.local(now.standing), place.ground.local(place.standing))
    leaning = moved(place, angle, shift)
    leaning[:, 0] += 0.3 * (leaning[:, 2] - leaning[:, 2].min())
    feet = place.now(leaning).standing
    assert np.ptp(feet[:, 2]) == pytest.approx(np.ptp(place.standing[:, 2]))


def test_facing_turns_the_way_and_not_the_body(place: Place) -> None:
    other = place.facing(np.array([0.0, 2.0, 5.0]))
    assert np.allclose(other.ground.axes, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert other.standing is place.standing


class Phase(Enum):
    GO = "go"
    REST = "rest"


class Waits:
    """Rests after three steps."""

    def __init__(self, place: Place) -> None:
        self.place, self.phase, self.steps = place, Phase.GO, 0

    def objectives(self, state, report, dt):
        self.steps += 1
        self.phase = Phase.REST if self.steps >= 3 else Phase.GO
        return []

    def planned(self) -> dict[str, float]:
        return {}

    def notes(self) -> list[str]:
        return []


def test_motions_follow_each_other_from_where_the_body_is(place: Place) -> None:
    sequence = MotionSequence(place, [Part("a", {}, Waits), Part("b", {}, Waits)])
    times = [0.0]
    for k in range(8):
        assert sequence.finished == (k >= 6)
        positions = moved(place, 0.1 * k, np.array([0.1 * k, 0.0, 0.0]))
        sequence.objectives(BodyState(positions, 0 * positions, times[-1]), None, DT)
        times.append(times[-1] + DT)
    first, second = sequence.done
    assert first.motion.place is place
    assert np.allclose(second.motion.place.ground.axes[0], [np.cos(0.3), np.sin(0.3), 0.0])
    assert sequence.spans(np.array(times)) == [(0, 3), (3, 8)]


def test_what_the_last_frame_cut_off_is_told(place: Place) -> None:
    sequence = MotionSequence(place, [Part("a", {}, Waits), Part("b", {}, Waits), Part("c", {}, Waits)])
    positions = moved(place, 0.0, np.zeros(3))
    told = []
    for k in range(9):
        sequence.objectives(BodyState(positions, 0 * positions, k * DT), None, DT)
        told.append(sequence.cut_short())
    assert told[3] == [
        "b was cut off before it came to rest; give more --frames",
        "1 of 3 motions did not begin: c",
    ]
    assert told[2] == ["2 of 3 motions did not begin: b, c"]
    assert told[8] == []


def test_a_motion_that_cannot_be_is_refused_before_the_first(place: Place) -> None:
    parts = parts_of(parse_script("hop x2, jump, walk"), place.body.height)
    with pytest.raises(UserError, match="walk: a walk needs four separate feet"):
        check_possible(parts, place)
    check_possible(parts[:-1], place)


def test_a_script_becomes_parts(place: Place) -> None:
    requests = parse_script("hop 0.6 x3, twist 90, jump x2")
    parts = parts_of(requests, place.body.height)
    assert [part.name for part in parts] == ["hop", "hop", "hop", "twist", "jump", "jump"]
    assert [part.asked.get("square") for part in parts[:3]] == [1.0, 2.0, 3.0]
    turn = parts[3].begin(place)
    assert isinstance(turn, Turn) and turn.jumps[0].turn == pytest.approx(np.pi / 2)
    jump = parts[4].begin(place)
    assert isinstance(jump, Leap) and jump.target.distance == pytest.approx(0.5 * place.body.height)
    assert longest(requests) == 3 * longest(parse_script("hop")) + longest(parse_script("twist, jump x2"))


def test_hops_aim_at_squares_from_where_the_feet_are(place: Place) -> None:
    """A hop that fell short and went aside is made up by the next; a square on a step is jumped up to."""
    height = place.body.height
    row = Squares(0.7, 0.2, 3, {"distance": 0.7})
    begin = [part.begin for part in row.parts()]
    first = begin[0](place)
    assert isinstance(first, Hop) and first.target.distance == pytest.approx(0.7)
    feet = sole_shares(place.body, place.ground, place.standing) @ place.standing
    assert np.allclose(first.square, feet + [0.7, 0.0, 0.0])
    again = begin[1](place.now(moved(place, 0.0, np.array([0.6, 0.1, 0.0]))))
    assert isinstance(again, Hop) and again.target.distance == pytest.approx(np.hypot(0.8, 0.1))
    assert np.allclose(again.ground.axes[0] * np.hypot(0.8, 0.1), [0.8, -0.1, 0.0])
    assert again.miss(moved(place, 0.0, np.array([1.43, 0.04, 0.2]))) == pytest.approx(0.05)

    stair = step(FLOOR, np.array([0.4, 0.0, 0.0]), FORWARD, 0.2 * height)
    stairs = Place(place.body, place.ground, place.standing, place.touching, DT, (Solid((FLOOR,)), stair))
    up = Squares(0.7, 0.2, 1, {}).parts()[0].begin(stairs)
    assert isinstance(up, Hop) and up.target.rise == pytest.approx(0.2 * height)
    assert up.target.height == pytest.approx(0.2 + 0.2 * height)
    assert up.plan.flight_time < first.plan.flight_time + np.sqrt(2 * 0.2 * height / 9.81)
    assert up.plan.speed_up > first.plan.speed_up


def test_a_landing_frame_holds_the_landed_body(place: Place) -> None:
    """From take-off on, a body that stands turned at the target has the coordinates of the start."""
    target = JumpTarget(0.5, 0.3, 0.1)
    leap = Leap(place, target, turn=0.8)
    start = place.ground.local(place.standing)
    leap.phase = JumpPhase.THRUST
    flying = place.standing + [0.2, 0.0, 0.3]
    leap.objectives(BodyState(flying, np.tile([1.0, 0.0, 2.5], (len(flying), 1)), 0.01), None, DT)
    assert leap.phase is JumpPhase.FLIGHT and leap.left_ground
    landed = moved(place, 0.8, np.array([0.5, 0.0, 0.1]))
    assert np.allclose(leap.ground.local(landed), start)
    assert leap.pose.measure(BodyState(landed, 0 * landed), None).heading == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("turn", [np.pi, -np.pi, 3.0 * np.pi])
def test_a_twist_asks_friction_for_the_spin_that_is_left(place: Place, turn: float) -> None:
    """In the thrust: up x L = I (angle left) / (time in the air) with a reserve;
    its own turning is counted beyond half turns.
    """
    twist = Twist(place, JumpTarget(0.0, 0.2), turn)
    twist.phase = JumpPhase.THRUST
    still = np.zeros_like(place.standing)
    inertia = float(place.body.inertia(place.standing)[2, 2])
    asked = []
    for angle in np.sign(turn) * np.array([0.0, 0.3, 0.6]):
        report = twist.objectives(BodyState(moved(place, float(angle), np.zeros(3)), still, 0.0), None, DT)
        asked.append(report[1].target[2] / inertia)
    flight = 0.88 * twist.plan.flight_time / 1.27
    left = abs(turn) - np.radians(5.0) - np.array([0.0, 0.3, 0.6])
    assert np.allclose(np.abs(asked), left / flight, rtol=1e-2) and np.all(np.sign(asked) == np.sign(turn))
    for angle in np.linspace(0.6, abs(turn), 12) * np.sign(turn):
        twist.objectives(BodyState(moved(place, float(angle), np.zeros(3)), still, 0.0), None, DT)
    assert twist._turned == pytest.approx(turn)


def land(jump: Leap, state: BodyState) -> None:
    """Put a jump where it has landed and come to rest but for the last step."""
    jump.phase, jump._entered = JumpPhase.LAND, -100.0
    jump.pose, jump.ground = jump._landing_pose, jump._landing


def test_a_turn_that_falls_short_is_made_up_where_it_began(place: Place) -> None:
    """25 degrees short and 0.1 aside: the next jump turns by the rest and goes back; 5 degrees short is let be."""
    turn = Turn(place, JumpTarget(0.0, 0.2), np.radians(60.0))
    short = moved(place, np.radians(35.0), np.array([0.1, 0.0, 0.0]))
    state = BodyState(short, 0 * short, 10.0)
    land(turn.jumps[0], state)
    turn.objectives(state, None, DT)
    assert len(turn.jumps) == 2
    second = turn.jumps[1]
    assert np.degrees(second.turn) == pytest.approx(25.0) and second.target.distance == pytest.approx(0.1)
    assert np.allclose(second.ground.axes[0], [-1.0, 0.0, 0.0])
    assert turn.notes() == ["turned in 2 jumps"] and turn.planned()["jumps"] == 2.0
    there = moved(place, np.radians(55.0), np.zeros(3))
    land(second, BodyState(there, 0 * there, 20.0))
    turn.objectives(BodyState(there, 0 * there, 20.0), None, DT)
    assert len(turn.jumps) == 2 and turn.phase is JumpPhase.REST


def test_a_slippery_floor_takes_more_jumps(place: Place) -> None:
    """The largest turn is proportional to friction; a turn beyond it is shared out evenly."""
    target = JumpTarget(0.0, 0.2)
    rough, smooth = (Turn(replace(place, friction=mu), target, np.pi) for mu in (0.8, 0.2))
    assert smooth.most_in_a_jump == pytest.approx(rough.most_in_a_jump / 4.0)
    count = np.ceil(np.pi / smooth.most_in_a_jump)
    assert count >= 2.0 and smooth.jumps[0].turn == pytest.approx(np.pi / count)
    landed = moved(place, smooth.jumps[0].turn, np.zeros(3))
    state = BodyState(landed, 0 * landed, 10.0)
    land(smooth.jumps[0], state)
    smooth.objectives(state, None, DT)
    assert smooth.jumps[1].turn == pytest.approx(np.pi / count)
    assert smooth.notes()[0] == f"friction gives a turn of {np.degrees(smooth.most_in_a_jump):.0f} degrees a jump"
