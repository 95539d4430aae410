"""Background that follows from the framing of the photos: few photos show it, so it is cut from the clicked object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.framing import with_framing
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.votes import MaskedView
from tests.support.grounds import level, sheet
from tests.support.scenes import FLOOR, lying, round_ones, shell

BALL = 1500
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def against_wall() -> GaussianCloud:
    """Create a ball that touches a long wall behind it, both on a floor."""
    wall = level((-4.0, 0.03), (4.0, 2.0), 0.5, 0.06)[:, [0, 2, 1]]
    ball = sheet(shell(BALL), 2.0 * (shell(BALL) - [0.0, 0.0, 0.5]), 0.045, (0.8, 0.2, 0.1))
    floor = lying(level((-4.0, -2.0), (4.0, 0.5), 0.0, 0.06))
    return concatenate(ball, sheet(wall, np.tile([0.0, -1.0, 0.0], (len(wall), 1)), 0.06, (0.3, 0.5, 0.6)), floor)


def photos(count: int, target: float = 0.0) -> list[Camera]:
    """Return cameras in an arc in front of the wall that look at the position ``target`` along it."""
    middle = np.array([target, 0.0, 0.5])
    angles = np.radians(np.linspace(-140.0, -40.0, count))
    eyes = [middle + 3.0 * np.array([np.cos(angle), np.sin(angle), 0.3]) for angle in angles]
    return [Camera.look_at(eye, middle, UP, width=64, height=48, vertical_fov_degrees=30.0) for eye in eyes]


def test_a_wall_behind_the_object_is_cut_off(against_wall: GaussianCloud) -> None:
    """The wall is connected to the ball, so a point alone selects both. Its ends are in few photos, so it is cut
    off."""
    alone = ObjectSpec(point=np.array([0.0, -0.5, 0.5]))
    wall = np.zeros(against_wall.count, bool)
    wall[BALL:] = against_wall.means.numpy()[BALL:, 2] > 0.1
    ball = (np.arange(against_wall.count) < BALL) & (against_wall.means.numpy()[:, 2] > 0.1)
    both = segment(against_wall, FLOOR, alone).object_mask
    assert both[ball].mean() > 0.99 and both[wall].mean() > 0.95
    found = segment(against_wall, FLOOR, with_framing(against_wall, alone, photos(9))).object_mask
    assert found[ball].mean() > 0.97 and found[wall].mean() < 0.02


def test_only_what_few_photos_show_is_hit(against_wall: GaussianCloud) -> None:
    """Only photos that show the object's point count. The negative click that is added hits Gaussians far from the
    object."""
    spec = ObjectSpec.of_clicks([Click(np.array([0.0, -0.5, 0.5]), np.arange(5))])
    framed = with_framing(against_wall, spec, photos(9))
    assert framed.clicks[:-1] == spec.clicks and not framed.clicks[-1].inside
    away = np.linalg.norm(against_wall.means.numpy()[framed.clicks[-1].hits] - [0.0, 0.0, 0.5], axis=1)
    assert away.min() > 0.8 and len(away) > 0.5 * (against_wall.count - BALL)
    elsewhere = with_framing(against_wall, spec, [*photos(9), *photos(30, target=3.5)])
    np.testing.assert_array_equal(elsewhere.clicks[-1].hits, framed.clicks[-1].hits)


def test_an_object_that_stands_alone_is_unchanged(against_wall: GaussianCloud) -> None:
    free = against_wall.subset((np.arange(against_wall.count) < BALL) | (against_wall.means.numpy()[:, 1] < 0.49))
    spec = ObjectSpec(point=np.array([0.0, -0.5, 0.5]))
    framed = with_framing(free, spec, photos(9))
    assert len(framed.clicks) == 2
    np.testing.assert_array_equal(segment(free, FLOOR, framed).object_mask, segment(free, FLOOR, spec).object_mask)


def test_framing_says_nothing(against_wall: GaussianCloud) -> None:
    """The clicks are unchanged with few photos, with masks, and if every photo shows the whole scene."""
    spec = ObjectSpec(point=np.array([0.0, -0.5, 0.5]))
    assert with_framing(against_wall, spec, photos(7)) is spec
    mask = MaskedView(photos(1)[0], np.ones((48, 64), bool), "photo")
    masked = replace(spec, point=None, masks=(mask,))
    assert with_framing(against_wall, masked, photos(9)) is masked
    ball = round_ones(shell(200), 0.03)
    assert with_framing(ball, spec, photos(9)) is spec
