"""Targets of hops on a row of squares, for a block that is posed by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid, step
from egs_warp.geometry.plane import Plane
from egs_warp.motions.hop import Hop, HopOutcome, HopTargets
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import sole_shares
from tests.support.stances import DT, FLOOR, FORWARD, moved


def test_hops_aim_at_squares_from_where_the_feet_are(place: Stance) -> None:
    """A hop that is too short and to the side is compensated by the next one; a square on a step gets a higher jump."""
    height = place.body.height
    row = HopTargets(0.7, 0.2, 3, {"distance": 0.7})
    begin = [part.begin for part in row.parts()]
    first = begin[0](place)
    assert isinstance(first, Hop) and first.jump.target.distance == pytest.approx(0.7)
    feet = sole_shares(place.body, place.ground, place.standing) @ place.standing
    assert np.allclose(first.square, feet + [0.7, 0.0, 0.0])
    again = begin[1](place.moved_to(moved(place, 0.0, np.array([0.6, 0.1, 0.0]))))
    assert isinstance(again, Hop) and again.jump.target.distance == pytest.approx(np.hypot(0.8, 0.1))
    assert np.allclose(again.jump.ground.axes[0] * np.hypot(0.8, 0.1), [0.8, -0.1, 0.0])
    assert again.miss(moved(place, 0.0, np.array([1.43, 0.04, 0.2]))) == pytest.approx(0.05)

    stair = step(FLOOR, np.array([0.4, 0.0, 0.0]), FORWARD, 0.2 * height)
    stairs = Stance(place.body, place.ground, place.standing, place.contact_points, DT, (Solid((FLOOR,)), stair))
    up = HopTargets(0.7, 0.2, 1, {}).parts()[0].begin(stairs)
    assert isinstance(up, Hop) and up.jump.target.rise == pytest.approx(0.2 * height)
    assert up.jump.target.height == pytest.approx(0.2 + 0.2 * height)
    assert up.jump.plan.flight_time < first.jump.plan.flight_time + np.sqrt(2 * 0.2 * height / 9.81)
    assert up.jump.plan.speed_up > first.jump.plan.speed_up


@pytest.mark.parametrize("pauses", [False, True])
def test_the_body_rests_only_after_the_last_hop(place: Stance, pauses: bool) -> None:
    """A hop that is followed by another one ends sooner."""
    begin = [part.begin for part in HopTargets(0.7, 0.2, 3, {}, pauses=pauses).parts()]
    times = [begin[k](place.moved_to(moved(place, 0.0, np.array([0.7 * k, 0.0, 0.0])))).expected_time for k in range(3)]
    assert times[0] == pytest.approx(times[1])
    assert times[2] == pytest.approx(times[0]) if pauses else times[2] > times[0] + 0.3 * place.body.time_unit


def test_squares_continue_from_the_planned_landing_of_a_shortened_hop(place: Stance) -> None:
    """Each hop requests 2 m, also if the ground ends there. The miss is relative to the request."""
    table = Solid((FLOOR, Plane(FORWARD, -1.6)))
    begin = [part.begin for part in HopTargets(2.0, 0.1, 2, {}).parts()]
    first = begin[0](replace(place, solids=(table,)))
    assert isinstance(first, Hop) and 0.5 < first.jump.target.distance < 1.4
    reached = first.jump.target.distance
    landed = moved(place, 0.0, np.array([reached - 0.1, 0.0, 0.0]))
    trajectory: Any = SimpleNamespace(positions=landed[None])
    outcome = first.outcome_record(trajectory, 0, 0)
    assert isinstance(outcome, HopOutcome) and outcome.target_error == pytest.approx((2.1 - reached) / 2.0)
    second = begin[1](place.moved_to(landed))
    assert isinstance(second, Hop) and second.square[0] == pytest.approx(first.square[0] + reached)
    assert "instead of 2.10 body heights" in second.notes()[0]
