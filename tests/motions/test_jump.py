"""Jumps of a block that is posed by hand: the lean, and the frame of the landing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.objectives import AngularMomentumObjective, Objective
from egs_warp.motions.airborne_soles import BASE_SWING_WEIGHT
from egs_warp.motions.foothold import MAX_FOOTHOLD_OFFSET
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpTarget, damped_motion, stopping_time
from egs_warp.motions.sequence import Stance
from egs_warp.motions.style import Style
from tests.support.meshes import coarse_stool
from tests.support.stances import DT, block_place, moved


def test_the_landing_frame_is_that_of_the_landed_body(place: Stance) -> None:
    """After take-off, local coordinates are relative to the target: a body that stands at the target with the target's
    heading has the local coordinates of the start."""
    target = JumpTarget(0.5, 0.3, 0.1)
    jump = Jump(place, target, turn=0.8)
    start = place.ground.local(place.standing)
    jump.phase = JumpPhase.THRUST
    flying = place.standing + [0.2, 0.0, 0.3]
    jump.objectives(BodyState(flying, np.tile([1.0, 0.0, 2.5], (len(flying), 1)), 0.01), None, DT)
    assert jump.phase is JumpPhase.FLIGHT and jump.is_airborne
    landed = moved(place, 0.8, np.array([0.5, 0.0, 0.1]))
    assert np.allclose(jump.ground.local(landed), start)
    assert jump.controller.measure(BodyState(landed, 0 * landed), None).heading == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("distance", "lean"), [(0.0, 0.0), (0.3, 0.045), (0.5, 0.07)])
def test_the_lean_follows_the_distance_up_to_a_limit(place: Stance, distance: float, lean: float) -> None:
    """The lean is 0.15 of the distance, but at most 0.35 of the 0.2 metres to the front of the feet."""
    assert Jump(place, JumpTarget(distance, 0.3)).plan.lean == pytest.approx(lean)


def test_a_long_jump_begins_with_the_capture_point_at_the_front_of_the_feet(place: Stance) -> None:
    jump = Jump(place, JumpTarget(2.0, 0.3))
    lean, speed = (each[0] for each in jump.plan.crouch(np.zeros(3), jump.plan.crouch_time))
    assert lean + speed * np.sqrt(jump.controller.standing_height / 9.81) == pytest.approx(0.2)


def test_a_jump_is_shortened_to_the_distance_from_which_the_body_can_stop(place: Stance) -> None:
    """The target, the landing frame and the plan are those of the longest jump, and a message says so."""
    jump, farther = (Jump(place, JumpTarget(distance, 0.1)) for distance in (3.0, 5.0))
    reached = jump.target.distance
    assert 0.5 < reached < 2.0 and farther.target.distance == pytest.approx(reached, abs=0.002)
    assert jump.plan.distance == pytest.approx(reached, abs=0.001)
    ahead = jump.landing_controller.ground.origin - jump.take_off_controller.ground.origin
    assert ahead @ place.ground.axes[0] == pytest.approx(reached)
    assert jump.notes()[0].startswith(f"planned {reached / place.body.height:.2f} instead of 3.00 body heights ahead")
    assert not Jump(place, JumpTarget(0.4, 0.1)).notes()


@pytest.mark.parametrize(("mesh", "soles"), [(coarse_stool(), 4), (None, 1)])
def test_soles_swing_ahead_of_a_body_in_the_air(mesh: TetMesh | None, soles: int) -> None:
    """The target velocities of the soles, or of the base of a body without legs, are forward, not sideways."""
    place = block_place(mesh)
    jump = Jump(place, JumpTarget(0.5, 0.3))
    jump.phase = JumpPhase.THRUST
    flying, speed = place.standing + [0.25, 0.0, 0.3], np.array([0.8, 0.0, 0.0])
    asked = jump.objectives(BodyState(flying, np.tile(speed, (len(flying), 1)), 0.01), None, DT)
    swung = [one for one in asked if isinstance(one, Objective) and one.name == "sole velocity"]
    targets = np.concatenate([one.target for one in swung]).reshape(-1, 3)
    assert jump.phase is JumpPhase.FLIGHT and len(targets) == soles
    assert (targets[:, 0] > 0.05).all() and (np.abs(targets[:, 1]) < 0.05).all()


@pytest.mark.parametrize(("mesh", "soles"), [(coarse_stool(), 4), (None, 1)])
def test_soles_are_controlled_until_the_ground_carries_them(mesh: TetMesh | None, soles: int) -> None:
    """A body whose touch-down is predicted too early is still in the air as it lands: its soles go on swinging to their
    places in the last pose of the flight. Once the ground has carried the body, they have no objectives, even if it
    bounces."""
    place = block_place(mesh)
    jump, counts = Jump(place, JumpTarget(0.5, 0.3)), []
    jump.phase, worlds = JumpPhase.FLIGHT, jump._worlds  # pyright: ignore[reportPrivateUsage]
    worlds.off_ground[:] = worlds.is_airborne[:] = True
    for step, (gap, load) in enumerate([(0.02, 0.0), (0.001, 0.0), (0.001, 0.0), (0.0, 1.0), (0.001, 0.0)]):
        falling = np.tile([0.8, 0.0, -1.0], (len(place.standing), 1))
        reduced = jump.controller.reduced(BodyState(place.standing, falling, 0.3 + step * DT), None)
        reduced = replace(reduced, gap=np.asarray(gap), load=load * reduced.load)
        asked = worlds.step(reduced.with_world_axis(), DT).affine
        weights = asked.weights[0, [name == "sole velocity" for name in asked.names]]
        counts.append(np.count_nonzero(weights) // 3)
    assert jump.phase is JumpPhase.LAND and counts == [soles, soles, soles, 0, 0]


def test_an_unstable_landing_has_full_balance_weights() -> None:
    """The balance weights are low if the capture point is near the centre of the feet, and full if it is at their edge.
    They are almost zero in the first step, in which the ground stops the fall."""
    place = block_place()
    weights = []
    for time, speed in ((1.0, 0.0), (1.0, 2.0), (0.0, 2.0)):
        jump = Jump(place, JumpTarget(0.0, 0.3))
        jump.phase = JumpPhase.LAND
        moving = np.tile([speed, 0.0, 0.0], (len(place.standing), 1))
        asked = jump.objectives(BodyState(place.standing, moving, time), None, DT)
        weights.append(next(objective.weight for objective in asked if isinstance(objective, AngularMomentumObjective)))
    assert weights[:2] == pytest.approx([jump.weights.landing * jump.weights.spin, jump.weights.spin])
    assert 0.0 < weights[2] < 0.05 * jump.weights.spin


@pytest.mark.parametrize("steps_per_unit", [8, 19, 40])
@pytest.mark.parametrize("style", [Style(), Style(squash=1.5, bounce=1.3), Style(bounce=0.7)], ids=str)
def test_a_landing_follows_a_damped_oscillator_at_any_step(style: Style, steps_per_unit: int) -> None:
    """A body whose centre of mass has the requested velocity is on the exact solution, which starts when it touches the
    ground with the speed of its fall, also if this is between two steps."""
    place = replace(block_place(), style=style)
    jump, unit = Jump(place, JumpTarget(0.0, 0.3)), place.body.time_unit
    jump.phase = JumpPhase.FLIGHT
    dt, start, fall = unit / steps_per_unit, 0.12, 1.2
    height, speed, contact = start, -fall, (np.sqrt(fall**2 + 2.0 * 9.81 * start) - fall) / 9.81
    speed += 0.5 * 9.81 * dt  # the mean speed of the step before
    for step in range(2 * steps_per_unit):
        moving = np.tile([0.0, 0.0, speed], (len(place.standing), 1))
        reduced = jump.controller.reduced(BodyState(place.standing + [0.0, 0.0, height], moving, step * dt), None)
        in_air = step * dt < contact
        reduced = replace(reduced, gap=np.asarray(max(height, 0.0)), load=reduced.load * (not in_air))
        asked = jump._worlds.step(reduced.with_world_axis(), dt)  # pyright: ignore[reportPrivateUsage]
        speed = float(asked.affine.targets[0, 2])
        height += dt * speed
        time = (step + 1) * dt
        if time < contact:
            continue
        rate, damping = jump.plan.landing_rate, jump.plan.landing_damping
        expected, _ = damped_motion(0.0, -fall - 9.81 * contact, time - contact, rate, damping)
        assert height == pytest.approx(expected, abs=1e-9)
    assert jump.phase in (JumpPhase.LAND, JumpPhase.REST)


@pytest.mark.parametrize(("uphill", "gap", "lands"), [(1.0, 0.009, True), (0.0, 0.009, False), (-1.0, 0.004, False)])
def test_a_body_touches_down_on_a_slope_with_its_speed_along_the_normal(uphill: float, gap: float, lands: bool) -> None:
    """A body that moves forward at 2 m/s and down at 0.2 m/s meets a slope of 10 degrees earlier uphill, and later
    downhill, than level ground. The gap is measured along the normal, too."""
    place, angle = block_place(), np.radians(10.0 * uphill)
    normal = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    jump = Jump(replace(place, ground=replace(place.ground, surface_normal=normal)), JumpTarget(0.0, 0.3))
    jump.phase, worlds = JumpPhase.FLIGHT, jump._worlds  # pyright: ignore[reportPrivateUsage]
    worlds.off_ground[:], velocity = True, np.array([[2.0, 0.0, -0.2]])
    moving = np.tile(velocity, (len(place.standing), 1))
    reduced = jump.controller.reduced(BodyState(place.standing, moving, 0.1), None)
    worlds.step(replace(reduced, gap=np.asarray(gap), load=0.0 * reduced.load).with_world_axis(), DT)
    assert (jump.phase is JumpPhase.LAND) == lands
    time = worlds.current.fall_time(velocity, np.array([gap]))[0]
    assert gap + time * velocity[0] @ normal == pytest.approx(0.5 * 9.81 * normal[2] * time**2)


def test_a_landing_does_not_depend_on_worlds_in_other_phases() -> None:
    """A landing body has the same target speed alone and beside a body in another phase. Its second step uses the speed
    at the end of the first one."""
    place = block_place()
    speeds = []
    for count in (1, 2):
        jumps = [Jump(place, JumpTarget(0.0, 0.3)) for _ in range(count)]
        jumps[0].phase = JumpPhase.LAND
        for time in (0.0, DT):
            falls = [np.tile([0.0, 0.0, speed], (len(place.standing), 1)) for speed in (-1.0, 0.0)[:count]]
            states = [BodyState(place.standing, velocities, time) for velocities in falls]
            Jump.prepare(jumps, states, [None] * count, DT)
        worlds = jumps[0]._worlds  # pyright: ignore[reportPrivateUsage]
        assert worlds.speed_offset[0] > 0.0 and not worlds.speed_offset[1:].any()
        speeds.append(worlds.speed_offset[0])
    assert speeds[0] == speeds[1]


@pytest.mark.parametrize("is_followed", [False, True])
def test_a_jump_that_is_followed_ends_when_the_body_is_balanced(is_followed: bool) -> None:
    """It ends at the earliest 0.3 sqrt(H / g) after the touch-down, and while the body still sinks; a body that would
    fall forward is balanced first."""
    place = block_place()
    jump, unit = Jump(place, JumpTarget(0.0, 0.3), is_followed=is_followed), place.body.time_unit
    jump.phase = JumpPhase.LAND
    ended = []
    for time, speed in ((0.2, 0.0), (0.4, 3.0), (0.5, 0.0)):
        moving = np.tile([speed, 0.0, -0.2], (len(place.standing), 1))
        jump.objectives(BodyState(place.standing, moving, time * unit), None, DT)
        ended.append(jump.is_at_rest)
    assert ended == [False, False, is_followed]


def test_a_crouch_begins_with_the_measured_motion() -> None:
    """A body that is 0.05 m below its standing height and sinks is not asked to rise first."""
    place = block_place()
    jump = Jump(place, JumpTarget(0.0, 0.3))
    low, sinking = place.standing - [0.0, 0.0, 0.05], np.tile([0.0, 0.0, -0.2], (len(place.standing), 1))
    reduced = jump.controller.reduced(BodyState(low, sinking, 5.0), None).with_world_axis()
    asked = jump._worlds.step(reduced, DT)  # pyright: ignore[reportPrivateUsage]
    assert jump.phase is JumpPhase.CROUCH
    assert asked.affine.targets[0, 2] == pytest.approx(-0.2, abs=0.05)


@pytest.mark.parametrize(("moved_ahead", "speed"), [(0.0, 0.0), (0.03, 0.6)])
def test_a_crouch_bends_as_far_as_the_motion_leads(moved_ahead: float, speed: float) -> None:
    """The lean of the pose is that of the measured centre of mass at the end of the step, but at most the planned one,
    which would rotate a body that does not have it. The height is the planned one."""
    place = block_place()
    jump, moving = Jump(place, JumpTarget(0.5, 0.3)), np.tile([speed, 0.0, 0.0], (len(place.standing), 1))
    plan, balance, worlds = jump.plan, jump.controller.balance, jump._worlds  # pyright: ignore[reportPrivateUsage]
    jump.phase = JumpPhase.CROUCH
    time = 0.3 * place.body.time_unit  # the blend from the pose before is over
    ahead, _, rise = plan.crouch(np.zeros(3), time)[0]
    reduced = jump.controller.reduced(BodyState(place.standing + [moved_ahead, 0.0, 0.0], moving, time - DT), None)
    worlds.step(replace(reduced, load=np.asarray(1.0)).with_world_axis(), DT)
    assert jump.phase is JumpPhase.CROUCH
    stretch, lean = 1.0 + rise / balance.standing_height, min(moved_ahead + DT * speed, ahead) / balance.standing_height
    stretches = np.diag([stretch**-0.25, stretch**-0.25, stretch])
    pose = balance.axes @ worlds.last_pose[0] @ balance.axes.T
    assert pose == pytest.approx(stretches + lean * jump.controller.bending[0], abs=1e-6)


def test_the_pose_in_the_air_is_blended_in() -> None:
    """The weight of the sole velocities is almost zero in the first step in the air and full 0.6 sqrt(H / g) later."""
    place = block_place()
    jump = Jump(place, JumpTarget(0.5, 0.3))
    jump.phase = JumpPhase.THRUST
    flying, speed = place.standing + [0.25, 0.0, 0.3], np.array([0.8, 0.0, 0.0])
    weights = []
    for time in (0.0, 0.6 * place.body.time_unit):
        asked = jump.objectives(BodyState(flying, np.tile(speed, (len(flying), 1)), time), None, DT)
        swung = [one for one in asked if isinstance(one, Objective) and one.name == "sole velocity"]
        weights.append(swung[0].weight)
    assert jump.phase is JumpPhase.FLIGHT
    assert 0.0 < weights[0] < 0.05 * BASE_SWING_WEIGHT and weights[1] == BASE_SWING_WEIGHT


@pytest.mark.parametrize(("com_speed", "flat"), [(1.0, True), (-0.25, False), (-1.0, True)])
def test_a_body_moving_towards_its_feet_keeps_its_soles_flat(com_speed: float, flat: bool) -> None:
    """A body sheared backwards over a flat sole has a mean rotation of half the shear. If it moves towards its feet, no
    rotation is requested, because the sole would tilt up. If it falls backwards, it is rotated upright, unless it falls
    so fast that stopping it needs the whole capacity of the feet."""
    place = block_place()
    height = place.standing[:, 2:] - place.standing[:, 2].min()
    sheared = place.standing + 0.1 * height / height.max() * [-1.0, 0.0, 0.0]
    jump = Jump(place, JumpTarget(0.0, 0.3))
    jump.phase = JumpPhase.LAND
    moving = np.tile([0.4 * com_speed, 0.0, 0.0], (len(sheared), 1))
    asked = jump.objectives(BodyState(sheared, moving, 1.0), None, DT)
    spin = next(objective for objective in asked if isinstance(objective, AngularMomentumObjective))
    rate = np.linalg.solve(place.body.inertia(sheared), spin.target)
    assert abs(rate[1]) < 0.03 if flat else rate[1] > 0.1, rate


@pytest.mark.parametrize(("toes", "fraction"), [(0.05, 0.0), (0.2, MAX_FOOTHOLD_OFFSET)])
def test_feet_are_placed_ahead_so_that_the_body_stops(toes: float, fraction: float) -> None:
    """If the target is too near for the body to stop, the capture point is ahead of the middle of the feet by a
    fraction ``MAX_FOOTHOLD_OFFSET`` of their forward reach, whatever their backward reach. If the forward reach is
    short, it is at the middle."""
    place = block_place()
    touching = place.contact_points[place.contact_points[:, 0] < toes + 1e-9]
    place = replace(place, contact_points=np.vstack([touching, [toes, 0.0, 0.0]]))
    jump, speed = Jump(place, JumpTarget(0.0, 0.3)), 1.0
    jump.phase = JumpPhase.THRUST
    state = BodyState(place.standing + [0.0, 0.0, 0.3], np.tile([speed, 0.0, -1.0], (len(place.standing), 1)), 0.01)
    jump.objectives(state, None, DT)
    assert jump.phase is JumpPhase.FLIGHT
    reduced = jump.controller.reduced(state, None).with_world_axis()
    seen = jump.controller.balance.with_world_axis().measure(reduced)
    down = np.array([0.1, 0.0, jump.controller.standing_height])
    left = 0.1
    stop = stopping_time(jump.controller.standing_height, left * 9.81 + 1.0, 9.81)
    (placed,) = jump._worlds.foothold(reduced, seen, down[None], np.array([left]))  # pyright: ignore[reportPrivateUsage]
    ahead = down[0] + stop * speed + jump.controller.base_offset[0] - placed[0]
    assert ahead == pytest.approx(fraction * toes, abs=1e-12)
