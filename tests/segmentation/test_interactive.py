"""Interactive segmentation by clicks, on two balls on a floor."""

from __future__ import annotations

import time

import numpy as np
import pytest

from egs_warp.geometry.gaussians import concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.interactive import ClickGraph, segment_by_clicks
from tests.support.clicking import balls, click
from tests.support.grounds import level
from tests.support.scenes import lying, round_ones

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
LEFT, RIGHT = (-0.5, -0.5, 0.5), (0.5, -0.5, 0.5)
EACH = 1500


def shares(chosen: np.ndarray) -> tuple[float, float, float]:
    """Return the selected fractions of the left ball, the right ball and the floor."""
    return float(chosen[:EACH].mean()), float(chosen[EACH : 2 * EACH].mean()), float(chosen[2 * EACH :].mean())


@pytest.fixture(scope="module")
def touching() -> ClickGraph:
    """Create two touching balls of different greys."""
    return ClickGraph.of(balls((-0.6, 0.9)))


def test_a_click_lights_up_its_ball_and_not_the_one_that_touches_it(touching: ClickGraph):
    left, right, floor = shares(segment_by_clicks(touching, [click(touching.cloud, LEFT)], FLOOR))
    assert left > 0.85 and right < 0.02 and floor < 0.01


def test_a_second_click_adds_and_a_click_beside_removes(touching: ClickGraph):
    on_left, on_right = (click(touching.cloud, point) for point in (LEFT, RIGHT))
    left, right, _ = shares(segment_by_clicks(touching, [on_left, on_right], FLOOR))
    assert left > 0.85 and right > 0.85
    off_right = click(touching.cloud, RIGHT, inside=False)
    left, right, _ = shares(segment_by_clicks(touching, [on_left, off_right], FLOOR))
    assert left > 0.85 and right < 0.02


def test_a_click_beside_removes_a_wrong_part_of_a_proposal(touching: ClickGraph):
    both = np.arange(touching.cloud.count) < 2 * EACH
    clicks = [click(touching.cloud, LEFT), click(touching.cloud, RIGHT, inside=False)]
    left, right, floor = shares(segment_by_clicks(touching, clicks, FLOOR, proposal=both))
    assert left > 0.85 and right < 0.05 and floor < 0.01
    left, right, _ = shares(segment_by_clicks(touching, clicks[1:], FLOOR, proposal=both))
    assert left > 0.85 and right < 0.05


def test_the_hits_of_clicks_are_hard_constraints(touching: ClickGraph):
    on_left, off_right = click(touching.cloud, LEFT), click(touching.cloud, RIGHT, inside=False)
    chosen = segment_by_clicks(touching, [on_left, off_right], FLOOR)
    assert chosen[on_left.hits].all() and not chosen[off_right.hits].any()


def test_of_opposite_clicks_on_one_place_the_later_one_counts(touching: ClickGraph):
    plus, minus = (click(touching.cloud, LEFT, inside=inside) for inside in (True, False))
    right = click(touching.cloud, RIGHT)
    assert shares(segment_by_clicks(touching, [plus, right, minus], FLOOR))[0] < 0.05
    assert shares(segment_by_clicks(touching, [minus, right, plus], FLOOR))[0] > 0.85


def test_nothing_is_chosen_without_a_click_on_the_object(touching: ClickGraph):
    assert not segment_by_clicks(touching, [], FLOOR).any()
    assert not segment_by_clicks(touching, [click(touching.cloud, LEFT, inside=False)], FLOOR).any()


def test_a_higher_ground_cuts_the_object(touching: ClickGraph):
    ground = Plane(np.array([0.0, 0.0, 1.0]), -0.4)
    chosen = segment_by_clicks(touching, [click(touching.cloud, (-0.5, -0.4, 0.8))], ground)
    heights = ground.heights(touching.means[chosen])
    assert chosen.any() and np.quantile(heights, 0.01) > 0.0


def test_the_result_does_not_depend_on_the_unit_or_the_frame():
    cloud = balls((-0.6, 0.9))
    expected = segment_by_clicks(ClickGraph.of(cloud), [click(cloud, LEFT)], FLOOR)
    larger = cloud.scaled(1000.0)
    hit = click(cloud, LEFT)
    again = segment_by_clicks(
        ClickGraph.of(larger), [type(hit)(1000.0 * hit.point, hit.hits, hit.inside)], FLOOR.scaled(1000.0)
    )
    assert (again != expected).mean() < 0.002


def test_faint_and_coincident_gaussians_are_no_problem():
    skin = np.repeat(np.random.default_rng(0).normal(size=(40, 3)), 30, axis=0)
    skin = 0.5 * skin / np.linalg.norm(skin, axis=1, keepdims=True) + [0.0, 0.0, 0.5]
    cloud = concatenate(round_ones(skin, 0.1), lying(level((-2.0, -1.5), (2.0, 1.5), 0.0, 0.1)))
    graph = ClickGraph.of(cloud)
    assert graph.cluster.min() == 0 and graph.links.count == graph.cluster.max() + 1
    chosen = segment_by_clicks(graph, [click(cloud, (0.0, -0.5, 0.5))], FLOOR)
    assert chosen[: len(skin)].any() and not chosen[len(skin) :].any()


@pytest.mark.slow
def test_three_hundred_thousand_gaussians_take_less_than_two_seconds_for_each_click():
    skin = np.random.default_rng(0).normal(size=(150_000, 3))
    skin = 0.5 * skin / np.linalg.norm(skin, axis=1, keepdims=True) + [0.0, 0.0, 0.5]
    cloud = concatenate(round_ones(skin, 0.004), lying(level((-2.0, -1.5), (2.0, 1.5), 0.0, 0.009)))
    assert cloud.count > 290_000
    graph = ClickGraph.of(cloud)
    hit = click(cloud, (0.0, -0.5, 0.5))
    # Processor time is measured, because it does not depend on the load of the machine.
    started = time.process_time()
    chosen = segment_by_clicks(graph, [hit], FLOOR)
    assert time.process_time() - started < 2.0
    assert chosen[: len(skin)].mean() > 0.95


def test_floaters_far_from_an_object_do_not_belong_to_it():
    """Floaters whose nearest neighbours are Gaussians of the ball are not selected with it, because empty space
    separates them."""
    random = np.random.default_rng(0)
    floaters = random.uniform((-0.9, -0.4, 1.3), (-0.1, 0.4, 1.8), (8, 3))
    beside = np.array([[0.5, 1.6, 0.4], [0.5, -1.6, 0.4]])
    scene = balls((-0.6, 0.9))
    cloud = concatenate(scene, round_ones(np.concatenate([floaters, beside]), 0.02))
    graph = ClickGraph.of(cloud)
    for point, ball in ((LEFT, 0), (RIGHT, 1)):
        chosen = segment_by_clicks(graph, [click(cloud, point)], FLOOR)
        assert shares(chosen[: scene.count])[ball] > 0.85
        assert not chosen[scene.count :].any()
