"""Bodies that follow a prescribed path, and the bodies that they carry and push."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.driven_step import PathDrive
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.locomotion.world_stepper import WorldBody
from tests.support.props import RunningWorld, box_body

DT, STEPS = 1 / 120, 120
FRICTION = 0.5


def driven(body: WorldBody, path: RigidPath) -> WorldBody:
    return replace(body, drive=PathDrive(path, body.rest_positions))


def ride(path: RigidPath) -> tuple[RunningWorld, np.ndarray, list[np.ndarray]]:
    """Return a world with a small block on a driven platform after one second, the displacement of the block relative
    to the platform, and the force on the block in each step."""
    platform = driven(box_body((1.0, 1.0, 0.2), friction=FRICTION), path)
    world = RunningWorld([platform, box_body((0.2, 0.2, 0.1), friction=FRICTION)], [(0.0, 0.0, 0.0), (0.0, 0.0, 0.2)])
    forces = []
    for _ in range(STEPS):
        world.advance(DT)
        (report,) = world.reports[1]
        forces.append(np.einsum("na,nai->i", report.forces, report.contacts.axes))
    moved = world.centres() - [[0.0, 0.0, 0.1], [0.0, 0.0, 0.25]]
    return world, moved[1] - moved[0], forces


@pytest.mark.parametrize(("distance", "slips"), [(0.7, False), (1.2, True)])
def test_a_platform_carries_a_block_unless_it_accelerates_faster_than_friction(distance: float, slips: bool) -> None:
    """The largest acceleration is 6 d / T^2 for the distance d in the time T; friction holds up to mu g = 4.9 m/s^2."""
    _, moved, _ = ride(RigidPath([1.0], [(distance, 0.0, 0.0)]))
    assert (np.abs(moved[0]) > 0.01) == slips
    assert abs(moved[2]) < 1e-3


def test_a_lift_carries_the_weight_and_the_inertia_of_a_block() -> None:
    height, time = 0.3, STEPS * DT
    world, moved, forces = ride(RigidPath([time], [(0.0, 0.0, height)]))
    assert moved == pytest.approx(0.0, abs=1e-3)
    assert world.centres()[0] == pytest.approx([0.0, 0.0, 0.1 + height], abs=1e-12)
    # In a step of implicit Euler, the acceleration is the central difference of the path.
    times = DT * np.arange(-1, STEPS) + DT
    path = height * np.clip(times / time, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(times / time, 0.0, 1.0))
    acceleration = np.diff(path, 2) / DT**2
    expected = world.bodies[1].mass * (9.81 + acceleration)
    assert np.array(forces)[11:, 2] == pytest.approx(expected[10:], rel=0.01)


def test_the_drive_closes_the_balance_of_momentum() -> None:
    """In every step, the sum of the impulses of drive, gravity and contact is the change of momentum of a turning,
    moving platform."""
    platform = driven(
        box_body((1.0, 1.0, 0.2)), RigidPath([0.5, 1.0], [(0.3, 0.1, 0.2), (0.0,) * 3], [40.0, 0.0], True)
    )
    world = RunningWorld([platform, box_body((0.2, 0.2, 0.1))], [(0.0, 0.0, 0.0), (0.1, 0.0, 0.2)])
    body, before = world.bodies[0], world.states[0]
    for _ in range(40):
        world.advance(DT)
        for report in world.reports[0]:
            push = report.contacts.nodal_forces(report.forces)
            change = report.state.velocities - before.velocities - report.dt * body.gravity
            assert report.drive is not None
            left = body.node_mass[:, None] * (change - report.drive) - report.dt * push
            assert np.abs(left.sum(axis=0)).max() < 1e-12 * body.mass
            before = report.state


def test_a_prop_on_a_platform_that_stands_still_sleeps_until_it_moves() -> None:
    path = RigidPath([0.5, 0.8, 1.0], [(0.0,) * 3, (0.0,) * 3, (0.0, 0.0, 0.02)])
    world, moved, _ = ride(path)
    assert moved == pytest.approx(0.0, abs=1e-3)
    assert world.centres()[1, 2] == pytest.approx(0.27, abs=1e-3)


@pytest.mark.parametrize(
    ("times", "shifts", "repeat", "message"),
    [
        ([], [], False, "it has no points"),
        ([1.0, 0.5], [(0.0,) * 3] * 2, False, "time 2 is 0.5 s, and the one before it 1 s"),
        ([0.0], [(0.0,) * 3], False, "time 1 is 0 s, and the one before it 0 s"),
        ([np.inf], [(0.0,) * 3], False, "time 1 is inf s"),
        ([1.0], [(0.0,) * 3] * 2, False, "the numbers of times, shifts and turns are 1, 2 and 1; give one"),
        ([1.0], [(1.0, 0.0)], False, r"shift 1 has shape \(2,\); give three numbers"),
        ([1.0], [(np.nan, 0.0, 0.0)], False, r"shifts\[0\]\[0\] is nan; give a number"),
        ([1.0], [(1.0, 0.0, 0.0)], True, r"it ends with the shift \[1.0, 0.0, 0.0\] and the turn 0, but"),
    ],
)
def test_invalid_paths_are_refused(
    times: list[float], shifts: list[tuple[float, ...]], repeat: bool, message: str
) -> None:
    with pytest.raises(UserError, match=rf"^(path|RigidPath): {message}"):
        RigidPath(times, shifts, repeat=repeat)
