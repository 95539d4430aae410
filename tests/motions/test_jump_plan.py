"""Plan of a jump, compared with a thrust, a flight and an inverted pendulum that are integrated step by step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from egs_warp.motions.jump_plan import (
    LEAN_FRACTION,
    JumpPlan,
    JumpTarget,
    damped_dip,
    damped_motion,
    plan_jump,
    stopping_time,
    sufficient_lean,
)
from egs_warp.motions.style import Style

GRAVITY, STEP = 9.81, 1 / 60


def planned(target: JumpTarget, *, support_ahead: float = 0.1, lean: float = 0.0, **options: Any) -> JumpPlan:
    """Return the plan of a body of height 1 m; ``options`` replace the other arguments of ``plan_jump``."""
    body = {"height": 1.0, "com_height": 0.45, "gravity": GRAVITY, "step": STEP, **options}
    return plan_jump(target, support_ahead=support_ahead, lean=lean, **body)


@pytest.mark.parametrize(
    "target", [JumpTarget(0.5, 0.3), JumpTarget(0.0, 0.4), JumpTarget(0.9, 0.35, 0.15), JumpTarget(0.5, 0.2)]
)
@pytest.mark.parametrize("height", [1.0, 1.7])
def test_a_body_that_follows_the_plan_reaches_height_and_distance(target: JumpTarget, height: float) -> None:
    """Thrust and flight are integrated by implicit Euler; the landing is a linear inverted pendulum."""
    com_height, ahead = 0.45 * height, 0.2 * height
    lean = LEAN_FRACTION * target.distance
    plan = planned(target, height=height, com_height=com_height, support_ahead=ahead, lean=lean)

    # Thrust: from rest at the bottom of the crouch to take-off, where the body is stretched by the extension, the
    # acceleration first increases and is then constant. Its mean over the displacement times the displacement is
    # speed_up^2 / 2.
    times = np.linspace(0.0, plan.thrust_time, 4001)
    moves = [plan.thrust(np.zeros(3), time) for time in times]
    up, speeds = np.array([place[2] for place, _ in moves]), np.array([speed[2] for _, speed in moves])
    assert np.allclose(np.diff(up) / np.diff(times), 0.5 * (speeds[1:] + speeds[:-1]), atol=1e-6 * plan.speed_up)
    assert speeds[0] == pytest.approx(0.0, abs=1e-12) and speeds[-1] == pytest.approx(plan.speed_up)
    way = up[-1] - up[0]
    assert way + 0.5 * plan.speed_up * STEP == pytest.approx(plan.crouch_depth + plan.extension, rel=1e-6)
    assert up[-1] == pytest.approx(plan.extension - 0.5 * plan.speed_up * STEP, rel=1e-6)
    pushes = np.diff(speeds) / np.diff(times)
    full = pushes[-1]
    assert pushes[0] == pytest.approx(0.3 * full, rel=2e-3)
    assert pushes[800] == pytest.approx(0.65 * full, rel=2e-3)
    assert np.allclose(pushes[1601:], full, rtol=1e-6)
    push = plan.speed_up**2 / (2.0 * way)
    least, deepest = plan.extension + 0.02 * height, 0.26 * com_height
    assert 0.0 < plan.extension < target.height and plan.crouch_depth > 0.0
    # The acceleration of the thrust is 2.8 g unless the depth of the crouch is limited; it is larger at the maximum
    # depth and smaller at the minimum depth.
    if plan.crouch_depth > deepest - 1e-9:
        assert plan.crouch_depth == pytest.approx(deepest) and push > 2.8 * GRAVITY
    elif way < least + 1e-9:
        assert way == pytest.approx(least) and push < 2.8 * GRAVITY
    else:
        assert push == pytest.approx(2.8 * GRAVITY, rel=1e-6)

    # Flight: up to the requested height, then down to the height at which the stretched body touches its landing
    # surface.
    z, speed, apex, time = plan.extension, plan.speed_up, 0.0, 0.0
    while speed > 0.0 or z > plan.extension + target.rise:
        speed -= GRAVITY * STEP
        z, time = z + STEP * speed, time + STEP
        apex = max(apex, z)
    assert apex == pytest.approx(target.height, abs=GRAVITY * STEP**2)
    assert time == pytest.approx(plan.flight_time, abs=1.5 * STEP)

    # The distance is the sum of the lean, the paths of the thrust at half the forward speed and of the flight at the
    # full speed, and the distance by which the feet land ahead of the body. The forward speed from the crouch is
    # neglected, so the planned path is slightly longer.
    way = plan.lean + plan.speed_forward * (0.5 * plan.thrust_time + plan.flight_time)
    assert way + plan.landing_lag == pytest.approx(target.distance, rel=1e-9)
    assert plan.lean == pytest.approx(LEAN_FRACTION * target.distance)
    path = moves[-1][0][0] + plan.speed_forward * plan.flight_time + plan.landing_lag
    assert target.distance - 1e-9 <= path <= 1.05 * target.distance

    # Landing: an impulse through the centre of mass stops the fall and reduces the forward speed; over the centre of
    # pressure the body comes to rest as a linear inverted pendulum. In a forward jump, the centre of pressure is at 0.3
    # of the distance to the front of the feet; in a short jump it is nearer, which shortens the displacement after
    # landing.
    fall = np.sqrt(2.0 * GRAVITY * (target.height - plan.extension - target.rise))
    fall_rate = np.sqrt(GRAVITY / com_height)
    capture_time = 1.0 / (fall_rate + fall / com_height)
    pivot = plan.speed_forward * capture_time - plan.landing_lag
    assert pivot == pytest.approx(min(0.3 * ahead, 0.5 * target.distance * capture_time / plan.flight_time), abs=1e-12)
    leg = np.array([-plan.landing_lag - pivot, com_height])
    landed = np.array([plan.speed_forward, -fall]) + fall / com_height * leg
    assert landed[1] == pytest.approx(0.0, abs=1e-12)
    stop = solve_ivp(
        lambda _, y: [y[1], fall_rate**2 * (y[0] - pivot)],
        (0.0, 5.0 / fall_rate),
        [-plan.landing_lag, landed[0]],
        rtol=1e-10,
        atol=1e-12,
    )
    stopped = np.abs(stop.y[:, -1] - [pivot, 0.0]) / np.maximum(np.abs(stop.y[:, 0] - [pivot, 0.0]), 1e-9)
    assert stopped.max() < 1.01 * np.exp(-5.0)


@pytest.mark.parametrize("landing_time", [0.02, 0.11, 0.3])
@pytest.mark.parametrize("fall", [0.5, 2.0])
def test_feet_stop_a_body_with_a_gradual_landing(landing_time: float, fall: float) -> None:
    """A linear inverted pendulum comes to rest over its feet; the load on the feet is first the one that stops the fall
    at a constant rate, and then the weight. The feet are further ahead than for a fall that stops at once.
    """
    com_height, speed = 0.5, 1.3
    lever = speed * stopping_time(com_height, fall, GRAVITY, landing_time)
    assert lever > speed * stopping_time(com_height, fall, GRAVITY)
    loads = (GRAVITY + fall / landing_time, GRAVITY)
    place = np.array([-lever, speed])
    for load, lasts in zip(loads, (landing_time, 5.0 * np.sqrt(com_height / GRAVITY)), strict=True):
        rate = load / com_height
        solved = solve_ivp(lambda _, y, rate=rate: [y[1], rate * y[0]], (0.0, lasts), place, rtol=1e-11, atol=1e-13)
        place = solved.y[:, -1]
    assert np.abs(place).max() < 1.01 * np.exp(-5.0) * lever * np.sqrt(GRAVITY / com_height)
    soon = [stopping_time(com_height, fall, GRAVITY, short) for short in (1e-7, 0.0)]
    assert soon[0] == pytest.approx(soon[1], rel=1e-5)


@pytest.mark.parametrize("damping", [0.25, 0.9, 1.0, 4.0])
def test_damped_motion_solves_the_equation_of_an_oscillator(damping: float) -> None:
    rate, start = 3.0, [0.1, -1.3]
    solved = solve_ivp(
        lambda _, y: [y[1], -(rate**2) * y[0] - 2.0 * damping * rate * y[1]], (0.0, 1.0), start, rtol=1e-11, atol=1e-13
    )
    assert damped_motion(start[0], start[1], 1.0, rate, damping) == pytest.approx(solved.y[:, -1], abs=1e-9)
    heights, _ = damped_motion(0.0, -1.3, np.linspace(0.0, 4.0, 40001), rate, damping)
    assert damped_dip(rate, damping) == pytest.approx(-heights.min() / 1.3, rel=1e-6)


@pytest.mark.parametrize(("height", "is_limited"), [(0.3, False), (4.0, True)])
def test_a_landing_is_no_deeper_than_the_deepest_crouch(height: float, is_limited: bool) -> None:
    plan = planned(JumpTarget(0.0, height), support_ahead=0.2, style=Style(bounce=1.2))
    fall = np.sqrt(2.0 * GRAVITY * (height - plan.extension))
    dip = fall * damped_dip(plan.landing_rate, plan.landing_damping)
    assert dip == pytest.approx(0.26 * 0.45) if is_limited else dip < 0.26 * 0.45
    if not is_limited:
        assert plan.landing_rate == pytest.approx(4.0 * np.sqrt(GRAVITY))


@pytest.mark.parametrize("distance", [0.6, 0.75, 0.8, 1.2])
def test_a_thrust_is_long_enough_for_friction_to_give_the_speed(distance: float) -> None:
    """The friction impulse is at most mu times the normal impulse of weight and upward acceleration. If this is too
    little for the forward speed, the crouch is deeper by at most 0.02 H; otherwise it is unchanged.
    """
    lean = 0.05

    def with_friction(friction: float) -> JumpPlan:
        return planned(JumpTarget(distance, 0.1), lean=lean, friction=friction)

    def spare(plan: JumpPlan) -> float:
        gained = plan.speed_forward - 2.0 * lean / plan.crouch_time
        return 0.9 * 0.8 * (plan.speed_up + GRAVITY * plan.thrust_time) - gained

    easy, plan = with_friction(np.inf), with_friction(0.8)
    deeper = plan.crouch_depth - easy.crouch_depth
    if distance == 0.6:
        assert plan == easy and spare(plan) > 0.0
    elif distance == 0.75:
        # The planner assumes the speed of a thrust of zero duration, so the thrust is slightly longer than necessary.
        assert 0.0 < deeper < 0.02 and 0.0 < spare(easy) < spare(plan) < 0.3
    elif distance == 0.8:
        assert deeper == pytest.approx(0.02) and spare(easy) < 0.0 < spare(plan)
    else:
        assert deeper == pytest.approx(0.02) and spare(plan) < 0.0
    # Without friction, the crouch has the same depth as with too little friction.
    assert with_friction(0.0).crouch_depth - easy.crouch_depth == pytest.approx(0.02)


def test_a_jump_on_the_spot_needs_no_friction() -> None:
    plans = [planned(JumpTarget(0.0, 0.2), friction=friction) for friction in (0.0, 0.8, np.inf)]
    assert plans[0] == plans[1] == plans[2]


def test_a_body_leans_until_its_thrust_does_not_rotate_it() -> None:
    """The moment of the ground force about the centre of mass is integrated over the thrust; the force acts below the
    standing centre of mass. A jump whose usual lean suffices keeps it. With less support, the capture point of the
    pendulum is at the front of the feet as the thrust begins."""

    def turned(plan: JumpPlan) -> float:
        times = np.linspace(0.0, plan.thrust_time, 2001)
        moves = [plan.thrust(np.array([0.0, 0.0, 0.45]), time) for time in times]
        places, speeds = (np.array(each) for each in zip(*moves, strict=True))
        pushes = np.gradient(speeds, times, axis=0) + np.array([0.0, 0.0, GRAVITY])
        return float(np.trapezoid(pushes[:, 2] * places[:, 0] - pushes[:, 0] * places[:, 2], times))

    def low(lean: float) -> JumpPlan:
        return planned(JumpTarget(0.6, 0.1), support_ahead=0.4, lean=lean)

    lean = sufficient_lean(low, 0.09, 0.4, 0.45, GRAVITY)
    assert lean > 0.09 and turned(low(0.09)) < -0.15
    assert turned(low(lean)) == pytest.approx(0.0, abs=0.01)
    limited = low(sufficient_lean(low, 0.09, 0.25, 0.45, GRAVITY))
    place, speed = limited.crouch(np.zeros(3), limited.crouch_time)
    assert 0.09 < limited.lean < lean
    assert place[0] + speed[0] * np.sqrt(0.45 / GRAVITY) == pytest.approx(0.25)
    assert sufficient_lean(low, 0.09, 0.1, 0.45, GRAVITY) == 0.09

    def high(lean: float) -> JumpPlan:
        return planned(JumpTarget(0.6, 0.3), support_ahead=0.4, lean=lean)

    assert turned(high(0.09)) > 0.0 and sufficient_lean(high, 0.09, 0.4, 0.45, GRAVITY) == 0.09


@pytest.mark.parametrize(("behind", "is_longer"), [(0.2, False), (0.08, True)])
def test_a_crouch_pushes_from_the_rear_half_of_the_feet(behind: float, is_longer: bool) -> None:
    """The crouch accelerates the body at a constant rate. The ground force that passes through the centre of mass does
    so from at most half of the way back to the edge of the feet, if the crouch is long enough."""
    plan = planned(JumpTarget(0.5, 0.2), support_ahead=0.2, lean=0.075, support_behind=behind)
    usual = planned(JumpTarget(0.5, 0.2), support_ahead=0.2, lean=0.075)
    times = np.linspace(0.0, plan.crouch_time, 2001)
    forward = np.gradient(plan.crouch(np.zeros(3), times)[1][:, 0], times)
    assert np.allclose(forward, forward.mean(), rtol=1e-3)
    assert 0.45 * forward.mean() / GRAVITY <= 0.5 * behind
    assert (plan.crouch_time > usual.crouch_time) == is_longer
    if is_longer:
        assert 0.45 * forward.mean() / GRAVITY > 0.45 * behind


def test_a_given_lean_is_used() -> None:
    plan = planned(JumpTarget(0.5, 0.3), support_ahead=0.2, lean=0.09)
    assert plan.lean == 0.09


def test_a_crouch_continues_the_motion_of_the_last_landing() -> None:
    """The curve starts with the given position and velocity and ends as a crouch from rest; its velocity is its
    derivative."""
    plan = plan_jump(
        JumpTarget(0.5, 0.2), height=1.0, com_height=0.45, support_ahead=0.2, gravity=GRAVITY, step=STEP, lean=0.1
    )
    start, offset, velocity = np.array([0.1, 0.0, 0.45]), np.array([-0.03, 0.01, -0.04]), np.array([0.3, 0.1, -0.2])
    times = np.linspace(0.0, plan.crouch_time, 2001)
    places, speeds = plan.crouch(start, times, offset, velocity)
    assert places[0] == pytest.approx(start + offset) and speeds[0] == pytest.approx(velocity)
    for curve, rest in zip((places, speeds), plan.crouch(start, times), strict=True):
        assert curve[-1] == pytest.approx(rest[-1], abs=1e-12)
    assert np.allclose(np.gradient(places, times, axis=0)[1:-1], speeds[1:-1], atol=1e-5)
    moved = plan.planned_displacement(0.3, GRAVITY, offset, velocity)
    assert moved == pytest.approx(plan.crouch(start, 0.3, offset, velocity)[0] - start - offset)


@pytest.mark.parametrize("step", [1 / 30, 1 / 60, 1 / 90])
def test_a_crouch_ends_after_a_whole_number_of_steps(step: float) -> None:
    """If the last step of the crouch were shorter, the target velocity would jump at its end."""
    plan = planned(JumpTarget(0.5, 0.2), support_ahead=0.2, lean=0.1, step=step)
    steps = plan.crouch_time / step
    assert steps == pytest.approx(round(steps)) and 1.1 <= plan.crouch_time * np.sqrt(GRAVITY) < 1.1 + 3.2 * step
    for before, after in zip(plan.crouch(np.zeros(3), plan.crouch_time), plan.thrust(np.zeros(3), 0.0), strict=True):
        assert before == pytest.approx(after, abs=1e-12)


@pytest.mark.parametrize(("distance", "lags", "reaches"), [(0.4, False, True), (0.7, True, True), (1.6, True, False)])
def test_a_body_can_stop_without_the_landing_impulse(distance: float, lags: bool, reaches: bool) -> None:
    """The capture point of a linear inverted pendulum touches down within the reach of the feet. For that, the feet
    land farther ahead, at most ``max_lag``; a longer jump is planned at that distance, and so is every target beyond
    it."""
    reach, most, target = 0.15, 0.2, JumpTarget(distance, 0.2)
    usual, plan = planned(target), planned(target, landing_reach=reach, max_lag=most)
    capture = plan.speed_forward * np.sqrt(0.45 / GRAVITY) - plan.landing_lag
    assert capture < reach if not lags else capture == pytest.approx(reach)
    assert (plan == usual) == (not lags) and plan.speed_forward <= usual.speed_forward
    assert usual.distance == pytest.approx(distance) and plan.landing_lag <= most + 1e-12
    if reaches:
        assert plan.distance == pytest.approx(distance)
    else:
        farther = planned(JumpTarget(2.0 * distance, 0.2), landing_reach=reach, max_lag=most)
        assert plan.landing_lag == pytest.approx(most) and plan.distance == pytest.approx(farther.distance)


def test_feet_are_planned_where_flight_may_place_them() -> None:
    """If flight may not place the feet far enough ahead, the body relies on the impulse of the landing. A fall that is
    stopped gradually leaves the muscles time to brake."""
    target, far = JumpTarget(0.7, 0.2), JumpTarget(1.6, 0.2)
    assert planned(target, landing_reach=0.05, max_offset=0.0) == planned(target)
    limited = planned(far, landing_reach=0.05, max_offset=0.0, max_lag=0.2)
    assert limited.landing_lag == pytest.approx(0.2) and limited.distance < 1.5
    gradual = {"landing_time": 0.35 / np.sqrt(GRAVITY)}
    assert planned(target, landing_reach=0.1, **gradual) == planned(target, **gradual)


@pytest.mark.parametrize(("distance", "reach", "most", "time"), [(1.2, 0.5, 0.1, 0.0), (0.8, 0.15, 0.15, 0.35)])
def test_the_feet_land_at_most_max_lag_ahead(distance: float, reach: float, most: float, time: float) -> None:
    """If the capture point is within reach of the feet although they would land too far ahead, the body moves faster
    and still covers the distance; a bound that is just satisfied changes nothing."""
    target, options = JumpTarget(distance, 0.2), {"landing_reach": reach, "landing_time": time / np.sqrt(GRAVITY)}
    usual = planned(target, **options)
    plan = planned(target, max_lag=most, **options)
    assert usual.landing_lag > most + 0.01 and plan.landing_lag == pytest.approx(most)
    assert plan.distance == pytest.approx(distance) and plan.speed_forward > usual.speed_forward
    stop = stopping_time(0.45, _fall_speed(plan), GRAVITY, options["landing_time"]) if time else np.sqrt(0.45 / GRAVITY)
    assert plan.speed_forward * stop - most < reach
    assert planned(target, max_lag=usual.landing_lag, **options) == usual


def _fall_speed(plan: JumpPlan) -> float:
    """Return the speed of touch-down at the level of the start, m/s, without the half time step of the take-off."""
    return plan.speed_up - 0.5 * GRAVITY * STEP
