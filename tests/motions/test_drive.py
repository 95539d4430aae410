"""Walks under commands: the route is extended during the walk, no step exceeds its limits, and a zero command ends in a
stance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egs_warp.errors import ArgumentError, UserError
from egs_warp.fem.body import DEFAULT_SAG
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.command import Drive, DrivePlan, read_drive
from egs_warp.motions.drive import DrivenWalk, LiveDrive, ScriptedDrive, integrate_command
from egs_warp.motions.route import StepLimits
from egs_warp.motions.stand import Stand
from egs_warp.motions.walk_plan import WalkPhase
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import ball_mesh, coarse_stool, worm_mesh
from tests.support.stances import DT, FORWARD

PACE = StepLimits(0.2, 0.25, side_fraction=0.5)
_SPEED = st.floats(-2.0, 2.0)


@cache
def stool() -> CoarseCreature:
    return coarse_creature(coarse_stool(), forward=FORWARD, sag=DEFAULT_SAG)


@given(_SPEED, _SPEED, _SPEED, st.floats(0.01, 3.0))
def test_no_step_exceeds_its_limits(forward: float, sideways: float, turn: float, time: float) -> None:
    """A command is scaled to the limits of a step without changing the ratio of its components."""
    command, start = Drive(forward, sideways, turn), np.array([0.3, -0.2, 0.7])
    change = integrate_command(start, command, time, PACE, unit=0.5, height=0.8) - start
    middle = start[2] + 0.5 * change[2]
    ahead = np.cos(middle) * change[0] + np.sin(middle) * change[1]
    left = np.cos(middle) * change[1] - np.sin(middle) * change[0]
    effort = np.hypot(ahead, left / PACE.side_fraction) / PACE.length + abs(change[2]) / PACE.turn
    assert effort <= 1.0 + 1e-9
    asked = time / 0.5 * np.array([0.8 * forward, 0.8 * sideways, turn])
    share = min(1.0, 1.0 / max(np.hypot(asked[0], asked[1] / 0.5) / 0.2 + abs(asked[2]) / 0.25, 1e-12))
    assert [ahead, left, change[2]] == pytest.approx(share * asked, abs=1e-9)


def test_a_base_does_not_step_sideways() -> None:
    change = integrate_command(np.zeros(3), Drive(0.1, 0.1, 0.0), 1.0, StepLimits(1.0, 1.0), unit=1.0, height=1.0)
    assert change == pytest.approx([0.1, 0.0, 0.0])


@pytest.mark.parametrize("value", [float("nan"), 2.1, -3.0])
def test_invalid_speeds_are_refused(value: float) -> None:
    with pytest.raises(ArgumentError, match=r"sideways .*: give a speed from -2 to 2"):
        Drive(sideways=value)


def test_a_file_of_speeds_is_read(tmp_path: Path) -> None:
    file = tmp_path / "speeds.csv"
    file.write_text("time,forward,sideways,turn\n# ahead\n0,0.1,0,0\n1.5, 0.1,0,0.2\n3,0,0,0\n")
    plan = read_drive(file)
    assert plan.seconds == 3.0 and plan.at(0.0) == plan.at(1.4) == Drive(0.1)
    assert plan.at(2.0) == Drive(0.1, 0.0, 0.2) and plan.at(9.0).is_zero


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("0,0.1,0\n", "line 1: '0,0.1,0': give four numbers, time,forward,sideways,turn"),
        ("1,0,0,0\n0.5,0,0,0\n", "line 2: time 0.5: give increasing times in seconds, from 0 to 60"),
        ("0,9,0,0\n", "line 1: forward 9: give a speed from -2 to 2"),
        ("0,0.1,0,0\n", "commands: the last command is 0.1,0,0, not zero; end with 0,0,0"),
        ("\n", "no commands; give lines of four numbers, time,forward,sideways,turn"),
    ],
)
def test_a_bad_file_is_a_one_line_error(tmp_path: Path, text: str, told: str) -> None:
    file = tmp_path / "speeds.csv"
    file.write_text(text)
    with pytest.raises(UserError) as error:
        read_drive(file)
    assert told in str(error.value) and "\n" not in str(error.value)


def test_the_route_follows_the_current_command() -> None:
    """Past poses are unchanged, future ones follow the command, and a zero command closes the feet."""
    walk = DrivenWalk(stool().place, Drive(0.1))
    before = walk.planar_poses.copy()
    assert (
        walk.gait.step_count == len(before) - 1 > 2 and np.all(np.diff(before[:, 0]) > 0.0) and not before[:, 2].any()
    )
    walk.command = Drive(0.1, 0.0, 0.1)
    walk._lay_places(2)
    assert walk.planar_poses[:3] == pytest.approx(before[:3]) and walk.planar_poses[3, 2] > 0.0
    walk.command = Drive()
    walk._lay_places(3)
    assert len(walk.planar_poses) == 4 and walk.gait.swings == 3 + len(walk.gait.groups) - 1
    walk.command = Drive(-0.1)
    walk._lay_places(4)
    assert (
        walk.planar_poses[4] == pytest.approx(walk.planar_poses[3])
        and walk.planar_poses[5, 0] < walk.planar_poses[4, 0]
    )


def test_the_route_continues_from_slipping_feet() -> None:
    """If the feet lag by one step, the rest of the route is shifted, also in the closing swings of three groups of
    feet, which follow the last pose."""
    place = stool().place
    walk, standing = DrivenWalk(place, Drive(0.1)), place.ground.local(place.standing)
    before, length = walk.planar_poses.copy(), walk.planar_poses[1, 0]
    walk._arrived_footholds = [2] * len(walk.feet)
    walk._plan_swing(2, standing + [before[2, 0], 0.0, 0.0])
    assert walk.planar_poses[:5] == pytest.approx(before)
    walk._plan_swing(2, standing + [before[1, 0], 0.0, 0.0])
    assert np.array_equal(walk.planar_poses[:2], before[:2])
    assert walk.planar_poses[2:5, 0] == pytest.approx(before[2:, 0] - length)
    walk.command = Drive()
    walk._lay_places(3)
    walk.gait = replace(walk.gait, groups=((0,), (1, 2), (3,)))
    walk._arrived_footholds, last = [3, 2, 2, 3], walk.planar_poses[3, 0]
    walk._plan_swing(4, standing)
    assert len(walk.planar_poses) == 4 and walk.planar_poses[3, 0] < last


def test_a_quick_command_makes_the_gait_quicker() -> None:
    slow, quick = (DrivenWalk(stool().place, Drive(speed)) for speed in (0.02, 1.0))
    assert quick.gait.swing_time == pytest.approx(slow.gait.swing_time / 1.6)
    longest = np.linalg.norm(np.diff(quick.planar_poses[:, :2], axis=0), axis=1)
    assert longest == pytest.approx(quick._step_limits.length)


@pytest.mark.slow
def test_a_stool_is_driven_and_stands_again() -> None:
    """The stool is driven forward for 1.5 s and first shifts its weight for 1.5 sqrt(H / g). Its displacement is the
    speed times the remaining time, to within the length of one step, and it stands at the end."""
    made, speed = stool(), 0.06
    plan = DrivePlan((0.0, 1.5), (Drive(speed), Drive()))
    driven = ScriptedDrive(made.place, plan)
    state, memory, reports = made.start, made.stepper.initial_memory(), list[StepReport]()
    body = made.place.body
    for _ in range(420):
        wishes = driven.objectives(state, reports[-1] if reports else None, DT)
        state, memory, fresh = made.stepper.advance(state, memory, wishes, DT)
        reports += fresh
        if driven.is_at_rest:
            break
    assert driven.is_at_rest
    moved = body.centre_of_mass(state.positions) - body.centre_of_mass(made.start.positions)
    pace = speed * 1.72 * body.height
    assert moved[0] == pytest.approx(speed * body.speed_unit * (1.5 - 1.5 * body.time_unit), abs=pace)
    assert abs(moved[1]) < 0.03
    assert moved[2] == pytest.approx(0.0, abs=0.03)


def test_every_kind_of_body_can_be_driven() -> None:
    ball = coarse_creature(ball_mesh(), forward=FORWARD, all_round=True)
    worm = coarse_creature(worm_mesh(), forward=FORWARD)
    for made in (stool(), ball, worm):
        driven = LiveDrive(made.place)
        assert driven.is_at_rest and isinstance(driven._motion, Stand)
        driven.command = Drive(0.1)
        assert not driven.is_at_rest
        assert driven.objectives(made.start, None, DT) and not isinstance(driven._motion, Stand)
    walk = LiveDrive(stool().place)
    walk.command = Drive(0.1)
    walk.objectives(stool().start, None, DT)
    assert isinstance(walk._motion, DrivenWalk) and walk._motion.phase is WalkPhase.SHIFT
