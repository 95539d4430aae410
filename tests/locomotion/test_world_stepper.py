"""Steps of several bodies in one world, compared with closed forms of collision, rest and sliding, and with one body
alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.penetration import depth_in_itself
from egs_warp.locomotion.stepper import WarmStart
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.locomotion.world_stepper import WorldBody, WorldStepper
from egs_warp.motions.script import motion as script
from egs_warp.motions.sequence import MotionSequence
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh, u_bar
from tests.support.passive import ABYSS
from tests.support.props import RunningWorld, box_body, prongs_in_flight, soft_body

DT = 1 / 120


@pytest.mark.parametrize("soft", [False, True])
def test_a_collision_in_flight_conserves_momenta_and_does_not_rebound(soft: bool) -> None:
    size, heavier = (0.4, 0.4, 0.4), (0.8, 0.4, 0.4)
    bodies = [box_body(size, plane=ABYSS), box_body(heavier, plane=ABYSS, soft=soft)]
    world = RunningWorld(bodies, [(0.0, 0.0, 0.0), (0.63, 0.0, 0.05 * soft)], [(1.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    mass, gravity = sum(body.mass for body in world.bodies), world.bodies[0].gravity
    linear, angular = world.momenta()
    touched = False
    for _ in range(20):
        weighted = sum(b.mass * c for b, c in zip(world.bodies, world.centres(), strict=True))
        linear, angular = linear + DT * mass * gravity, angular + DT * np.cross(weighted, gravity)
        world.advance(DT)
        touched |= any((report.forces[:, 0] > 0.0).any() for reports in world.reports for report in reports)
        # As in ``angular``, the torque of gravity in each step is that at the positions at its start.
        now = world.momenta()
        assert np.abs(now[0] - linear).max() < 1e-12 * mass
        assert np.abs(now[1] - angular).max() < 1e-12 * mass
    assert touched and world.min_gap > -0.01 * size[2]
    speeds = [b.centre_of_mass(s.velocities)[0] for b, s in zip(world.bodies, world.states, strict=True)]
    if soft:
        assert 0.0 < speeds[1] - speeds[0] < 1.0
    else:
        assert np.allclose(speeds, 1.0 / 3.0, atol=1e-4)


def test_a_prop_comes_to_rest_on_a_soft_block_that_carries_its_weight() -> None:
    bodies = [box_body((0.5, 0.5, 0.4), soft=True), box_body((0.3, 0.3, 0.3))]
    world = RunningWorld(bodies, [(0.0, 0.0, 0.0), (0.03, 0.02, 0.402)], [(0.0, 0.0, 0.0), (0.0, 0.0, -0.3)])
    for _ in range(120):
        world.advance(DT)
    assert world.min_gap > -0.01 * 0.3 and np.abs(world.states[1].velocities).max() < 2e-3
    forces = []
    for (report,), other in zip(world.reports, (1, 0), strict=True):
        with_other = report.contacts.faces == -1 - other
        forces.append(np.einsum("na,nai->i", report.forces[with_other], report.contacts.axes[with_other]))
    weight = world.bodies[1].weight
    assert np.abs(forces[0] + forces[1]).max() < 1e-12 * weight
    assert np.allclose(forces[1], [0.0, 0.0, weight], atol=0.01 * weight)


@pytest.mark.slow
def test_a_stack_of_five_stands_for_ten_seconds() -> None:
    world = RunningWorld([box_body((0.3, 0.3, 0.2)) for _ in range(5)], [(0.01 * i, 0.0, 0.201 * i) for i in range(5)])
    for _ in range(round(10.0 / DT)):
        world.advance(DT)
    expected = [(0.01 * i, 0.0, 0.1 + 0.2 * i) for i in range(5)]
    assert np.allclose(world.centres(), expected, atol=1e-3)
    assert world.min_gap > -0.01 * 0.2


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_block_slides_down_another_above_the_angle_of_friction_only(factor: float) -> None:
    friction, slope = 0.5, np.arctan(0.5 * factor)
    up = np.array([-np.sin(slope), 0.0, np.cos(slope)])
    bodies = [box_body((1.6, 0.8, 0.2), up=up, friction=0.9), box_body((0.2, 0.2, 0.1), up=up, friction=0.1)]
    frictions = np.full((2, 2), friction)
    world = RunningWorld(bodies, [(0.0, 0.0, 0.0), (-0.4, 0.0, 0.2)], frictions=frictions)
    for _ in range(60):
        world.advance(DT)
    moved = world.centres()[1] - world.centres()[0]
    acceleration = max(9.81 * (np.sin(slope) - friction * np.cos(slope)), 0.0)
    # With implicit Euler, the displacement after n steps is dt^2 a n (n + 1) / 2.
    expected = 0.5 * acceleration * DT**2 * 60 * 61
    assert moved[0] + 0.4 == pytest.approx(expected, abs=2e-3)
    assert abs(moved[1]) < 1e-3


def test_bodies_that_are_apart_move_as_they_do_alone() -> None:
    made = coarse_creature(block_mesh(), forward=np.array([1.0, 0.0, 0.0]))
    level_set = box_body((0.2, 0.2, 0.2)).level_set
    prop = box_body((0.2, 0.2, 0.2), friction=made.stepper.geometry.friction)
    nodes = made.stepper.body.mesh.nodes
    world = WorldStepper([WorldBody(made.stepper, level_set, nodes), prop])
    states = [made.start, BodyState(prop.rest_positions + [5.0, 0.0, 0.1], np.zeros((4, 3)))]
    memories, stance = world.initial_memories(), made.place
    alone, alone_memory = made.start, memories[0]
    sequences = [MotionSequence(stance, script("jump").parts(made.stepper.body.height)) for _ in range(2)]
    report = alone_report = None
    for _ in range(4):
        dt = made.stepper.body.time_unit / 20.0
        assert world.islands(states, dt) == [(0,), (1,)]
        targets = sequences[0].objectives(states[0], report, dt)
        done = world.advance(states, memories, [targets, ()], dt)
        states, report = [each[-1].state for each in done], done[0][-1]
        memories = [type(memories[0]).from_report(each[-1]) for each in done]
        own = sequences[1].objectives(alone, alone_report, dt)
        alone, alone_memory, reports = made.stepper.advance(alone, alone_memory, own, dt)
        alone_report = reports[-1]
        assert np.array_equal(states[0].positions, alone.positions)


def test_overlaps_connect_bodies_through_others(monkeypatch: pytest.MonkeyPatch) -> None:
    world = RunningWorld([box_body((0.2, 0.2, 0.2))] * 6, [(float(x), 0.0, 0.0) for x in range(6)])
    pairs = [(5, 3), (3, 5), (4, 0), (0, 4), (1, 3), (3, 1)]
    monkeypatch.setattr(world.stepper.pairs, "body_pairs", lambda positions: pairs)
    assert world.stepper.islands(world.states, DT) == [(0, 4), (1, 3, 5), (2,)]


def test_a_prop_at_rest_sleeps_until_it_is_hit() -> None:
    world = RunningWorld([box_body((0.3, 0.3, 0.2)), box_body((0.2, 0.2, 0.2))], [(0.0, 0.0, 0.0), (0.05, 0.0, 1.2)])
    iterations, loads = [], []
    for _ in range(80):
        world.advance(DT)
        (report,) = world.reports[0]
        iterations.append(report.newton_iterations)
        loads.append(report.forces[report.contacts.faces >= 0, 0].sum() / world.bodies[0].weight)
    hit = int(np.argmax(np.array(loads) > 1.1))
    # A fall of 1 m takes 0.45 s.
    assert 45 < hit < 60
    assert max(iterations[30 : hit - 3]) == 0 and min(iterations[hit : hit + 5]) > 0
    assert np.allclose(loads[30 : hit - 3], 1.0, atol=1e-6)


@pytest.mark.slow
def test_a_pile_of_eight_comes_to_rest() -> None:
    random = np.random.default_rng(3)
    places = [(*random.uniform(-0.12, 0.12, 2), 0.05 + 0.3 * i) for i in range(8)]
    world = RunningWorld([box_body((0.25, 0.25, 0.2)) for _ in range(8)], places)
    for _ in range(round(6.0 / DT)):
        world.advance(DT)
    speeds = [np.abs(state.velocities).max() for state in world.states]
    assert max(speeds) < 1e-3 and world.min_gap > -0.01 * 0.2
    assert all(
        body.assembly.determinants(s.positions).min() > 0.9 for body, s in zip(world.bodies, world.states, strict=True)
    )


@pytest.mark.parametrize("touching", [True, False])
def test_prongs_that_meet_in_flight_do_not_pass_through_each_other(touching: bool) -> None:
    """Two prongs of one body bend towards each other while the body tumbles. Without self contact, they pass through
    each other."""
    world = prongs_in_flight(touching)
    (body,) = world.bodies
    x = body.mesh.nodes
    inner = (np.abs(x[:, 0]) < 0.16) & (x[:, 2] > 0.25)
    left, right = inner & (x[:, 0] < 0.0), inner & (x[:, 0] > 0.0)
    linear, angular = world.momenta()
    deepest, depth, loaded = 0.0, 0.0, 0
    (made,) = world.stepper.bodies
    surface = ContactShape.of(made.stepper.geometry, made.level_set, x)
    points = surface.point_tets, surface.point_weights
    for _ in range(24):
        weighted = body.mass * world.centres()[0]
        linear, angular = linear + DT * body.mass * body.gravity, angular + DT * np.cross(weighted, body.gravity)
        world.advance(DT)
        now = world.momenta()
        assert np.abs(now[0] - linear).max() < 1e-12 * body.mass
        assert np.abs(now[1] - angular).max() < 1e-12 * body.mass
        positions = world.states[0].positions
        own = depth_in_itself(*points, surface.gaps, body.mesh.tets, x, positions, 0.025 * body.height)
        depth = max(depth, own)
        across = body.best_fit_rotation(positions)[:, 0]
        deepest = min(deepest, float((positions[right] @ across).min() - (positions[left] @ across).max()))
        loaded += sum((report.forces[:, 0] > 0.0).any() for report in world.reports[0])
    if touching:
        assert depth < 0.01 * body.height and loaded > 3
        assert world.min_gap > 1.0, "the ground is far below, and contact with itself does not count"
    else:
        assert deepest < -0.1 * body.height and loaded == 0


def test_a_step_into_the_own_body_is_too_deep_although_it_does_not_lower_the_recorded_gap() -> None:
    world = prongs_in_flight(True)
    start, island = list(world.states), world.stepper.island((0,))
    world.advance(DT)
    (report,) = world.reports[0]
    assert not island._is_too_deep([report], start)
    positions = start[0].positions.copy()
    prongs = positions[:, 2] > 0.25
    positions[prongs, 0] -= 0.16 * np.sign(positions[prongs, 0])
    end = replace(report, state=replace(report.state, positions=positions))
    assert end.min_gap > 1.0 and island._is_too_deep([end], start)


def test_a_body_that_does_not_touch_itself_keeps_its_bits() -> None:
    states = []
    for self_contact in (False, True):
        world = RunningWorld([soft_body(u_bar(), self_contact=self_contact)], [(0.0, 0.0, 0.01)])
        for _ in range(6):
            world.advance(DT)
        states.append(world.states[0])
    assert np.array_equal(states[0].positions, states[1].positions)
    assert np.array_equal(states[0].velocities, states[1].velocities)


@pytest.mark.parametrize("touching", [True, False])
def test_a_creature_presses_its_prongs_together_with_its_muscles(touching: bool) -> None:
    """The objective is that the tips approach each other. The self contact stops them, and its forces are part of the
    plan."""
    made = coarse_creature(u_bar(), forward=np.array([0.0, 1.0, 0.0]), all_round=True)
    shape, body = soft_body(u_bar()), made.stepper.body
    world = WorldStepper([WorldBody(made.stepper, shape.level_set, shape.rest_positions, None, touching)])
    nodes = body.mesh.nodes
    tips = np.flatnonzero(nodes[:, 2] > 0.75)
    share, ones = 1.0 / np.sqrt(len(tips)), np.ones(len(tips))
    rows = sparse.csr_matrix((share * ones, (np.arange(len(tips)), 3 * tips)), (len(tips), 3 * len(nodes)))
    closing = Objective("close", rows, -0.8 * share * np.sign(nodes[tips, 0]), 1.0)
    states, memories = [made.start], world.initial_memories()
    pressed, deepest = 0, 0.0
    surface = ContactShape.of(made.stepper.geometry, shape.level_set, nodes)
    for _ in range(22):
        ((report,),) = world.advance(states, memories, [[closing]], body.time_unit / 20.0)
        assert report.converged and report.qp_infeasible == 0
        states, memories = [report.state], [WarmStart.from_report(report)]
        pressed += bool((report.forces[report.contacts.faces < 0, 0] > 0.1 * body.weight).any())
        points = surface.point_tets, surface.point_weights
        positions = report.state.positions
        depth = depth_in_itself(*points, surface.gaps, body.mesh.tets, nodes, positions, 0.025 * body.height)
        deepest = max(deepest, depth)
    if touching:
        assert pressed >= 4 and deepest < 0.01 * body.height
    else:
        assert pressed == 0 and deepest > 0.05 * body.height
