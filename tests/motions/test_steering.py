"""Steered walks: the direction around other bodies and obstacles, and the command that turns the body to it."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.motions.steering import SPEED, free_direction, steering_command

GOAL = np.array([4.0, 0.0])


def direction(discs: list[tuple[list[float], list[float], float]], blocked: object = None) -> np.ndarray:
    """Return the direction in which to walk from the origin to ``GOAL`` at 0.3 m/s."""
    arrays = [(np.array(centre), np.array(velocity), apart) for centre, velocity, apart in discs]
    return free_direction(
        np.zeros(2),
        GOAL,
        arrays,
        (lambda point: False) if blocked is None else blocked,  # pyright: ignore[reportArgumentType]
        speed=0.3,
        height=1.0,
        horizon=4.0,
    )


def test_the_direct_way_is_taken_if_nothing_is_on_it() -> None:
    np.testing.assert_allclose(direction([([1.0, 2.0], [0.0, 0.0], 0.6)]), [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("offset", [0.2, -0.2])
def test_a_body_on_the_way_is_passed_on_the_shorter_side_with_the_required_distance(offset: float) -> None:
    x, y = direction([([1.0, offset], [0.0, 0.0], 0.6)])
    assert np.sign(y) == -np.sign(offset)
    # The line of the walk passes the other body at this distance.
    assert abs(x * offset - y) >= 0.58


def test_bodies_that_meet_both_keep_to_the_right() -> None:
    _, y = direction([([1.5, 0.0], [-0.3, 0.0], 0.6)])
    assert y < 0.0


def test_a_body_that_leaves_in_time_is_not_avoided() -> None:
    crossing = direction([([1.0, 0.0], [0.0, 0.6], 0.6)])
    assert direction([([1.0, 0.0], [0.0, 0.0], 0.6)])[1] != 0.0
    np.testing.assert_allclose(crossing, [1.0, 0.0], atol=0.2)


def test_an_obstacle_is_walked_round() -> None:
    ahead = direction([], lambda point: point[0] > 0.3 and point[1] > -0.2)
    assert ahead[1] < -0.3


def test_a_command_turns_on_the_spot_only_for_large_angles() -> None:
    turning, going = steering_command(0.0, np.array([0.0, 1.0])), steering_command(0.1, np.array([1.0, 0.0]))
    assert turning.forward == 0.0 and turning.turn > 0.0
    assert going.forward > 0.1 and going.turn < 0.0
    # The turn crosses the discontinuity of the angle at 180 degrees.
    assert steering_command(3.0, np.array([np.cos(-3.0), np.sin(-3.0)])).turn > 0.0


def test_eight_walkers_cross_a_circle_without_touching() -> None:
    """The walkers are discs that turn and move exactly as commanded. All of them reach the opposite side of the
    circle."""
    count, radius, touching, dt = 8, 1.5, 0.45, 0.1
    angles = 2.0 * np.pi * np.arange(count) / count
    at = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    goals, headings, before = -at, angles + np.pi, at.copy()
    speed_unit = 9.81**0.5
    for _ in range(300):
        velocities, before = (at - before) / dt, at.copy()
        for each in range(count):
            if np.linalg.norm(goals[each] - at[each]) < 0.05:
                continue
            others = [other for other in range(count) if other != each]
            discs = [(before[other], velocities[other], touching + 0.08) for other in others]
            heading = free_direction(
                before[each],
                goals[each],
                discs,
                lambda point: False,
                speed=SPEED * speed_unit,
                height=1.0,
                horizon=12.0 / speed_unit,
            )
            command = steering_command(headings[each], heading)
            headings[each] += dt * speed_unit * command.turn
            along = np.array([np.cos(headings[each]), np.sin(headings[each])])
            at[each] += dt * speed_unit * command.forward * along
        apart = np.linalg.norm(at[:, None] - at[None], axis=-1) + 10.0 * np.eye(count)
        assert apart.min() > touching
    assert np.linalg.norm(goals - at, axis=1).max() < 0.05
