"""Labels from masks: the closed form has the least error of all labellings, and uncertain votes are decided by
neighbours."""

from __future__ import annotations

from itertools import product
from unittest.mock import patch

import numpy as np
import pytest
from scipy import ndimage

from egs_warp.assets import scene
from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import depth_inside, distance_to
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.segmentation import labels as module
from egs_warp.segmentation.labels import labels_of_votes, smoothed_labels
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.selection_masks import masks_from_selection
from egs_warp.segmentation.votes import MaskedView, Votes, votes_of_masks
from tests.support.clicking import balls, click
from tests.support.grounds import level
from tests.support.scenes import FLOOR, lying, round_ones


def test_the_closed_form_has_the_least_error() -> None:
    """Compare with an exhaustive search over all 2^8 labellings. The sum over pixels of the absolute difference between
    mask and rendered labels is linear in the labels, because the weights in a pixel sum to at most one: each Gaussian
    adds its weight outside the mask if its label is 1, and its weight inside if it is 0.
    """
    random = np.random.default_rng(0)
    inside, outside = random.uniform(0.0, 5.0, (2, 8))
    wanted, unknown = labels_of_votes(Votes(inside, outside, inside + outside))
    costs = {labels: float(np.where(labels, outside, inside).sum()) for labels in product((False, True), repeat=8)}
    assert min(costs, key=lambda labels: costs[labels]) == tuple(wanted)
    assert not unknown.any()


def test_a_bias_makes_the_object_leaner_or_fuller() -> None:
    inside = np.array([1.0, 3.0, 5.0, 7.0, 9.0, 0.0])
    votes = Votes(inside, 10.0 - inside, np.full(6, 10.0))
    for bias, least in ((-0.5, 2.5), (0.0, 5.0), (0.5, 7.5)):
        np.testing.assert_array_equal(labels_of_votes(votes, background_bias=bias)[0], inside > least)
    with pytest.raises(UserError, match="no part of the capture is visible inside the masks"):
        labels_of_votes(Votes(np.zeros(6), np.ones(6), np.ones(6)))


@pytest.mark.slow
def test_rough_masks_of_three_views_segment_a_stool() -> None:
    """The outlines of the masks are off by up to three pixels. The graph cut corrects errors of the votes."""
    made = scene("stool")
    cloud, truth = made.whole()
    cameras = ring_cameras(made.plane, np.array([0.0, 0.0, 0.5]), 0.9, count=3, size=256)
    random, masks = np.random.default_rng(0), []
    for view in masks_from_selection(cloud, truth, cameras):
        waves = ndimage.gaussian_filter(random.normal(size=view.mask.shape), 6.0)
        edge = depth_inside(view.mask) - distance_to(view.mask)
        masks.append(MaskedView(view.camera, edge + 3.0 * waves / waves.std() > 0.0, view.name))
    votes = votes_of_masks(cloud, masks)
    wanted, unknown = labels_of_votes(votes)
    opacity, heights = cloud.opacities(), made.plane.heights(cloud.means.numpy())
    nodes = np.flatnonzero((opacity > 0.1) & (heights > 0.02))
    weight, right = opacity[nodes], truth[nodes]

    def overlap(labels: np.ndarray) -> float:
        return float(weight[labels & right].sum() / weight[labels | right].sum())

    assert overlap((wanted | unknown)[nodes]) < 0.9
    assert overlap(smoothed_labels(cloud, votes, nodes, views=3)) > 0.97
    found = segment(cloud, made.plane, ObjectSpec(masks=tuple(masks)))
    # The measured value is 0.9999. With the labels of the votes alone, it would be 0.9985, because the selection of
    # connected parts corrects most of their errors.
    assert overlap((found.object_mask | found.floater_mask)[nodes]) > 0.999


def test_the_confidence_of_a_vote_grows_with_the_root_of_its_pixels() -> None:
    """One of two similar neighbours is certainly outside. The vote for the other one to be inside has less weight than
    the link between them, so both are labelled outside. Nine times as many pixels have three times the weight.
    """
    pair = round_ones(np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]), 0.02)
    pixels, share = 9.0 * module._SURE, np.array([0.5 + 0.35 * module._SMOOTHNESS / 3.0, 0.0])
    for links, labels in ((1.0, [False, False]), (0.5, [True, False])):
        votes = Votes(pixels * share, pixels * (1.0 - share), np.full(2, pixels))
        with patch.object(module, "_SMOOTHNESS", links * module._SMOOTHNESS):
            assert smoothed_labels(pair, votes, np.arange(2)).tolist() == labels


@pytest.mark.parametrize(("pixels", "kept_out"), [(66.0, True), (4.0, False)])
def test_many_pixels_overrule_the_neighbours(pixels: float, kept_out: bool) -> None:
    """One Gaussian in a sheet of the object is 62 % outside the masks. With 66 pixels, its vote decides; with four, it
    may be due to the edge of the masks, and the neighbours decide.
    """
    cloud = lying(level((-0.3, -0.3), (0.3, 0.3), 0.5, 0.03))
    inside, outside = np.full(cloud.count, 20.0), np.zeros(cloud.count)
    middle = int(np.argmin(np.linalg.norm(cloud.means.numpy()[:, :2], axis=1)))
    inside[middle], outside[middle] = 0.38 * pixels, 0.62 * pixels
    votes = Votes(inside, outside, inside + outside)
    labels = smoothed_labels(cloud, votes, np.arange(cloud.count), views=18)
    assert labels[middle] != kept_out and labels.sum() >= cloud.count - 1


def test_masks_select_every_part_and_clicks_correct_them() -> None:
    """Two separate balls are masked and both become the object; a negative click removes one."""
    cloud = balls((0.0, 0.0), between=1.6)
    pair = np.arange(cloud.count) < 3000
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 1.5, count=3, size=128)
    masks = tuple(masks_from_selection(cloud, pair, cameras))
    clear = cloud.means.numpy()[:3000, 2] > 0.06
    found = segment(cloud, FLOOR, ObjectSpec(masks=masks))
    assert found.object_mask[:3000][clear].all()
    other = click(cloud, (0.8, -0.5, 0.5), inside=False)
    only = segment(cloud, FLOOR, ObjectSpec(masks=masks, clicks=(other,)))
    assert only.object_mask[:1500][clear[:1500]].all()
    assert only.object_mask[other.hits].sum() == 0
