"""Gait: footprints, the way of the centre of mass and the swing of a foot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from egs_warp.motions.gait import Gait, Passage, nearest_in_hull

GAIT = Gait.of(4, 0.1, height=1.0, gravity=9.81)


@given(st.integers(1, 12), st.floats(0.02, 0.3))
def test_footprints_alternate_and_close(steps: int, length: float) -> None:
    """Each step sets a pair one step length ahead of the other,
    the last swing closes the feet at the whole distance.
    """
    gait = Gait.of(steps, length, height=0.7, gravity=9.81)
    pairs = [0.0, 0.0]
    for swing in range(gait.swings):
        pairs[swing % 2] = gait.landing(swing)
        ahead = pairs[swing % 2] - pairs[1 - swing % 2]
        assert ahead == pytest.approx(0.0 if swing == steps else length)
    assert pairs == pytest.approx([gait.distance] * 2) and gait.distance == pytest.approx(steps * length)


def test_the_centre_of_mass_moves_evenly_and_is_over_the_standing_pair_in_mid_swing() -> None:
    """One line through all swings; in the middle of swing k the other pair stands at landing(k - 1)."""
    period = GAIT.swing_time + GAIT.double_time
    for swing in range(GAIT.swings):
        standing = GAIT.landing(swing - 1) if swing else 0.0
        assert GAIT.place(swing, 0.5 * GAIT.swing_time) == pytest.approx(standing)
        assert GAIT.place(swing, period) == pytest.approx(GAIT.place(swing + 1, 0.0))
    assert (GAIT.place(1, 0.1) - GAIT.place(1, 0.0)) / 0.1 == pytest.approx(GAIT.speed)


def test_a_swinging_foot_leaves_and_lands_at_rest() -> None:
    """Height and way by differences at both ends;
    it is highest inside, goes forward only, and is up before it goes far.
    """
    near = 1e-4
    for end in (0.0, 1.0):
        inside = end + near * (1.0 - 2.0 * end)
        assert GAIT.lifted(end) == pytest.approx(0.0, abs=1e-12) and GAIT.lifted(inside) < 1e-5
        assert GAIT.carried(inside) == pytest.approx(end, abs=1e-12)
    progress = np.linspace(0.0, 1.0, 101)
    heights = np.array([GAIT.lifted(s) for s in progress])
    ways = np.array([GAIT.carried(s) for s in progress])
    assert heights.max() == pytest.approx(GAIT.lift, rel=1e-3) and heights.min() >= 0.0
    assert np.all(np.diff(ways) >= 0.0)
    moving = (ways > 0.02) & (ways < 0.98)
    assert heights[moving].min() > 0.3 * GAIT.lift


def test_a_foot_is_steered_bit_by_bit_and_goes_ahead_only_when_it_is_up() -> None:
    """Not at all where the swing begins, wholly before it is carried far; carried between the two times that are
    told."""
    steered = [GAIT.eased(s) for s in (0.0, 0.1, 0.2, 0.3, 1.0)]
    assert steered[0] == 0.0 and steered[3:] == [1.0, 1.0] and np.all(np.diff(steered[:4]) > 0.0)
    assert GAIT.carried(GAIT.carried_from / GAIT.swing_time) == 0.0
    assert GAIT.carried(GAIT.carried_until / GAIT.swing_time) == pytest.approx(1.0)
    assert 0.0 < GAIT.carried(0.5 * (GAIT.carried_from + GAIT.carried_until) / GAIT.swing_time) < 1.0


def test_a_passage_meets_its_ends() -> None:
    """Places and velocities at both ends; the velocity is the rate of the place; outside it stays at the ends."""
    rng = np.random.default_rng(0)
    start, start_velocity, end, end_velocity = rng.standard_normal((4, 2))
    passage = Passage(start, start_velocity, end, end_velocity, 0.7)
    for elapsed, place, velocity in ((0.0, start, start_velocity), (0.7, end, end_velocity), (9.0, end, end_velocity)):
        got = passage.at(elapsed)
        assert np.allclose(got[0], place) and np.allclose(got[1], velocity)
    rate = (passage.at(0.3 + 1e-6)[0] - passage.at(0.3 - 1e-6)[0]) / 2e-6
    assert np.allclose(rate, passage.at(0.3)[1], atol=1e-6)


@given(st.integers(0, 1000))
def test_nearest_point_of_a_hull_is_the_best_convex_combination(seed: int) -> None:
    """Against a slow twin: the closest weighted mean of the points."""
    rng = np.random.default_rng(seed)
    points, place = rng.standard_normal((8, 2)), 2.0 * rng.standard_normal(2)
    found = nearest_in_hull(points, place)
    best = minimize(
        lambda w: ((w @ points - place) ** 2).sum(),
        np.full(8, 1 / 8),
        jac=lambda w: 2.0 * points @ (w @ points - place),
        bounds=[(0, 1)] * 8,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0, "jac": lambda w: np.ones(8)},
        options={"ftol": 1e-14, "maxiter": 300},
    )
    assert np.linalg.norm(found - place) == pytest.approx(np.sqrt(best.fun), abs=1e-4)
