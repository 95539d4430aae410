"""Energy of clicks on a few supervoxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.click_energy import (
    ClickScene,
    Evidence,
    consistent,
    minimise,
    residuals_of_labels,
    shared_colours,
)
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.surface_graph import SurfaceGraph

Colour = tuple[float, float, float]
RED, GREEN, BLUE = (0.8, 0.2, 0.1), (0.1, 0.6, 0.2), (0.1, 0.2, 0.7)


def row_of(colours: list[Colour], area: list[float], lengths: list[float]) -> ClickScene:
    """Return supervoxels in a row, with links of the ``lengths`` between neighbours that cost nothing to cut."""
    first, count = np.arange(len(lengths), dtype=np.int32), len(colours)
    links = SplatGraph(count, first, first + 1, np.array(lengths), np.zeros(len(lengths)))
    cloud = GaussianCloud.from_numpy(
        np.zeros((1, 3)), np.eye(4)[:1], np.zeros((1, 3)), np.zeros(1), np.zeros((1, 1, 3)), device="cpu"
    )
    zero = np.zeros(count)
    return ClickScene(
        SurfaceGraph.of(cloud), links, links, zero, zero, zero, zero, zero, np.array(colours), np.array(area)
    )


@pytest.mark.parametrize(("far", "belongs"), [(BLUE, True), (RED, False)])
def test_a_colour_is_evidence_unless_it_is_common_around_the_object(far: Colour, belongs: bool) -> None:
    """The small second supervoxel is rather far from the click. It belongs to the object, which is red like it, unless
    the far surroundings are also red."""
    scene = row_of([RED, RED, far, GREEN], [4.0, 1.0, 4.0, 9.0], [])
    log_odds, nothing = np.array([3.0, -1.0, -5.0, -5.0]), np.zeros(4, bool)
    evidence = Evidence(np.arange(4) == 0, nothing, np.zeros((4, 5)), log_odds, np.ones(4, bool))
    chosen = minimise(scene, evidence)
    assert chosen[1] == belongs and not chosen[2:].any()


@pytest.mark.parametrize(("next_to_it", "expected"), [(RED, 0.25), (BLUE, 0.0)])
def test_colours_are_shared_with_the_surroundings_only_along_the_surface(next_to_it: Colour, expected: float) -> None:
    """The object is the first supervoxel. The last one is red like it, but is separated from it by a green one."""
    scene = row_of([RED, next_to_it, GREEN, RED], [4.0, 1.0, 4.0, 9.0], [0.1] * 3)
    evidence = Evidence(
        np.arange(4) == 0, np.zeros(4, bool), np.zeros((4, 5)), np.array([3.0, -1.0, -5.0, -5.0]), np.ones(4, bool)
    )
    assert shared_colours(scene, evidence, np.arange(4) == 0) == pytest.approx(expected)


def test_a_click_beside_the_object_acts_along_the_surface_up_to_a_barrier() -> None:
    row = row_of([RED] * 5, [1.0] * 5, [0.1] * 4)
    first, other = (np.array([0]), True), (np.array([4]), False)
    before, after = (row.evidence(clicks).log_odds for clicks in ([first], [first, other]))
    assert (before > 3.0).all() and after[4] < 0.0 and (np.diff(after) < 0.0).all()
    barred = replace(row, barriers=replace(row.links, length=np.array([0.1, 5.0, 0.1, 0.1])))
    after = barred.evidence([first, other]).log_odds
    assert after[:2] == pytest.approx(before[:2], abs=0.01) and (after[3:] < 0.0).all()


def test_the_residuals_are_the_labels_minus_their_probabilities() -> None:
    random = np.random.default_rng(0)
    root, mean, labels = random.normal(size=(6, 6)), 4.0 * random.normal(size=6), np.arange(6) % 2
    covariance = 50.0 * root @ root.T
    residuals = residuals_of_labels(mean, covariance, labels)
    assert residuals == pytest.approx(labels - 1.0 / (1.0 + np.exp(-mean - covariance @ residuals)), abs=1e-6)


def test_a_label_that_the_mean_predicts_changes_little() -> None:
    changes = [100.0 * residuals_of_labels(np.array([mean]), np.array([[100.0]]), np.zeros(1))[0] for mean in (-4, 4)]
    assert -2.0 < changes[0] < 0.0 and changes[1] < -6.0


def test_the_first_click_on_the_object_is_first_and_later_clicks_take_precedence() -> None:
    plus, minus, both = np.array([0, 1]), np.array([1, 2]), np.array([2, 3])
    clicks = consistent([(minus, False), (plus, True), (both, False)], 4)
    assert [(hits.tolist(), inside) for hits, inside in clicks] == [([0, 1], True), ([2], False), ([2, 3], False)]
    assert consistent([(plus, True), (plus, False)], 4) == []
