"""Walks of coarse bodies on four feet, on two feet and on one base: their plans, and an audit of every step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io import read_capture
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory, measure
from egs_warp.motions.footfalls import Footfalls
from egs_warp.motions.route import Route, path_route, straight_route, turn_route
from egs_warp.motions.script import motion
from egs_warp.motions.support import SupportPolygon
from egs_warp.motions.walk import MAX_LEAD, MIN_REAR_MARGIN, Walk
from egs_warp.motions.walk_plan import WalkPhase
from egs_warp.motions.walk_posture import LeggedPosture
from egs_warp.pipelines.creature import make_creature
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.segmentation.base_plane import find_base_plane
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import UP, block_mesh, carved, coarse_stool, figure, stool
from tests.support.stances import DT, block_place

AHEAD = np.array([1.0, 0.0, 0.0])


def biped() -> TetMesh:
    """Create a slab on two legs with feet, 0.7 m high."""

    def keep(c: np.ndarray) -> np.ndarray:
        leg = (np.abs(np.abs(c[:, 1]) - 0.15) < 0.1) & (np.abs(c[:, 0]) < 0.1)
        foot = (np.abs(np.abs(c[:, 1]) - 0.15) < 0.1) & (c[:, 2] < 0.1)
        return leg | foot | (c[:, 2] > 0.4)

    return carved((0.4, 0.5, 0.7), 0.1, keep)


@dataclass(frozen=True)
class Walked:
    """Result of a walk."""

    creature: CoarseCreature
    walk: Walk
    trajectory: Trajectory
    fell: Footfalls
    air: float
    """Largest height of the lowest node of a swinging sole, m."""
    unconverged: int


def walked(creature: CoarseCreature, route: Route, pace_length: float, *, speed: float = 1.0) -> Walked:
    """Simulate a walk until the body rests, at most 300 solver steps."""
    stepper, state = creature.stepper, creature.start
    walk = Walk(creature.place, route, pace_length, speed=speed)
    reports: list[StepReport] = []
    memory, air = stepper.initial_memory(), 0.0
    for _ in range(300):
        wishes = walk.objectives(state, reports[-1] if reports else None, DT)
        state, memory, fresh = stepper.advance(state, memory, wishes, DT)
        reports += fresh
        for index in walk.swinging:
            air = max(air, float(state.positions[walk.feet[index].sole, 2].min()))
        if walk.is_at_rest:
            break
    assert walk.is_at_rest and walk.notes() == walk._gait_notes
    recorder = Recorder(stepper.body, stepper.muscles, stepper.geometry, creature.start, 0.0, drag=0.0)
    recorder.add(reports)
    trajectory = recorder.trajectory()
    unconverged = sum(not report.converged for report in reports)
    return Walked(creature, walk, trajectory, walk.outcome_record(trajectory, 0, -1), air, unconverged)


def check_audit(done: Walked) -> None:
    found = audit(done.trajectory, newton_unconverged=done.unconverged)
    assert found.momentum_residual < 1e-5 and found.angular_momentum_residual < 1e-4 and found.penetration < 0.01
    assert found.cone_violation < 1e-4 and found.complementarity_gap < 1e-4 and found.inverted_elements == 0
    assert found.energy_residual < 1e-6 and found.contact_velocity < 1e-6


def strong(mesh: TetMesh, up: np.ndarray = UP) -> CoarseCreature:
    """Return a creature with the stiffness and strength of captures."""
    return coarse_creature(mesh, forward=AHEAD, up=up, sag=DEFAULT_SAG)


@pytest.mark.slow
@pytest.mark.parametrize(("slope", "landings"), [(0.0, 4), (5.0, 5)])
def test_a_coarse_stool_takes_a_step(slope: float, landings: int) -> None:
    """The stool makes one step and the closing step, on level ground or up a slope. Each foot lands once, except that
    on the slope one of them lands twice. The slip is less than 2 % of the stride, the distance is reached, and the
    audit holds."""
    tilt = np.radians(slope)
    done = walked(strong(coarse_stool(), np.array([np.sin(tilt), 0.0, np.cos(tilt)])), straight_route(0.06), 0.06)
    reached = measure(done.trajectory)
    assert done.fell.landings == landings and done.fell.slip < 0.02 and done.fell.sole_shift < 0.05
    assert done.air > 0.3 * done.walk.gait.lift
    assert reached.distance * done.creature.place.body.height == pytest.approx(0.06, rel=0.1)
    assert reached.tilt_degrees < 3.0 and abs(reached.heading_degrees) < 3.0 and reached.airborne_frames == 0.0
    check_audit(done)


@pytest.mark.slow
@pytest.mark.parametrize("route", [straight_route(0.12), turn_route(np.radians(20.0))], ids=["ahead", "turn"])
def test_a_biped_keeps_its_balance(route: Route) -> None:
    """The biped makes two steps ahead, or turns on the spot, and reaches its target upright."""
    done = walked(strong(biped()), route, 0.06)
    assert isinstance(done.walk._posture, LeggedPosture) and len(done.walk.feet) == 2
    reached, place = measure(done.trajectory), done.walk.planar_poses[-1]
    assert reached.distance * done.creature.place.body.height == pytest.approx(place[0], abs=0.012)
    assert reached.heading_degrees == pytest.approx(np.degrees(place[2]), abs=3.0) and reached.tilt_degrees < 4.0
    check_audit(done)


@pytest.mark.slow
@pytest.mark.parametrize("route", [straight_route(0.04), pytest.param(turn_route(0.2), marks=pytest.mark.slow)])
def test_a_block_waddles(route: Route) -> None:
    """The block alternately lifts one side of its base and turns about the other, and reaches its target upright."""
    done = walked(strong(block_mesh()), route, 0.04)
    body, reached, place = done.creature.place.body, measure(done.trajectory), done.walk.planar_poses[-1]
    assert reached.distance * body.height == pytest.approx(place[0], abs=0.2 * 0.04)
    assert reached.heading_degrees == pytest.approx(np.degrees(place[2]), abs=3.0) and reached.tilt_degrees < 3.0
    assert done.air > 0.0 and done.fell.landings >= 2
    check_audit(done)


@pytest.mark.slow
@pytest.mark.data
def test_a_long_base_does_not_outrun_the_body(data_dir: Path) -> None:
    """The base of the monkey is long. The body still reaches its target, because its lag behind the feet does not grow
    with each step."""
    cloud = read_capture(data_dir / "objects" / "monkey.ply").cloud
    plane = find_base_plane(cloud, up=np.array([0.0, 1.0, 0.0]))
    done = simulate(make_creature(cloud, plane=plane), motion("walk 0.4"), get_up=False)
    reached = measure(done.trajectory)
    assert done.fallen is None and reached.tilt_degrees < 6.0
    assert reached.distance == pytest.approx(0.4, abs=0.04)


def test_a_step_lost_to_slipping_is_repeated() -> None:
    """If the feet are at their footholds, the walk continues. If they lag by half a step or more, the step is repeated,
    with one message, and the route ends at the same place."""
    place = coarse_creature(block_mesh(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, straight_route(0.12), 0.04)
    standing, before, paces = place.ground.local(place.standing), walk.planar_poses.copy(), walk.gait.step_count
    walk._arrived_footholds = [1, 1]
    pace = before[1, 0]
    assert walk._mean_lag(standing + [pace, 0.0, 0.0]) == pytest.approx(0.0, abs=1e-9)
    assert walk._mean_lag(standing) == pytest.approx(1.0)
    walk._plan_swing(1, standing + [0.8 * pace, 0.0, 0.0])
    assert np.array_equal(walk.planar_poses, before) and walk.notes() == walk._gait_notes
    walk._plan_swing(1, standing + [0.2 * pace, 0.0, 0.0])
    assert walk.gait.step_count == paces + 1 and np.array_equal(np.delete(walk.planar_poses, 2, axis=0), before)
    assert np.array_equal(walk.planar_poses[2], before[1]) and "1 step" in walk.notes()[-1]


@pytest.mark.parametrize("length", [0.012, 0.004])
@pytest.mark.parametrize(("lag", "repeats"), [(0.4, 0), (0.6, 1)])
def test_a_step_is_repeated_if_the_capture_point_lags(lag: float, repeats: int, length: float) -> None:
    """A short step is repeated if the capture point lags by more than half of what the centre of pressure can
    correct: it is in the middle of the standing side, and may move to 0.8 of the distance to its rear edge. The lag is
    measured along the direction of travel; an error across it does not count."""
    place = coarse_creature(block_mesh(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, straight_route(3.0 * length), length)
    walk.gait = replace(walk.gait, step_count=3)
    walk.planar_poses = np.array([[step * length, 0.0, 0.0] for step in range(4)])
    walk.swing, walk.phase = 0, WalkPhase.STAND
    (stands,) = {0, 1} - set(walk.gait.swing_feet(1))
    rear = -0.8 * float(np.ptp(walk._planner.grips[stands][:, 0])) / 2.0
    correctable = -rear * (1.0 - np.exp(-walk._rate * walk.gait.swing_time))
    walk._capture_error = np.array([-lag * correctable, -0.2])
    standing = place.ground.local(place.standing)
    walk._arrived_footholds = [0, 0]
    walk._plan_swing(1, standing)
    assert walk._repeated_steps == repeats and walk.gait.step_count == 3 + repeats


def test_the_plan_respects_the_limits_of_the_legs() -> None:
    place = coarse_creature(stool(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, straight_route(0.24), 0.08)
    planned = walk.plan_record()
    assert planned.paces == 3.0 and planned.pace_length == pytest.approx(0.08)
    assert planned.stride == pytest.approx(0.16) and walk.notes() == []
    fast = Walk(place, straight_route(0.24), 0.08, speed=1.5).plan_record()
    assert fast.swing_time == pytest.approx(planned.swing_time / 1.5)
    strides_out = Walk(place, straight_route(1.6), 0.8)
    assert strides_out.plan_record().pace_length <= 0.5 * min(foot.length for foot in strides_out.feet)
    assert strides_out.notes()[0].startswith(
        "steps of 1.00 body heights are too long for the body; it can make steps of 0.3"
    )
    assert Walk(place, straight_route(1.6), np.inf).notes() == [], "a run makes the longest steps"
    turned = Walk(place, turn_route(0.5), 0.08).plan_record()
    far = max(np.linalg.norm(place.ground.local(place.standing)[f.sole, :2].mean(axis=0)) for f in place.feet())
    assert turned.stride == pytest.approx(2.0 * 2.0 * np.sin(0.125) * far, rel=0.05) and turned.paces == 2.0


def test_footholds_rotate_with_the_body() -> None:
    """The footholds equal the soles of the whole standing body, rotated to each planar pose of the route about its
    initial centre of mass."""
    place = coarse_creature(stool(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, path_route(np.array([[0.2, 0.3]])), 0.1)
    standing, com = place.ground.local(place.standing), place.body.centre_of_mass(place.ground.local(place.standing))
    for x, y, heading in walk.planar_poses:
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        moved = (standing[:, :2] - com[:2]) @ turn.T + com[:2] + [x, y]
        for index, foot in enumerate(walk.feet):
            home = walk._planner.nominal_foothold(np.array([x, y, heading]), index)
            assert home[:2] == pytest.approx(moved[foot.sole].mean(axis=0), abs=1e-12) and home[3] == heading


@pytest.mark.parametrize("mesh", [stool, figure, biped, block_mesh])
def test_the_planned_pressure_is_under_the_standing_feet(mesh: Callable[[], TetMesh]) -> None:
    """The centre of pressure of the first swing lies within the support polygon of the feet that stand during it, and
    the planned divergent component is bounded."""
    place = coarse_creature(mesh(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, straight_route(0.3), 0.06)
    walk._advance_phase(place.ground.local(place.standing), None, 0.0)
    plan = walk._plan
    swing = plan.pressure[round(walk._duration(walk.phase) / plan.step)]
    lifted = walk.gait.swing_feet(0)
    stands = [index for index in range(len(walk.feet)) if index not in lifted]
    assert stands and len(stands) < len(walk.feet)
    under = SupportPolygon.hull(
        np.concatenate([walk._planner.soles[index, :2] + walk._planner.grips[index] for index in stands])
    )
    assert under.margin(swing) >= -1e-9
    if len(lifted) == 1:  # of four feet, those that swing and those that stand are on crossing diagonals
        other = walk._planner.soles[lifted[0], :2] + walk._planner.grips[lifted[0]]
        assert SupportPolygon.hull(other).margin(swing) < 0.0
    reach = 0.3 + np.ptp(place.standing[:, :2], axis=0)
    assert np.all(np.abs(plan.divergent - walk._start_com[:2]) < reach)


def test_a_narrow_body_leans_in_the_direction_of_travel() -> None:
    """The body is shifted ahead so that the rear edge of the support has a minimum distance from the centre of mass.
    The shift is along the heading, which is to the left here. It is zero for a wide support, and it is undone at the
    end."""
    place = block_place(biped())
    com = place.body.centre_of_mass(place.ground.local(place.standing))
    narrow = replace(place, contact_points=0.35 * place.contact_points)
    walk, wide = Walk(narrow, path_route(np.array([[0.0, 0.3]])), 0.06), Walk(place, straight_route(0.3), 0.06)
    last = walk.gait.step_count
    missing = MIN_REAR_MARGIN * com[2] - float((com[0] - narrow.ground.local(narrow.contact_points)[:, 0]).max())
    assert 0.0 < missing < MAX_LEAD * place.body.height
    np.testing.assert_allclose(walk._lead_at(last - 1.5), [0.0, missing], atol=1e-6)
    np.testing.assert_allclose(walk._lead_at(float(last)), [0.0, 0.5 * missing], atol=1e-6)
    walk.phase = WalkPhase.GATHER
    ((_, gathered),) = walk._pressures(0.05)
    np.testing.assert_allclose(gathered[-1], walk._com_at(float(last)))
    np.testing.assert_allclose(wide._lead_at(2.0), 0.0)


def test_a_crouch_begins_and_ends_while_all_feet_stand() -> None:
    """The body crouches while the weight shifts, stays crouched during the steps, and rises while the feet close."""
    place = coarse_creature(stool(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, straight_route(0.1), 0.1, crouch=0.8)
    standing = float(place.body.centre_of_mass(place.ground.local(place.standing))[2])
    heights = {}
    for phase in WalkPhase:
        walk.phase = phase
        heights[phase] = [walk._height(share * walk._duration(phase)) / standing for share in (0.0, 0.5, 1.0)]
    assert np.allclose(heights[WalkPhase.SHIFT], [1.0, 0.9, 0.8]) and np.allclose(heights[WalkPhase.SWING], 0.8)
    assert np.allclose(heights[WalkPhase.STAND], 0.8) and np.allclose(heights[WalkPhase.GATHER], [0.8, 0.9, 1.0])
    assert heights[WalkPhase.REST] == [1.0, 1.0, 1.0]


def test_headings_of_feet_are_unwrapped() -> None:
    """A measured heading is unwrapped to the value nearest to the planned one."""
    place = coarse_creature(stool(), forward=AHEAD, settle_first=False).place
    walk = Walk(place, turn_route(np.radians(420.0)), 0.08)
    walk.swing = walk.gait.swings - 1
    local = place.ground.local(place.standing)
    com = place.body.centre_of_mass(local)
    turn = np.eye(3)
    turn[:2, :2] = [[0.5, -np.sqrt(0.75)], [np.sqrt(0.75), 0.5]]
    walk._has_landed(0, com + (local - com) @ turn.T)
    assert walk._footprints[0, 3] == pytest.approx(np.radians(420.0))


def test_a_base_on_ice_cannot_turn() -> None:
    place = replace(coarse_creature(block_mesh(), forward=AHEAD, settle_first=False).place, friction=0.001)
    with pytest.raises(UserError, match=r"walk: friction 0\.001 cannot turn the body about a side of its base"):
        Walk(place, straight_route(0.2), 0.1)


def test_missing_feet_and_obstacles_are_reported() -> None:
    bar = block_mesh(12, 3, 3, (2.0, 0.3, 0.3))
    with pytest.raises(
        UserError, match="walk: the body has neither feet nor a flat base with a side that it could lift"
    ):
        Walk(block_place(bar), straight_route(0.2), 0.1)
    place = coarse_creature(stool(), forward=AHEAD, settle_first=False).place
    wall = Solid(
        tuple(
            Plane(np.array(normal, float), offset)
            for normal, offset in (
                ((1, 0, 0), -1.2), ((-1, 0, 0), 0.8), ((0, 1, 0), -2.0), ((0, -1, 0), -2.0), ((0, 0, 1), -0.3)
            )
        )
    )  # fmt: skip
    walled = replace(place, solids=(*place.solids, wall))
    Walk(walled, straight_route(0.5), 0.1)
    with pytest.raises(
        UserError, match=r"the path leads over a step, .* ahead and 0.00 to the left: .* higher; walk around"
    ):
        Walk(walled, straight_route(1.2), 0.1)
