"""The plan of a jump against flight, thrust and pendulum stepped through by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from egs_warp.motions.jump_plan import JumpTarget, plan_jump

GRAVITY, STEP = 9.81, 1 / 60


@pytest.mark.parametrize(
    "target", [JumpTarget(0.5, 0.3), JumpTarget(0.0, 0.4), JumpTarget(0.9, 0.35, 0.15), JumpTarget(0.5, 0.2)]
)
@pytest.mark.parametrize("height", [1.0, 1.7])
def test_a_body_that_does_as_planned_reaches_height_and_distance(target: JumpTarget, height: float) -> None:
    """Thrust and flight in implicit Euler steps, each at the speed of its end, and the landing as a linear inverted
    pendulum.
    """
    com_height, ahead = 0.45 * height, 0.2 * height
    plan = plan_jump(
        target,
        height=height,
        com_height=com_height,
        support_ahead=ahead,
        gravity=GRAVITY,
        step=STEP,
        lean=0.2 * target.distance,
    )

    # Thrust: from rest at the bottom of the crouch, a push that grows and then stays, to take-off stretched by the
    # extension; with pushes p over the way s it gains speed_up^2 / 2 = mean of p over s x way.
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
    deepest = 0.26 * com_height
    shallow = plan.crouch_depth < deepest
    assert 0.0 < plan.extension < target.height and plan.crouch_depth > 0.0
    # At 1.6 g, and harder where the crouch is as deep as the body can.
    if shallow:
        assert push == pytest.approx(1.6 * GRAVITY, rel=1e-6)
    else:
        assert plan.crouch_depth == pytest.approx(deepest) and push > 1.6 * GRAVITY

    # Flight: up to the asked height, down to where the stretched body stands on what it lands on.
    z, speed, apex, time = plan.extension, plan.speed_up, 0.0, 0.0
    while speed > 0.0 or z > plan.extension + target.rise:
        speed -= GRAVITY * STEP
        z, time = z + STEP * speed, time + STEP
        apex = max(apex, z)
    assert apex == pytest.approx(target.height, abs=GRAVITY * STEP**2)
    assert time == pytest.approx(plan.flight_time, abs=1.5 * STEP)

    # Way: the lean, half the speed while thrusting, all of it in flight; the rest is what the feet are put down ahead
    # of the body.
    way = plan.lean + plan.speed_forward * (0.5 * plan.thrust_time + plan.flight_time)
    assert way + plan.landing_lag == pytest.approx(target.distance, rel=1e-9)
    assert plan.lean == pytest.approx(0.2 * target.distance)

    # Landing: over feet 1.3 times as loaded as at rest the body comes to a stop. In a jump ahead they push from 0.3 of
    # the way to their front, which saves the body that much of its way.
    fall_rate = np.sqrt(1.3 * GRAVITY / com_height)
    pivot = plan.speed_forward / fall_rate - plan.landing_lag
    assert pivot == pytest.approx(0.3 * ahead if target.distance else 0.0, abs=1e-12)
    path = solve_ivp(
        lambda _, y: [y[1], fall_rate**2 * (y[0] - pivot)],
        (0.0, 5.0 / fall_rate),
        [-plan.landing_lag, plan.speed_forward],
        rtol=1e-10,
        atol=1e-12,
    )
    stopped = np.abs(path.y[:, -1] - [pivot, 0.0]) / np.maximum(np.abs(path.y[:, 0] - [pivot, 0.0]), 1e-9)
    assert stopped.max() < 1.01 * np.exp(-5.0)


def test_a_given_lean_is_kept() -> None:
    shared = {"height": 1.0, "com_height": 0.5, "support_ahead": 0.2}
    plan = plan_jump(JumpTarget(0.5, 0.3), **shared, gravity=GRAVITY, step=STEP, lean=0.09)
    assert plan.lean == 0.09
