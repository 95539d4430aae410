"""Support polygon: margins and nearest points, compared with closed forms and an exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from egs_warp.motions.support import SupportPolygon, nearest_in_half_planes, overhang

TRIANGLE = SupportPolygon.hull(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0], [0.5, 0.5]]) + 100.0)


@given(st.integers(0, 1000))
def test_nearest_point_of_a_hull_is_the_best_convex_combination(seed: int) -> None:
    """The distance to the nearest point equals the distance to the closest convex combination of the points, found by
    SciPy."""
    rng = np.random.default_rng(seed)
    points, place = rng.standard_normal((8, 2)), 2.0 * rng.standard_normal(2)
    found = SupportPolygon.hull(points).nearest(place)
    best = minimize(
        lambda w: ((w @ points - place) ** 2).sum(),
        np.full(8, 1 / 8),
        jac=lambda w: 2.0 * points @ (w @ points - place),
        bounds=[(0, 1)] * 8,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0, "jac": lambda w: np.ones(8)},
        options={"ftol": 1e-14, "maxiter": 300},
    )
    assert np.linalg.norm(found - place) == pytest.approx(np.sqrt(best.fun), abs=1e-4)


def test_nearest_point_of_a_line() -> None:
    """For two points, the nearest point is on the segment between them or at one of its ends."""
    points = np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]])
    for place, nearest in (([1.0, 0.0], [0.5, 0.5]), ([3.0, 1.0], [1.0, 1.0]), ([-1.0, 0.0], [0.0, 0.0])):
        assert SupportPolygon.hull(points).nearest(np.array(place)) == pytest.approx(nearest)
    assert SupportPolygon.hull(points[1:2]).nearest(np.zeros(2)) == pytest.approx([1.0, 1.0])


def test_margins_of_a_triangle() -> None:
    """The triangle is far from the origin and has a right angle between two legs of 3 m. Its centroid is at (1, 1) m
    from the corner with the right angle: 1 m from two edges and sqrt(1/2) m from the third."""
    middle = np.array([101.0, 101.0])
    assert TRIANGLE.middle == pytest.approx(middle)
    assert TRIANGLE.margin(middle) == pytest.approx(np.sqrt(0.5))
    assert TRIANGLE.margin(np.array([97.0, 96.0])) == pytest.approx(-5.0)
    assert overhang(TRIANGLE.corners, np.array([97.0, 96.0])) == pytest.approx(5.0)
    assert overhang(TRIANGLE.corners, middle) == 0.0 and overhang(TRIANGLE.corners[:0], middle) == np.inf
    assert TRIANGLE.relative_distance(middle, 1e-3) == pytest.approx(0.0)
    assert TRIANGLE.relative_distance(middle - [0.5, 0.0], 1e-3) == pytest.approx(0.5)
    assert TRIANGLE.extent(np.array([1.0, 0.0])) == pytest.approx(103.0)
    assert TRIANGLE.extent(np.array([-0.6, -0.8])) == pytest.approx(-140.0)
    about = TRIANGLE.moved(-middle)
    assert about.distance_to_edge(np.array([-1.0, 0.0])) == pytest.approx(1.0)
    assert about.distance_to_edge(np.array([0.6, 0.8])) == pytest.approx(1.0 / 1.4)
    assert TRIANGLE.scaled(0.5).margin(middle) == pytest.approx(0.5 * np.sqrt(0.5))
    assert TRIANGLE.moved(np.array([0.0, 2.0])).margin(middle + [0.0, 2.0]) == pytest.approx(np.sqrt(0.5))


def test_the_bounding_box_of_staggered_feet_is_not_their_support() -> None:
    """The corner of the bounding box of two feet on a diagonal is outside their hull by its distance from the edge."""
    foot = np.array([[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]])
    support = SupportPolygon.hull(np.concatenate([foot + 0.5, foot - 0.5]))
    assert support.margin(np.array([0.6, -0.6])) == pytest.approx(-0.6 * np.sqrt(2.0) + 0.1 * np.sqrt(2.0))
    assert support.margin(np.zeros(2)) == pytest.approx(0.1 * np.sqrt(2.0))


def test_half_planes_without_area_have_a_nearest_point() -> None:
    normals = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    segment = nearest_in_half_planes(normals, np.array([0.0, 0.0, 0.2, 0.1]), np.array([1.0, 0.3]))
    assert segment == pytest.approx([0.0, 0.2])
    assert nearest_in_half_planes(normals, np.zeros(4), np.array([1.0, 0.3])) == pytest.approx([0.0, 0.0])
