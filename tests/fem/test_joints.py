"""Joints, compared with closed forms: a pendulum, a hanging body, a door that is hit, and two bodies in flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space

from egs_warp.fem.body import BodyState
from egs_warp.fem.driven_step import PathDrive, step_of
from egs_warp.fem.island_problem import IslandProblem
from egs_warp.fem.joints import JointRows, PointJoint
from egs_warp.geometry.rigid_path import RigidPath
from tests.support.passive import ABYSS
from tests.support.props import RunningWorld, box_body, point_at

DT = 1 / 120
ROD = (0.2, 0.2, 1.0)


def turned(world: RunningWorld, body: int, about: np.ndarray, angle: float) -> None:
    """Turn a body at rest by ``angle`` rad about the line through ``about`` (3,) m along y."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    positions = about + (world.states[body].positions - about) @ rotation.T
    world.states[body] = BodyState(positions, np.zeros_like(positions))


def joint_force(world: RunningWorld, body: int) -> np.ndarray:
    """Return the sum of the joint forces (3,) N on a body in the last step."""
    joints = world.reports[body][-1].joints
    assert joints is not None
    return joints.forces.sum(axis=0)


def test_a_pendulum_has_the_period_of_its_amplitude() -> None:
    """T = 2 pi sqrt(I / (m g l)) (1 + a^2 / 16 + 11 a^4 / 3072), with the inertia I about the pivot."""
    amplitude, arm, pivot = 0.4, 0.4, np.array([0.0, 0.0, 0.9])
    rod = box_body(ROD, plane=ABYSS)
    joint = PointJoint((point_at(0, rod, pivot),), pivot)
    world = RunningWorld([rod], [(0.0, 0.0, 0.0)], joints=[joint])
    turned(world, 0, pivot, amplitude)
    angles, gaps = [amplitude], []
    for _ in range(150):
        world.advance(DT)
        offset = world.centres()[0] - pivot
        angles.append(float(np.arctan2(-offset[0], -offset[2])))
        (point,) = joint.points
        gaps.append(np.abs(point.weights @ world.states[0].positions[point.nodes] - pivot).max())
    assert max(gaps) < 1e-14
    values = np.array(angles)
    before = np.flatnonzero(values[1:] * values[:-1] < 0.0)
    crossings = DT * (before + values[before] / (values[before] - values[before + 1]))
    inertia = (ROD[0] ** 2 + ROD[2] ** 2) / 12.0 + arm**2
    period = 2.0 * np.pi * np.sqrt(inertia / (9.81 * arm)) * (1.0 + amplitude**2 / 16.0 + 11.0 * amplitude**4 / 3072.0)
    assert 2.0 * (crossings[1] - crossings[0]) == pytest.approx(period, rel=2e-4)
    assert np.abs(values).max() == pytest.approx(amplitude, abs=2e-3)


def test_two_joints_carry_the_weight_of_what_hangs_from_them() -> None:
    upper, lower = box_body((0.3, 0.3, 0.3), plane=ABYSS), box_body((0.2, 0.2, 0.3), plane=ABYSS)
    # Away from the origin, where a joint with a wrong sign would hold the two points too.
    raised, shift = (0.0, 0.0, 0.5), (0.0, 0.0, 0.2)
    top, middle = np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.0, 0.5])
    joints = [
        PointJoint((point_at(0, upper, top, raised),), top),
        PointJoint((point_at(0, upper, middle, raised), point_at(1, lower, middle, shift)), middle),
    ]
    world = RunningWorld([upper, lower], [raised, shift], joints=joints)
    for _ in range(60):
        world.advance(DT)
    weights = [body.weight for body in world.bodies]
    assert max(np.abs(state.velocities).max() for state in world.states) < 1e-5
    on_upper = world.reports[0][-1].joints
    assert on_upper is not None
    assert joint_force(world, 1) == pytest.approx([0.0, 0.0, weights[1]], abs=1e-4 * weights[1])
    assert on_upper.forces[0] == pytest.approx([0.0, 0.0, sum(weights)], abs=1e-4 * sum(weights))
    assert on_upper.forces[1] == pytest.approx([0.0, 0.0, -weights[1]], abs=1e-4 * weights[1])


def test_a_door_that_is_hit_turns_with_the_angular_momentum_that_it_receives() -> None:
    """Gravity and the forces of a vertical hinge have no torque about its axis, so the angular momentum about it is
    that of the box before it hits the door. Afterwards, both turn together or apart, but the sum stays."""
    door, box = box_body((0.8, 0.1, 1.0), plane=ABYSS), box_body((0.2, 0.2, 0.2), plane=ABYSS, density=2000.0)
    ends = [np.array([-0.4, 0.0, z]) for z in (0.1, 0.9)]
    joints = [PointJoint((point_at(0, door, end),), end) for end in ends]
    world = RunningWorld(
        [door, box], [(0.0, 0.0, 0.0), (0.25, -0.25, 0.6)], [(0, 0, 0), (0.0, 2.0, 0.0)], joints=joints
    )
    hinge = np.array([-0.4, 0.0, 0.0])

    def about_hinge() -> list[float]:
        return [
            float((b.node_mass[:, None] * np.cross(s.positions - hinge, s.velocities)).sum(axis=0)[2])
            for b, s in zip(world.bodies, world.states, strict=True)
        ]

    start, angles = about_hinge(), [0.0]
    for _ in range(40):
        world.advance(DT)
        assert sum(about_hinge()) == pytest.approx(start[1], rel=1e-12)
        offset = world.centres()[0] - hinge
        angles.append(float(np.arctan2(offset[1], offset[0])))
    # The door turns freely after the hit: its angle grows by L dt / I in each step.
    inertia = world.bodies[0].mass * ((0.8**2 + 0.1**2) / 12.0 + 0.4**2)
    rate = about_hinge()[0] / inertia
    assert rate > 0.5 and angles[-1] > 0.1
    assert np.diff(angles[-5:]) == pytest.approx(rate * DT, rel=1e-3)
    assert abs(world.centres()[0, 2] - 0.5) < 1e-4


