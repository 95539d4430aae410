"""Masks from clicks that are propagated from view to view, and detection of masks of other objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.io import read_capture, write_ply
from egs_warp.io.cameras import write_cameras
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.segmentation.clicks import click_at
from egs_warp.segmentation.mask_model import SalientModel
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.propagated_masks import (
    _in_sight,
    _innermost,
    _propagate_mask,
    _well_apart,
    masks_of_clicks,
    salient_masks,
)
from egs_warp.segmentation.selection_masks import masks_from_selection
from tests.support.click_network import alike
from tests.support.clicking import balls
from tests.support.scenes import FLOOR

TONES = (-1.0, 1.2)


class ByTone:
    """Mask model that marks pixels as dark as the first point, and records its inputs."""

    def __init__(self) -> None:
        self.asked: list[tuple[np.ndarray, np.ndarray]] = []

    def mask(self, picture: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
        self.asked.append((points, inside))
        u, v = points[0].astype(int)
        return np.abs(picture - picture[v, u]).max(axis=2) < 0.08


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 1.2, count=10, size=160)


def pixel_of(camera: Camera, point: tuple[float, float, float]) -> tuple[float, float]:
    x, y, z = camera.rotation @ np.array(point) + camera.translation
    return camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z


@pytest.mark.slow
def test_one_click_is_marked_in_every_view_and_cuts_touching_balls(cameras: list[Camera]) -> None:
    """With a network, a click on one of two touching balls selects this ball completely; without one, the click selects
    both."""
    cloud = balls(TONES)
    camera = next(one for one in cameras if one.centre[1] < -1.0 and abs(one.centre[0]) < 1.5)
    click = click_at(cloud, camera, *pixel_of(camera, (-0.5, -0.45, 0.6)))
    assert click is not None and click.camera is camera
    model, told = ByTone(), []
    masks = masks_of_clicks(cloud, [click], cameras, model, count=6, progress=lambda done, of: told.append((done, of)))
    assert 4 <= len(masks) <= 6 and len({id(mask.camera) for mask in masks}) == len(masks)
    np.testing.assert_allclose(model.asked[0][0][0], click.pixel)
    assert told == [(k, 6) for k in range(7)]
    found = locate_plane(cloud, ObjectSpec(masks=tuple(masks), clicks=(click,)), up=FLOOR.normal).segmentation
    assert found.object_mask[:1500].mean() > 0.97 and found.object_mask[1500:].mean() < 0.01
    alone = locate_plane(cloud, ObjectSpec.of_clicks([click]), up=FLOOR.normal).segmentation
    assert alone.object_mask[1500:3000].mean() > 0.9


def test_a_view_that_marks_another_object_is_left_out(cameras: list[Camera]) -> None:
    cloud = balls(TONES)
    click = click_at(cloud, cameras[0], *pixel_of(cameras[0], (-0.5, 0.0, 0.9)))
    assert click is not None

    class OnceEverything(ByTone):
        def mask(self, picture: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
            mask = super().mask(picture, points, inside)
            return {2: mask | True, 3: mask & False}.get(len(self.asked), mask)

    masks = masks_of_clicks(cloud, [click], cameras, OnceEverything(), count=5)
    assert len(masks) == 3 and all(0.01 < mask.mask.mean() < 0.2 for mask in masks)


@pytest.mark.parametrize(("times", "fits"), [(2.9, True), (3.1, False)])
def test_a_mask_three_times_as_large_is_rejected(cameras: list[Camera], times: float, fits: bool) -> None:
    """The network marks the region of the first mask enlarged by ``times`` about its centre."""
    cloud = balls(TONES)
    (first,) = masks_from_selection(cloud, np.arange(cloud.count) < 1500, cameras[:1])
    places = np.indices(first.mask.shape).transpose(1, 2, 0)
    away = np.linalg.norm(places - places[first.mask].mean(axis=0), axis=2)

    class Swollen(ByTone):
        def mask(self, picture: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
            return away <= np.partition(away.ravel(), round(times * first.mask.sum()))[round(times * first.mask.sum())]

    found = _propagate_mask(cloud, [first], [], cameras[0], Swollen())
    assert (found is not None) is fits


def test_negative_clicks_are_passed_on_where_they_are_visible(cameras: list[Camera]) -> None:
    cloud = balls(TONES)
    on, off = (click_at(cloud, cameras[0], *pixel_of(cameras[0], (x, 0.0, 0.95)), inside=x < 0) for x in (-0.5, 0.5))
    assert on is not None and off is not None
    model = ByTone()
    masks_of_clicks(cloud, [on, off], cameras, model, count=4)
    points, inside = model.asked[0]
    assert inside.tolist() == [True, False] and len(points) == 2
    # In the other views, it is hidden.
    assert any(not inside.all() for _, inside in model.asked[1:])
    below = [np.array([-0.5, 0.0, 0.5]), off.point]
    np.testing.assert_allclose(_in_sight(cloud, below, cameras[0]), [pixel_of(cameras[0], tuple(off.point))], atol=1e-9)


def test_clicks_without_a_result_are_reported(cameras: list[Camera]) -> None:
    cloud = balls(TONES)
    beside = click_at(cloud, cameras[0], *pixel_of(cameras[0], (0.5, 0.0, 0.9)), inside=False)
    on = click_at(cloud, cameras[0], *pixel_of(cameras[0], (-0.5, 0.0, 0.9)))
    assert beside is not None and on is not None
    with pytest.raises(UserError, match="the network needs a click on the object"):
        masks_of_clicks(cloud, [beside], cameras, ByTone())

    class Blind(ByTone):
        def mask(self, picture: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
            return np.zeros(picture.shape[:2], bool)

    with pytest.raises(UserError, match="the network finds nothing at the click"):
        masks_of_clicks(cloud, [on], cameras, Blind())


def test_prompt_points() -> None:
    """The points are the innermost pixels of the regions, the largest region first; thin lines have none."""
    mask = np.zeros((60, 100), bool)
    mask[5:46, 5:46], mask[10:31, 60:81], mask[50, 10:90] = True, True, True
    places = _innermost(mask, 3)
    assert places.tolist() == [[25.5, 25.5], [70.5, 20.5]]
    assert _innermost(np.zeros((5, 5), bool), 3).shape == (0, 2)


def test_cameras_well_apart_in_small_steps(cameras: list[Camera]) -> None:
    chosen = _well_apart(cameras[:1], cameras, 4)
    assert len({id(one) for one in chosen}) == 4 and all(one is not cameras[0] for one in chosen)
    everyone = np.array([one.centre for one in [cameras[0], *chosen]])
    gaps = np.linalg.norm(everyone[:, None] - everyone[None], axis=2) + 9.0 * np.eye(5)
    steps = [gaps[k, :k].min() for k in range(1, 5)]
    assert gaps.min() > 0.8 and steps[0] == pytest.approx(gaps[0].min())
    assert len(_well_apart(cameras[:1], cameras, 99)) == 9


def test_the_object_salient_in_most_views_is_selected(cameras: list[Camera]) -> None:
    cloud = balls(TONES)
    seen: list[np.ndarray] = []

    class Dark(SalientModel):
        def mask(self, picture: np.ndarray) -> np.ndarray:
            seen.append(picture)
            other = len(seen) == 3
            mask = picture.mean(axis=2) < 0.35
            return np.roll(mask, 60, axis=1) if other else mask

    model = Dark.__new__(Dark)
    masks = salient_masks(cloud, cameras, model, count=6)
    assert len(seen) == 6 and len(masks) == 5
    found = locate_plane(cloud, ObjectSpec(masks=tuple(masks)), up=FLOOR.normal).segmentation.object_mask
    assert found[:1500].mean() > 0.95 and found[1500:].mean() < 0.01

    class Nothing(Dark):
        def mask(self, picture: np.ndarray) -> np.ndarray:
            return np.ones(picture.shape[:2], bool)

    with pytest.raises(UserError, match="nothing is salient in the pictures; click on the object"):
        salient_masks(cloud, cameras, Nothing.__new__(Nothing))


@pytest.mark.slow
def test_a_mask_model_at_the_command_line(
    tmp_path: Path, cameras: list[Camera], capsys: pytest.CaptureFixture[str]
) -> None:
    """One click and the file of a network select the ball; without a click, there is a one-line error."""
    write_ply(tmp_path / "scene.ply", balls(TONES))
    write_cameras(tmp_path / "cameras.json", cameras, [f"photo{k}.png" for k in range(len(cameras))])
    (tmp_path / "alike.onnx").write_bytes(alike(threshold=0.02))
    u, v = pixel_of(cameras[0], (-0.5, 0.0, 0.9))
    shared = ["--cameras", str(tmp_path / "cameras.json"), "--mask-model", str(tmp_path / "alike.onnx"), "--up", "z"]
    shared += ["--straddling", "none", "--flat", "--out", str(tmp_path / "parts")]
    assert main(["segment", str(tmp_path / "scene.ply"), "--object", f"+{u},{v}@photo0", *shared]) == 0
    thing = read_capture(tmp_path / "parts" / "object.ply").cloud
    assert 1400 < thing.count <= 1500 and thing.means.numpy()[:, 0].max() < 0.05
    assert (
        main(["segment", str(tmp_path / "scene.ply"), "--object=-0.5,0,0.5", *shared[:-1], str(tmp_path / "no")]) == 2
    )
    assert "alike.onnx: it needs clicks and no other object; give only --object +u,v@photo" in capsys.readouterr().err
    assert main(["segment", str(tmp_path / "scene.ply"), "--object", "salient", "--out", str(tmp_path / "no")]) == 2
    assert "--object salient: needs cameras; give --cameras" in capsys.readouterr().err
