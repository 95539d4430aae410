"""Balance controller: target velocities that do not tip the body, compared with an exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.motions.balance import SUPPORT_MARGIN, Measurement, _share_in_cone
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import SOLE_HEIGHT, BalanceController

GRAVITY, EDGE, DT = 9.81, 0.2, 1 / 60


def measured_body(
    place: Stance, friction: float, moved: tuple[float, float, float]
) -> tuple[BalanceController, BodyState, Measurement]:
    """Return the controller, the state and the measurement of a body at rest whose nodes above the soles are displaced
    by ``moved``."""
    pose = BalanceController(place.body, place.ground, place.standing, place.contact_points, friction)
    positions = place.standing + np.array(moved) * (place.standing[:, 2:] > 1e-9)
    state = BodyState(positions, np.zeros_like(positions))
    return pose, state, pose.measure(state, None)


def swing(place: Stance, state: BodyState, seen: Measurement, spin: np.ndarray) -> np.ndarray:
    """Return the velocity (2,), m/s, of the centre of mass whose angular momentum about the feet equals the
    angular momentum of a rotation with ``spin`` (3,), rad/s."""
    momentum = place.ground.axes @ place.body.inertia(state.positions) @ spin / (place.body.mass * seen.com[2])
    return np.array([momentum[1], -momentum[0]])


@pytest.mark.parametrize("wanted", [(0.005, -0.003), (0.3, 0.01), (-0.1, -0.4)])
@pytest.mark.parametrize("turning", [(0.0, 0.0, 0.3), (0.4, -2.0, 0.0)])
@pytest.mark.parametrize("up", [0.0, 0.1, -0.08])
def test_balance_targets_are_the_nearest_that_do_not_tip(
    place: Stance, wanted: tuple[float, float], turning: tuple[float, float, float], up: float
) -> None:
    """The rate of change of m h (v + swing) is the load times the distance of the centre of pressure from the centre of
    mass, and the centre of pressure is within the footprint. Of all such targets, the controller selects the one with
    the least error of velocity and spin."""
    pose, state, seen = measured_body(place, 1e3, (0.05, -0.03, 0.1))
    asked, spin = np.array([*wanted, up]), np.array(turning)
    velocity, turned = pose.balance_targets(seen, asked, spin, DT)
    load, height = GRAVITY + up / DT, seen.com[2]
    middle = place.ground.local(place.contact_points)[:, :2].mean(axis=0)

    def pressure(change: np.ndarray) -> np.ndarray:
        return seen.com[:2] - height / load * change / DT

    change = velocity[:2] + swing(place, state, seen, turned)
    assert np.abs(pressure(change) - middle).max() <= SUPPORT_MARGIN * EDGE + 1e-9
    assert velocity[2] == up
    axis = place.ground.axes[2]
    inertia = place.body.inertia(state.positions)
    assert axis @ inertia @ turned == pytest.approx(axis @ inertia @ spin, abs=1e-9)
    # The reference is a grid search over velocity and swing, for each axis separately.
    gyration = 0.5 * np.trace(inertia) / (place.body.mass * height**2)
    line = np.linspace(-1.0, 1.0, 2001)
    for k in (0, 1):
        level, turn = np.meshgrid(line, line, indexing="ij")
        stands = np.abs(seen.com[k] - height / load * (level + turn) / DT - middle[k]) <= SUPPORT_MARGIN * EDGE
        target = swing(place, state, seen, spin)[k]
        missed = (level - wanted[k]) ** 2 + (turn - target) ** 2 / gyration
        got = (velocity[k] - wanted[k]) ** 2 + (swing(place, state, seen, turned)[k] - target) ** 2 / gyration
        assert np.sqrt(got) <= np.sqrt(missed[stands].min()) + 1e-9
        assert np.sqrt(got) >= np.sqrt(missed[stands].min()) - 5e-3


@pytest.mark.parametrize(("ahead", "is_driven"), [(0.02, True), (0.12, False)])
def test_uprighting_does_not_drive_a_body_off_its_feet(place: Stance, ahead: float, is_driven: bool) -> None:
    """The requested backward rotation of a body at rest is faster than its feet allow, so the centre of pressure is at
    the edge. If the centre of mass is near the middle of the support, the body also moves forward; if it is half-way to
    the edge, the body does not."""
    pose, state, seen = measured_body(place, 1e3, (ahead, 0.0, 0.0))
    velocity, turned = pose.balance_targets(seen, np.zeros(3), np.array([0.0, -2.0, 0.0]), DT)
    assert velocity[0] > 1e-3 if is_driven else velocity[0] == pytest.approx(0.0, abs=1e-12)
    change = velocity[:2] + swing(place, state, seen, turned)
    pressure = seen.com[:2] - seen.com[2] / GRAVITY * change / DT
    middle = place.ground.local(place.contact_points)[:, :2].mean(axis=0)
    assert pressure[0] - middle[0] == pytest.approx(SUPPORT_MARGIN * EDGE)


def test_feasible_targets_are_unchanged_and_a_falling_body_may_move_in_both_directions(place: Stance) -> None:
    pose, _, seen = measured_body(place, 1e3, (0.0, 0.0, 0.0))
    asked, spin = np.array([0.01, -0.005, 0.02]), np.array([0.01, 0.02, 0.5])
    velocity, turned = pose.balance_targets(seen, asked, spin, DT)
    np.testing.assert_allclose(velocity, asked, atol=1e-12)
    np.testing.assert_allclose(turned, spin, atol=1e-12)
    pose, _, seen = measured_body(place, 1e3, (0.5, 0.0, 0.0))
    ways = [pose.balance_targets(seen, np.array([x, 0.0, 0.0]), np.zeros(3), DT)[0][0] for x in (-2.0, 2.0)]
    assert ways[0] < -0.5 * DT and ways[1] > 0.5 * DT


@pytest.mark.parametrize("up", [0.0, 0.25])
def test_requests_are_limited_by_friction(place: Stance, up: float) -> None:
    """A request is scaled, with its direction unchanged, to at most 0.95 of the friction limit; a smaller one is
    unchanged."""
    pose, _, seen = measured_body(place, 0.05, (0.0, 0.0, 0.0))
    wanted = np.array([0.009, -0.012])
    most = 0.95 * 0.05 * (GRAVITY + up / DT) * DT
    got, _ = pose.balance_targets(seen, np.array([*(10.0 * wanted), up]), np.zeros(3), DT)
    assert got[:2] == pytest.approx(most * wanted / 0.015)
    little, _ = pose.balance_targets(seen, np.array([*(0.1 * wanted), up]), np.zeros(3), DT)
    assert little[:2] == pytest.approx(0.1 * wanted)


@pytest.mark.parametrize("way", [(1.0, 0.0), (-1.0, 0.0), (0.6, -0.8)])
def test_on_a_slope_friction_gives_less_uphill(way: tuple[float, float]) -> None:
    """The limited force is on the friction cone about the normal of the ground. Uphill, its horizontal component is the
    weight times tan(friction angle - slope)."""
    friction, slope = 0.3, np.radians(8.0)
    rising = np.array([-np.sin(slope), 0.0, np.cos(slope)])
    push, weight = np.array([*way, 0.0]), np.array([0.0, 0.0, 2.0])
    share = _share_in_cone(push, weight, rising, friction)
    force = weight + share * push
    assert np.linalg.norm(np.cross(force, rising)) == pytest.approx(friction * force @ rising)
    angle = np.arctan(friction)
    by_hand = {(1.0, 0.0): np.tan(angle - slope), (-1.0, 0.0): np.tan(angle + slope)}
    assert share == pytest.approx(2.0 * by_hand.get(way, share / 2.0))
    assert _share_in_cone(push, weight, rising, 0.1) == 0.0
    assert _share_in_cone(weight, weight, rising, friction) == np.inf


@pytest.mark.parametrize("spin", [(0.0, -2.0, 0.0), (1.5, 1.0, 0.2)])
def test_spin_replaces_velocity_where_friction_is_low(place: Stance, spin: tuple[float, float, float]) -> None:
    """On slippery ground, the velocity is limited by friction, and the centre of pressure is within the footprint."""
    pose, state, seen = measured_body(place, 0.3, (0.05, -0.03, 0.1))
    velocity, turned = pose.balance_targets(seen, np.array([0.3, 0.01, 0.0]), np.array(spin), DT)
    change = velocity[:2] + swing(place, state, seen, turned)
    middle = place.ground.local(place.contact_points)[:, :2].mean(axis=0)
    pressure = seen.com[:2] - seen.com[2] / GRAVITY * change / DT
    assert np.linalg.norm(velocity[:2]) <= 0.3 * GRAVITY * DT
    assert np.abs(pressure - middle).max() <= SUPPORT_MARGIN * EDGE + 1e-9


def test_a_body_that_rotates_forward_is_caught_further_ahead(place: Stance) -> None:
    """The capture point follows from the angular momentum about the feet: a spin counts as the velocity of the centre
    of mass with the same angular momentum."""
    pose, state, seen = measured_body(place, 1.0, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(pose.capture_acceleration(seen, seen.com[:2]), 0.0, atol=1e-12)
    ahead = BodyState(state.positions, np.broadcast_to(0.1 * place.ground.axes[0], state.positions.shape))
    forward = pose.capture_acceleration(pose.measure(ahead, None), seen.com[:2])
    assert forward[0] == pytest.approx(-0.2 * np.sqrt(GRAVITY / seen.com[2]), rel=1e-9)
    arms = state.positions - place.body.centre_of_mass(state.positions)
    turning = BodyState(state.positions, np.cross(0.5 * place.ground.axes[1], arms))
    caught = pose.capture_acceleration(pose.measure(turning, None), seen.com[:2])
    same = swing(place, state, seen, 0.5 * place.ground.axes[1])
    np.testing.assert_allclose(caught, -2.0 * np.sqrt(GRAVITY / seen.com[2]) * same, atol=1e-9)


@pytest.mark.parametrize(("ahead", "urgency"), [(0.0, 0.0), (0.05, 0.25), (-0.1, 0.5), (0.3, 1.5)])
def test_the_capture_margin_is_relative_to_the_edge(place: Stance, ahead: float, urgency: float) -> None:
    """The base extends 0.2 m to both sides, and only the speed of the body varies. Here, the margin is the distance of
    the capture point from the middle, divided by 0.2 m."""
    pose = BalanceController(place.body, place.ground, place.standing, place.contact_points, place.friction)
    height = place.body.centre_of_mass(place.standing)[2]
    speed = np.array([ahead * np.sqrt(GRAVITY / height), 0.0, 0.0])
    seen = pose.measure(BodyState(place.standing, np.tile(speed, (len(place.standing), 1))), None)
    assert pose.capture_margin(seen) == pytest.approx(urgency, abs=0.02)


def test_a_leaning_body_rotates_as_in_its_static_bend(place: Stance) -> None:
    """The pose equals the best affine fit, weighted by mass, to the static bend under a horizontal body force with the
    sole clamped, which is solved densely."""
    pose, _, seen = measured_body(place, 0.8, (0.0, 0.0, 0.0))
    body, assembly = place.body, place.body.assembly
    upper = assembly.matrix(assembly.hessian_entries(place.standing, projected=True)).toarray()
    stiffness = upper + np.triu(upper, 1).T
    heights = place.standing @ place.ground.surface_normal
    free = np.repeat(heights >= heights.min() + SOLE_HEIGHT * body.height, 3)
    bend = np.zeros(len(free))
    ahead = place.ground.axes[0]
    bend[free] = np.linalg.solve(stiffness[np.ix_(free, free)], np.kron(body.node_mass, ahead)[free])
    lean = 0.1
    moved = bend.reshape(-1, 3) * lean * pose.standing_height / (ahead @ body.centre_of_mass(bend.reshape(-1, 3)))
    arms = place.standing - body.centre_of_mass(place.standing)
    weights = np.sqrt(body.node_mass)[:, None]
    ends = arms + moved - body.centre_of_mass(moved)
    nearest = np.linalg.lstsq(weights * arms, weights * ends, rcond=None)[0].T
    goal = seen.com + lean * pose.standing_height * np.array([1.0, 0.0, 0.0])
    assert np.allclose(pose.bent_over_base(goal, seen.foot_centre), nearest, atol=1e-5)
    left = place.ground.axes[1]
    sheared, bent = (
        left @ pose.turn_towards(seen, of(goal, seen.foot_centre)) for of in (pose.over_base, pose.bent_over_base)
    )
    assert 1.1 * sheared < bent
