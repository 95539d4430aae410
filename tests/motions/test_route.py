"""End points of routes, and limits on the length and the turn of each step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egs_warp.errors import UserError
from egs_warp.motions.route import StepLimits, path_route, read_path, straight_route, turn_route

PACE = StepLimits(0.1, 0.25)


@given(st.floats(-3.0, 3.0))
def test_straight_on_in_even_paces(distance: float) -> None:
    places = straight_route(distance)(PACE)
    assert places[-1] == pytest.approx([distance, 0.0, 0.0]) and places[0] == pytest.approx(np.zeros(3))
    steps = np.diff(places[:, 0])
    assert np.ptp(steps) < 1e-12 and abs(steps).max() <= PACE.length + 1e-12
    assert len(steps) == max(np.ceil(abs(distance) / PACE.length - 1e-9), 1)


@given(st.floats(-7.0, 7.0))
def test_turns_on_the_spot_in_even_paces(angle: float) -> None:
    places = turn_route(angle)(PACE)
    assert np.all(places[:, :2] == 0.0) and places[-1, 2] == pytest.approx(angle)
    assert abs(np.diff(places[:, 2])).max() <= PACE.turn + 1e-12


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_a_point_is_reached_in_any_direction(ahead: float, left: float) -> None:
    """The route ends at the point, and each step except the last one is along the heading. In each of these steps, the
    length and the turn, as fractions of their limits, add up to at most 1."""
    places = path_route(np.array([[ahead, left]]))(PACE)
    assert places[-1, :2] == pytest.approx([ahead, left], abs=1e-8)
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps[:, :2], axis=1)
    assert lengths.max() <= PACE.length + 1e-9 and abs(steps[:, 2]).max() <= PACE.turn + 1e-9
    assert np.all(lengths[:-1] / PACE.length + abs(steps[:-1, 2]) / PACE.turn <= 1.0 + 1e-9)
    ways = np.stack([np.cos(places[1:-1, 2]), np.sin(places[1:-1, 2])], axis=1)
    assert np.einsum("ki,ki->k", steps[:-1, :2], ways) == pytest.approx(lengths[:-1], abs=1e-9)


def test_a_path_is_followed_past_its_points() -> None:
    """The route passes each point within the length of a step and is only slightly longer than the path."""
    points = np.array([[0.5, 0.0], [0.9, 0.3], [0.9, 0.8]])
    places = path_route(points)(PACE)
    for point in points:
        assert np.linalg.norm(places[:, :2] - point, axis=1).min() <= PACE.length
    assert places[-1, :2] == pytest.approx(points[-1])
    assert np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1).sum() < 1.55


def test_a_path_of_too_many_steps_is_refused() -> None:
    with pytest.raises(UserError, match="walk: the path takes more than 400 steps; choose a shorter one"):
        path_route(np.array([[9.0, 0.0]]))(StepLimits(0.01, 0.25))


def test_paths_are_read_with_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "way.csv"
    path.write_text("ahead,left\n# a bend\n0.5,0\n\n0.9, 0.3\n")
    assert read_path(path) == pytest.approx(np.array([[0.5, 0.0], [0.9, 0.3]]))
    for text, message in (
        ("", "no points; give lines of two numbers"),
        ("ahead,left\n", "no points; give lines of two numbers"),
        ("0.5,0\n0.6\n", "line 2: '0.6': give two numbers, ahead and left in body heights"),
        ("0.5,0\n0.6,x\n", "line 2: '0.6,x': give two numbers"),
        ("0.5,nan\n", "line 1: '0.5,nan': give two numbers"),
        ("0.5,0\n3,0\n", "line 2: the path jumps by 2.5 body heights; give points at most 1 apart"),
        ("7,0\n", "line 1: the path jumps by 7 body heights"),
    ):
        path.write_text(text)
        with pytest.raises(UserError) as error:
            read_path(path)
        assert message in str(error.value) and "\n" not in str(error.value)
