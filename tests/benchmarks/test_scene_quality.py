"""Measures of the scene quality benchmark: outlines, overlap, click positions, and planes through marked points."""

from __future__ import annotations

import json
from types import ModuleType

import numpy as np
import pytest

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from tests.support.grounds import level
from tests.support.scenes import lying, round_ones, shell
from tests.support.scripts import BENCHMARKS, module_of

NAMES = ("koala", "fox", "narcissus", "playbot", "bonsai")
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def annotated(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("annotated_scenes")


@pytest.fixture
def clicking(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("clicking")


@pytest.fixture
def ground(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("room_ground")


def front() -> Camera:
    return Camera.look_at(np.array([0.0, -5.0, 2.0]), np.array([0.0, 0.0, 0.4]), UP, width=120, height=120)


@pytest.mark.parametrize("name", NAMES)
def test_every_scene_has_eight_outlines_and_marked_points(name: str, annotated: ModuleType) -> None:
    tree = json.loads((annotated.FOLDER / f"{name}.json").read_text())
    assert len(tree["views"]) == 8 and len({view["name"] for view in tree["views"]}) == 8
    assert name in annotated.NAMES
    for view in tree["views"]:
        mask = annotated._mask(view)
        assert mask.shape == (view["height"], view["width"])
        assert 0.03 < mask.mean() < 0.4
        ground = np.array(view["ground"])
        assert len(ground) >= 6
        assert not mask[ground[:, 1], ground[:, 0]].any(), "the ground is next to the object"


def test_outlines_within_outlines_are_holes(annotated: ModuleType) -> None:
    ring = {"width": 20, "height": 20, "outline": [[0, 0, 15, 0, 15, 15, 0, 15], [5, 5, 10, 5, 10, 10, 5, 10]]}
    mask = annotated._mask(ring)
    assert mask[2, 2] and not mask[7, 7] and not mask[18, 18]


def test_overlap_counts_missing_and_excess_pixels(annotated: ModuleType, clicking: ModuleType) -> None:
    """Compare the selected Gaussians of a ball with its own outline, and with an outline shifted by 8 pixels."""
    ball = round_ones(shell(), 0.03)
    cloud = concatenate(ball, lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.05)))
    camera = front()
    own = clicking.render_gaussians(ball, camera).alpha.numpy() > 0.5
    view = annotated.DrawnView(camera, own, np.zeros((0, 2)))
    iou, missing, more = clicking.overlap(cloud, ball, view)
    assert iou == 1.0 and not missing.any() and not more.any()
    shifted = np.roll(own, 8, axis=1)
    iou, missing, more = clicking.overlap(cloud, ball, annotated.DrawnView(camera, shifted, np.zeros((0, 2))))
    both = (own & shifted).sum()
    # Where the shifted outline covers the sky, the capture is empty, and pixels are ignored.
    assert both / (own | shifted).sum() <= iou < 1.0
    assert more.sum() == (own & ~shifted).sum() and 0 < missing.sum() <= (shifted & ~own).sum()


def test_overlap_ignores_hidden_pixels(annotated: ModuleType, clicking: ModuleType) -> None:
    """Pixels that are annotated as hidden count neither as superfluous nor as missing; without the annotation, they are
    superfluous."""
    ball = round_ones(shell(), 0.03)
    camera = front()
    own = clicking.render_gaussians(ball, camera).alpha.numpy() > 0.5
    left = np.indices(own.shape)[1] < 60
    view = annotated.DrawnView(camera, own & ~left, np.zeros((0, 2)), own & left)
    iou, missing, more = clicking.overlap(ball, ball, view)
    assert iou == 1.0 and not missing.any() and not more.any()
    half = annotated.DrawnView(camera, own & ~left, np.zeros((0, 2)))
    iou, _, more = clicking.overlap(ball, ball, half)
    assert iou < 0.6 and (more == (own & left)).all()


def test_prompts_are_at_the_innermost_pixel(clicking: ModuleType) -> None:
    mask = np.zeros((60, 80), bool)
    mask[10:31, 20:61] = True
    depth, (u, v) = clicking.innermost(mask)
    assert depth == 11.0 and v == 20.5 and 30.0 <= u <= 51.0
    assert clicking.innermost(np.zeros((5, 5), bool))[0] == 0.0


def test_a_marked_plane_and_how_far_it_is_from_another(annotated: ModuleType, ground: ModuleType) -> None:
    cloud: GaussianCloud = lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.05))
    pixels = np.array([[30.0, 70.0], [90.0, 70.0], [60.0, 90.0], [40.0, 85.0], [80.0, 85.0], [60.0, 65.0]])
    view = annotated.DrawnView(front(), np.zeros((120, 120), bool), pixels)
    plane = ground.marked_plane(cloud, [view], UP)
    degrees, offset = ground.apart(plane, Plane(UP, 0.0), np.zeros(3), 1.0)
    assert degrees < 0.05 and offset < 0.001
    tilted = Plane(np.array([np.sin(0.02), 0.0, np.cos(0.02)]), -0.05)
    degrees, offset = ground.apart(tilted, Plane(UP, 0.0), np.zeros(3), 2.0)
    assert degrees == pytest.approx(np.degrees(0.02), rel=1e-6) and offset == pytest.approx(0.025)


def test_ground_is_judged_by_its_known_errors(ground: ModuleType) -> None:
    known = {"how": "ground", "degrees": 0.9, "offset": 0.004}
    real = {"how": "ground", "degrees": 3.0, "offset": 0.01, "markings_degrees": 1.6, "markings_offset": 0.006}
    assert ground.judged_ground([known, real, {"how": "masks", "iou": 0.1}])
    assert not ground.judged_ground([known | {"offset": 0.006}])
    assert not ground.judged_ground([real | {"degrees": 3.3}])
    assert not ground.judged_ground([real | {"offset": 0.013}])
