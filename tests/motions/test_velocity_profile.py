"""Velocity profiles: from rest to rest along a path, within the speed limit, slower at corners; velocities are
derivatives of positions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egs_warp.motions.velocity_profile import VelocityProfile

SPEED, PUSH = 0.6, 0.5
CORNER = np.array([[0.0, 0.0], [0.8, 0.0], [0.8, 0.6]])
_POINTS = st.lists(st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)), min_size=2, max_size=6)


@given(_POINTS)
def test_from_rest_to_rest_within_the_bounds(points: list[tuple[float, float]]) -> None:
    way = np.array(points)
    table = VelocityProfile.from_path(way, speed=SPEED, acceleration=PUSH)
    start, end = table.at(-1.0), table.at(table.seconds + 1.0)
    assert start.position == pytest.approx(way[0]) and end.position == pytest.approx(way[-1], abs=1e-9)
    assert not start.velocity.any() and not end.velocity.any() and not end.acceleration.any()
    moments = [table.at(time) for time in np.linspace(0.0, table.seconds, 400)]
    speeds = np.array([np.linalg.norm(moment.velocity) for moment in moments])
    assert speeds.max() <= SPEED + 1e-9
    assert max(np.linalg.norm(moment.acceleration) for moment in moments) <= PUSH + 1e-6
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
    assert table.length == pytest.approx(lengths[lengths > 1e-12].sum(), abs=1e-9)


def test_velocity_and_acceleration_are_the_slopes_of_place_and_velocity() -> None:
    table, step = VelocityProfile.from_path(CORNER, speed=SPEED, acceleration=PUSH), 1e-6
    for time in np.linspace(0.05, 0.95, 19) * table.seconds:
        before, at, after = (table.at(time + k * step) for k in (-1, 0, 1))
        assert (after.position - before.position) / (2.0 * step) == pytest.approx(at.velocity, abs=1e-5)
        assert (after.velocity - before.velocity) / (2.0 * step) == pytest.approx(at.acceleration, abs=1e-5)


def test_a_right_angle_is_passed_at_rest_and_a_straight_path_at_full_speed() -> None:
    table = VelocityProfile.from_path(CORNER, speed=SPEED, acceleration=PUSH)
    corner = np.argmin(np.linalg.norm(table.points - CORNER[1], axis=1))
    assert table.speeds[corner] == pytest.approx(0.0, abs=1e-9)
    straight = VelocityProfile.from_path(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), speed=SPEED, acceleration=PUSH)
    assert straight.speeds[np.argmin(abs(straight.points[:, 0] - 1.0))] == pytest.approx(SPEED)
    # The duration of a trapezoidal profile is distance / speed, plus speed / acceleration for start and stop.
    assert straight.seconds == pytest.approx(2.0 / SPEED + SPEED / PUSH, rel=0.03)


def test_a_path_of_zero_length_takes_no_time() -> None:
    table = VelocityProfile.from_path(np.zeros((2, 2)), speed=SPEED, acceleration=PUSH)
    assert table.seconds == 0.0 and table.length == 0.0 and not table.at(0.5).position.any()
