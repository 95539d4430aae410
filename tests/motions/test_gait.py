"""Gait: the order in which feet swing, the progress of the body, and the swing of a foot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egs_warp.motions.gait import Gait, feet_in_turn
from egs_warp.motions.walk_posture import LEGGED_TIMING

GAIT = Gait.create(4, 4, 0.03, LEGGED_TIMING, time_unit=0.32)


@given(st.integers(2, 9))
def test_every_foot_swings_once_per_cycle_and_not_with_its_neighbour(count: int) -> None:
    """Neighbouring feet never swing together, and at least one foot stands at any time. Of four feet, those on a
    diagonal swing together."""
    groups = feet_in_turn(count)
    assert sorted(foot for group in groups for foot in group) == list(range(count))
    assert all(0 < len(group) < count for group in groups)
    for group in groups:
        apart = np.diff([*group, group[0] + count])
        assert len(group) == 1 or apart.min() > 1
    assert feet_in_turn(4) == ((0, 2), (1, 3)) and feet_in_turn(3) == ((0,), (1,), (2,))


@given(st.integers(2, 7), st.integers(1, 12))
def test_footprints_follow_each_other_and_close(feet: int, paces: int) -> None:
    """Each swing ends one step ahead of the previous one, and at the end all feet have made all steps."""
    gait = Gait.create(feet, paces, 0.03, LEGGED_TIMING, time_unit=0.3)
    at = np.zeros(feet)
    for swing in range(gait.swings):
        for foot in gait.swing_feet(swing):
            at[foot] = gait.target_step(swing)
        assert at.max() == min(swing + 1, paces)
    assert np.all(at == paces)


@given(st.integers(2, 7))
def test_the_progress_of_the_body_is_that_of_its_feet(feet: int) -> None:
    """Far from both ends of a walk, the progress of the body in the middle of a swing is the mean progress of all
    groups of feet, averaged over the times before and after the swing. It increases by one per swing."""
    gait = Gait.create(feet, 40, 0.03, LEGGED_TIMING, time_unit=0.3)
    swing, rounds = 20, len(gait.groups)
    before = np.mean([gait.target_step(swing - 1 - k) for k in range(rounds)])
    after = np.mean([gait.target_step(swing - k) for k in range(rounds)])
    assert gait.progress(swing, 0.5 * gait.swing_time) == pytest.approx(0.5 * (before + after))
    period = gait.swing_time + gait.double_time
    assert gait.progress(swing, period) == pytest.approx(gait.progress(swing + 1, 0.0))
    assert gait.progress(swing, period) - gait.progress(swing, 0.0) == pytest.approx(1.0)


def test_a_swinging_foot_leaves_and_lands_at_rest() -> None:
    """The height and the progress of a swing, and their rates by finite differences, are checked at both ends. The foot
    only moves forward, and it is lifted before it moves far.
    """
    near = 1e-4
    for end in (0.0, 1.0):
        inside = end + near * (1.0 - 2.0 * end)
        assert GAIT.foot_height(end) == pytest.approx(0.0, abs=1e-12) and GAIT.foot_height(inside) < 1e-5
        assert GAIT.transfer_progress(inside) == pytest.approx(end, abs=1e-12)
    progress = np.linspace(0.0, 1.0, 101)
    heights = np.array([GAIT.foot_height(s) for s in progress])
    ways = np.array([GAIT.transfer_progress(s) for s in progress])
    assert heights.max() == pytest.approx(GAIT.lift, rel=1e-3) and heights.min() >= 0.0
    assert np.all(np.diff(ways) >= 0.0)
    moving = (ways > 0.02) & (ways < 0.98)
    assert heights[moving].min() > 0.3 * GAIT.lift


def test_a_foot_is_steered_gradually_and_moves_only_when_lifted() -> None:
    """The weight of the steering objective is zero at the start of a swing and full before the foot moves far; the foot
    moves between the two given times."""
    steered = [GAIT.steering_progress(s) for s in (0.0, 0.1, 0.2, 0.3, 1.0)]
    assert steered[0] == 0.0 and steered[3:] == [1.0, 1.0] and np.all(np.diff(steered[:4]) > 0.0)
    assert GAIT.transfer_progress(GAIT.transfer_start_time / GAIT.swing_time) == 0.0
    assert GAIT.transfer_progress(GAIT.transfer_end_time / GAIT.swing_time) == pytest.approx(1.0)
    assert (
        0.0 < GAIT.transfer_progress(0.5 * (GAIT.transfer_start_time + GAIT.transfer_end_time) / GAIT.swing_time) < 1.0
    )