def test_a_joint_in_flight_conserves_momenta_to_rounding() -> None:
    first, second = box_body((0.3, 0.2, 0.2), plane=ABYSS, soft=True), box_body((0.2, 0.2, 0.4), plane=ABYSS)
    place, shift = np.array([0.15, 0.0, 0.1]), (0.25, 0.0, 0.0)
    joint = PointJoint((point_at(0, first, place), point_at(1, second, place, shift)), place)
    world = RunningWorld([first, second], [(0.0, 0.0, 0.0), shift], [(0.0, 1.0, 0.0), (0.0, 1.0, 0.0)], joints=[joint])
    state = world.states[1]
    world.states[1] = replace(state, velocities=state.velocities + np.cross([0.0, 3.0, 0.0], state.positions - place))
    mass, gravity = sum(body.mass for body in world.bodies), world.bodies[0].gravity
    linear, angular = world.momenta()
    for _ in range(30):
        weighted = sum(b.mass * c for b, c in zip(world.bodies, world.centres(), strict=True))
        linear, angular = linear + DT * mass * gravity, angular + DT * np.cross(weighted, gravity)
        world.advance(DT)
        now = world.momenta()
        assert np.abs(now[0] - linear).max() < 1e-12 * mass
        assert np.abs(now[1] - angular).max() < 1e-12 * mass
        assert joint_force(world, 0) == pytest.approx(-joint_force(world, 1), abs=0.0)


def test_a_body_hangs_from_a_platform_that_rises() -> None:
    """The drive of the platform bears the weight and the inertia of both: the change of their momentum is its
    impulse."""
    platform = box_body((0.4, 0.4, 0.1))
    platform = replace(platform, drive=PathDrive(RigidPath([0.5], [(0.0, 0.0, 0.2)]), platform.rest_positions))
    place, shift = np.array([0.0, 0.0, 0.0]), (0.0, 0.0, -0.3)
    ball = box_body((0.2, 0.2, 0.3), plane=ABYSS)
    joint = PointJoint((point_at(0, platform, place), point_at(1, ball, place, shift)), place)
    world = RunningWorld([platform, ball], [(0.0, 0.0, 0.0), shift], joints=[joint])
    assert world.stepper.carried == {0, 1}
    momentum, masses = world.momenta()[0], [body.mass for body in world.bodies]
    for _ in range(30):
        world.advance(DT)
        drive = world.reports[0][-1].drive
        assert drive is not None
        impulse = world.bodies[0].node_mass @ drive + DT * sum(masses) * world.bodies[0].gravity
        assert world.momenta()[0] - momentum == pytest.approx(impulse, abs=1e-10 * sum(masses))
        momentum = world.momenta()[0]
    assert world.centres()[1, 2] > world.centres()[0, 2] - 0.3


def test_the_tangent_with_joints_is_the_inverse_of_the_derivative_among_feasible_velocities() -> None:
    """With a basis Z of the velocities with B v = 0 and the derivative J of the residual from central differences, it
    is Z (Z^T J Z)^-1 Z^T."""
    bodies = [box_body((0.3, 0.2, 0.2), soft=True), box_body((0.2, 0.2, 0.4))]
    place, shift = np.array([0.15, 0.0, 0.1]), (0.25, 0.0, 0.0)
    joint = PointJoint((point_at(0, bodies[0], place), point_at(1, bodies[1], place, shift)), place)
    states = [
        BodyState(body.rest_positions + move, np.zeros_like(body.rest_positions))
        for body, move in zip(bodies, ((0.0, 0.0, 0.0), shift), strict=True)
    ]
    problems = [step_of(b.stepper.body, s, DT, 0.0, None) for b, s in zip(bodies, states, strict=True)]
    starts = np.cumsum([0, *(len(body.rest_positions) for body in bodies)])
    problem = IslandProblem(tuple(problems), JointRows.of([joint], starts))
    velocities = problem.rigid_guess
    tangent = problem.tangent([body.stepper.factors for body in bodies], velocities, None)
    size, small = velocities.size, 1e-5
    derivative = np.empty((size, size))
    for column in range(size):
        change = np.zeros(size)
        change[column] = small
        ends = [problem.residual(velocities + sign * change.reshape(-1, 3), None).ravel() for sign in (1.0, -1.0)]
        derivative[:, column] = (ends[0] - ends[1]) / (2.0 * small)
    assert problem.joint_rows is not None
    basis = null_space(problem.joint_rows.matrix)
    expected = basis @ np.linalg.solve(basis.T @ derivative @ basis, basis.T)
    found = tangent.solve(np.eye(size))
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()
