"""Clicks: Gaussians that they hit, parts that they add, and the cut between object and background."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.io import read_cameras
from egs_warp.io.cameras import write_cameras
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.pipelines.object_selection import read_object
from egs_warp.segmentation.above_plane import SceneAbovePlane, clicked_parts, detached_parts
from egs_warp.segmentation.clicks import Click, click_at, describe_click
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.clicking import balls, click, front
from tests.support.grounds import level
from tests.support.scenes import FLOOR, ball_on_floor, lying, round_ones, shell


def test_a_click_hits_the_front_surface() -> None:
    """A click on a hollow ball in front of a wall hits the near side of the ball; a click on empty pixels hits
    nothing."""
    skin = shell(400)
    wall = np.stack(np.meshgrid(np.linspace(-2, 2, 60), [3.0], np.linspace(-1, 3, 60)), axis=-1).reshape(-1, 3)
    cloud = round_ones(np.concatenate([skin, wall]), 0.04)
    found = click(cloud, (0.0, -0.5, 0.5))
    np.testing.assert_allclose(found.point, [0.0, -0.5, 0.5], atol=0.05)
    assert len(found.hits) and (found.hits < 400).all()
    assert (np.linalg.norm(cloud.means.numpy()[found.hits] - [0.0, -0.5, 0.5], axis=1) < 0.2).all()
    assert click_at(round_ones(skin, 0.04), front(), 3.0, 3.0) is None


def test_haze_in_front_of_the_surface_is_not_hit() -> None:
    """A Gaussian just in front of the surface is not hit if its opacity is a fiftieth of the opacity of the surface,
    but is hit if the opacities are equal."""
    skin = round_ones(shell(400), 0.04)
    for opacity, hit in ((-4.0, False), (3.0, True)):
        logits = np.append(skin.opacity_logits.numpy(), np.float32(opacity))
        means = np.concatenate([skin.means.numpy(), [[0.0, -0.52, 0.5]]])
        turns, scales = np.tile([1.0, 0.0, 0.0, 0.0], (401, 1)), np.full((401, 3), np.log(0.04))
        cloud = GaussianCloud.from_numpy(means, turns, scales, logits, np.zeros((401, 1, 3)))
        assert (400 in click(cloud, (0.0, -0.5, 0.5)).hits) is hit


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_click_is_a_disc_about_its_pixel(axis: int, sign: float) -> None:
    """At the edge of a sheet, on any side, more than half of the disc shows the sheet, so the click hits it. Three
    pixels outside the edge, it does not.
    """
    eye, up = np.array([0.0, -5.0, 0.0]), np.array([0.0, 0.0, 1.0])
    camera = Camera.look_at(eye, np.zeros(3), up, width=1000, height=1000)
    pixel = 5.0 / camera.fx
    points = level((-0.5 * pixel, -0.2), (0.2, 0.2), 0.0, 0.005)[:, [0, 2, 1] if axis == 0 else [1, 2, 0]]
    cloud = round_ones(sign * points + 0.5 * pixel * np.array([1.0, 0.0, -1.0]), 0.003)
    for off, hit in ((0.0, True), (-3.0, False)):
        u, v = 500.5 + off * sign * np.array([1.0, 0.0] if axis == 0 else [0.0, -1.0])
        assert (click_at(cloud, camera, u, v) is not None) is hit


def test_a_click_hits_gaussians_at_about_the_same_depth() -> None:
    """Five Gaussians lie along the ray. The click hits the Gaussian that contributes most to the pixel, and those whose
    distance differs from its distance by at most 3 %."""
    camera = front()
    steps, opacities = np.array([4.5, 4.9, 5.0, 5.1, 5.6]), np.array([0.12, 0.12, 0.6, 0.6, 0.9])
    means = camera.centre + steps[:, None] * camera.rotation[2]
    turns, scales = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)), np.full((5, 3), np.log(0.1))
    cloud = GaussianCloud.from_numpy(means, turns, scales, np.log(opacities / (1.0 - opacities)), np.zeros((5, 1, 3)))
    found = click_at(cloud, camera, camera.cx, camera.cy)
    assert found is not None and found.hits.tolist() == [1, 2, 3]
    assert (found.point - camera.centre) @ camera.rotation[2] == pytest.approx(5.0)


@pytest.mark.parametrize("opacity, hit", [(0.27, 1), (0.4, 0)])
def test_a_click_selects_a_surface_that_contributes_twice_as_much_as_the_one_in_front(opacity: float, hit: int) -> None:
    """A small Gaussian, which is too small for haze, lies in front of an opaque one. Of the pixel, they contribute
    their opacity, and 0.95 of the rest."""
    camera = front()
    opacities = np.array([opacity, 0.95])
    means = camera.centre + np.array([[4.0], [5.0]]) * camera.rotation[2]
    turns, scales = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), np.full((2, 3), np.log(0.1))
    cloud = GaussianCloud.from_numpy(means, turns, scales, np.log(opacities / (1.0 - opacities)), np.zeros((2, 1, 3)))
    found = click_at(cloud, camera, camera.cx, camera.cy)
    assert found is not None and found.hits.tolist() == [hit]


def test_a_click_that_just_misses_selects_the_nearest_part() -> None:
    """A part is selected only within a tenth of the object's size from the click. A click that hits Gaussians selects
    the part that contains most of them."""
    parts = np.repeat([0, 1, 2], [1500, 1500, 100])
    places = [shell() - [0.7, 0.0, 0.0], shell() + [0.7, 0.0, 0.0], 0.1 * shell(100) + [0.0, 0.9, 0.0]]
    scene, indices = SceneAbovePlane.of(round_ones(np.concatenate(places), 0.02), FLOOR), np.arange(3100)

    def meant(point: tuple[float, float, float], hits: list[int]) -> list[int]:
        at = Click(np.array(point), np.array(hits, int))
        return clicked_parts(indices, parts, scene, [at], 1.7).tolist()

    assert meant((-0.7, -0.65, 0.5), []) == [0] and meant((0.7, -0.65, 0.5), []) == [1]
    assert meant((0.0, 0.8, 0.1), []) == [2] and meant((0.7, -0.75, 0.5), []) == []
    assert meant((-0.7, -0.65, 0.5), [1600, 1601, 3050]) == [1]


@pytest.mark.parametrize("opacity, through", [(0.2, True), (0.9, False)])
def test_faint_gaussians_before_the_object_are_ignored(opacity: float, through: bool) -> None:
    """Three wide, flat Gaussians lie in front of the ball: if they are faint, the ball is hit; if they are opaque, they
    are."""
    skin = round_ones(shell(400), 0.04)
    means = np.concatenate([skin.means.numpy(), [[0.0, y, 0.5] for y in (-1.2, -1.0, -0.8)]])
    scales = np.concatenate([skin.log_scales.numpy(), np.log([[0.8, 0.002, 0.8]] * 3)])
    logits = np.append(skin.opacity_logits.numpy(), [np.log(opacity / (1.0 - opacity))] * 3)
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (403, 1))
    found = click(GaussianCloud.from_numpy(means, turns, scales, logits, np.zeros((403, 1, 3))), (0.0, -0.5, 0.5))
    assert bool((found.hits < 400).all()) is through
    assert found.point[1] == pytest.approx(-0.5 if through else -1.2, abs=0.05)


@pytest.mark.parametrize("tones", [(-1.0, 1.0), (0.0, 0.0)])
def test_a_negative_click_cuts_off_a_touching_ball(tones: tuple[float, float]) -> None:
    """One click selects both of two touching balls; a negative click then removes the other ball, for all colours."""
    cloud = balls(tones)
    mine = click(cloud, (-0.5, -0.5, 0.5))
    both = segment(cloud, FLOOR, ObjectSpec.of_clicks([mine]))
    clear = cloud.means.numpy()[:3000, 2] > 0.06
    assert both.object_mask[:3000][clear].all()
    other = click(cloud, (0.5, -0.5, 0.5), inside=False)
    # Within 0.05 of the point of contact, two balls of one colour cannot be separated.
    clear &= np.abs(cloud.means.numpy()[:3000, 0]) > 0.05
    for clicks in ([mine, other], [other, mine]):
        found = segment(cloud, FLOOR, ObjectSpec.of_clicks(clicks))
        assert found.object_mask[:1500][clear[:1500]].all()
        assert not found.object_mask[1500:3000][clear[1500:]].any()
        assert found.background_mask[1500:3000][clear[1500:]].all()
        assert found.size == pytest.approx(np.sqrt(3.0), rel=0.15)


def test_a_click_adds_a_separate_part() -> None:
    cloud = balls((0.0, 0.0), between=1.6)
    first, second = click(cloud, (-0.8, -0.5, 0.5)), click(cloud, (0.8, -0.5, 0.5))
    clear = cloud.means.numpy()[:3000, 2] > 0.06
    alone = segment(cloud, FLOOR, ObjectSpec.of_clicks([first]))
    assert alone.object_mask[:1500][clear[:1500]].all() and not alone.object_mask[1500:3000].any()
    pair = segment(cloud, FLOOR, ObjectSpec.of_clicks([first, second]))
    assert pair.object_mask[:3000][clear].all()


def test_a_negative_click_on_the_floor_removes_nothing() -> None:
    cloud, _ = ball_on_floor()
    mine, floor = click(cloud, (0.0, -0.5, 0.5)), click(cloud, (0.0, -0.9, 0.0), inside=False)
    one = segment(cloud, FLOOR, ObjectSpec.of_clicks([mine]))
    two = segment(cloud, FLOOR, ObjectSpec.of_clicks([mine, floor]))
    np.testing.assert_array_equal(one.object_mask, two.object_mask)
    assert two.background_mask[floor.hits].all()


def test_negative_clicks_on_a_ball_and_on_the_floor() -> None:
    """Two negative clicks together remove the Gaussians that each of them removes alone."""
    cloud = balls((-1.0, 1.0))
    mine, floor = click(cloud, (-0.5, -0.5, 0.5)), click(cloud, (-0.5, -0.9, 0.0), inside=False)
    other = click(cloud, (0.5, -0.5, 0.5), inside=False)
    one = segment(cloud, FLOOR, ObjectSpec.of_clicks([mine, other]))
    for clicks in ([mine, other, floor], [mine, floor, other]):
        two = segment(cloud, FLOOR, ObjectSpec.of_clicks(clicks))
        np.testing.assert_array_equal(one.object_mask, two.object_mask)
        assert two.background_mask[floor.hits].all()


def test_detached_parts_in_the_air_are_added_and_standing_ones_are_not() -> None:
    """A small part in the air less than two cells from the ball belongs to the ball; a part at the same distance on the
    floor does not."""
    random = np.random.default_rng(3)
    leaf = random.uniform(-0.06, 0.06, (60, 3))
    gap = 0.045
    hanging, standing = leaf + [0.56 + gap, 0.0, 0.5], leaf * [1, 1, 1.5] + [0.0, 0.62, 0.09]
    things = round_ones(np.concatenate([shell(), hanging, standing]), 0.012)
    cloud = concatenate(things, lying(level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.05)))
    found = segment(cloud, FLOOR, ObjectSpec.of_clicks([click(cloud, (0.0, -0.5, 0.5))]))
    assert found.object_mask[1500:1560].all()
    assert not found.object_mask[1560:1620].any()


def test_detached_parts_belong_to_a_near_object() -> None:
    """A detached part belongs to the object if it is at most two cells (of 64 across the object) away and does not
    reach the floor.
    """
    thing, leaf = shell(800), np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])
    size = 1.7
    near, far = (leaf + [0.5 + gap * size, 0.0, 0.5] for gap in (1.6 / 64.0, 2.6 / 64.0))
    low = leaf + thing[np.argmin(np.abs(thing[:, 2] - 0.05))] * [1.08, 1.08, 1.0]
    scene = SceneAbovePlane.of(round_ones(np.concatenate([thing, near, far + [0, 0, 0.3], low]), 0.01), FLOOR)
    parts = np.repeat([0, 1, 2, 3], [800, 2, 2, 2])
    assert detached_parts(scene, np.arange(806), parts, np.array([0]), size).tolist() == [1]


@pytest.mark.parametrize(
    ("count", "post", "goes_along"), [(200, None, True), (30, None, False), (200, 1.15, False), (200, 1.6, True)]
)
def test_a_detached_hand_belongs_to_the_nearest_object(count: int, post: float | None, goes_along: bool) -> None:
    """A detached hand near a ball belongs to the ball, unless it has few Gaussians, or a post is nearer than twice the
    distance of the ball.
    """
    random = np.random.default_rng(5)
    skin = random.normal(size=(count, 3))
    hand = 0.1 * skin / np.linalg.norm(skin, axis=1, keepdims=True) + [0.8, 0.0, 0.6]
    parts = [shell(), hand]
    if post is not None:
        angle, height = np.meshgrid(np.linspace(0.0, 6.2, 16), np.linspace(0.03, 1.2, 30))
        parts.append(
            np.column_stack([post + 0.05 * np.cos(angle.ravel()), 0.05 * np.sin(angle.ravel()), height.ravel()])
        )
    things = round_ones(np.concatenate(parts), 0.02)
    cloud = concatenate(things, lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.05)))
    found = segment(cloud, FLOOR, ObjectSpec.of_clicks([click(cloud, (0.0, -0.5, 0.5))]), size=1.7)
    assert found.object_mask[1500 : 1500 + count].mean() == float(goes_along)
    assert not found.object_mask[1500 + count : things.count].any()


def test_the_plane_is_below_the_lowest_click() -> None:
    """A ball lies on a slab on a floor. With a second click, on the side of the slab, the plane is the floor."""
    across, up_to = np.meshgrid(np.linspace(-0.9, 0.9, 46), np.linspace(0.0, 0.4, 11))
    side = np.column_stack([np.full(across.size, 0.9), across.ravel(), up_to.ravel()])
    slab = [level((-0.9, -0.9), (0.9, 0.9), 0.4, 0.04), *(side * [sign, 1, 1] for sign in (-1, 1))]
    slab += [one[:, [1, 0, 2]] for one in slab[1:]]
    cloud = concatenate(
        round_ones(np.concatenate([shell() + [0.0, 0.0, 0.4], *slab]), 0.025),
        lying(level((-3.0, -3.0), (3.0, 3.0), 0.0, 0.06)),
    )
    up = np.array([0.0, 0.0, 1.0])
    spec = ObjectSpec.of_clicks([click(cloud, (0.0, -0.5, 0.9)), click(cloud, (0.0, -0.9, 0.2))])
    located = locate_plane(cloud, spec, up=up)
    assert abs(located.plane.offset) < 0.02
    assert located.segmentation.object_mask[:1500].mean() > 0.99


def test_clicks_as_the_user_writes_them(tmp_path: Path) -> None:
    cloud, _ = ball_on_floor()
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.8, count=2, size=64)
    write_cameras(tmp_path / "cameras.json", cameras, ["a 1.jpg", "b.jpg"])
    posed = read_cameras(tmp_path / "cameras.json")
    spec = read_object(["+32,32@b", "-32,60@a 1.jpg", "30,28@1"], cloud, posed)
    assert [one.inside for one in spec.clicks] == [True, False, True]
    assert [describe_click(one) for one in spec.clicks] == ["+32,32@b", "-32,60@a 1.jpg", "30,28@1"]
    assert describe_click(replace(spec.clicks[1], text=None, pixel=(1032.25, 60.0))) == "-1032.25,60"
    assert spec.point is not None
    np.testing.assert_array_equal(spec.point, spec.clicks[0].point)
    np.testing.assert_allclose(np.linalg.norm(spec.point - [0.0, 0.0, 0.5]), 0.5, atol=0.03)
    with_box = read_object(["-1,-1,0,1,1,2", "-32,60@b"], cloud, posed)
    assert with_box.box is not None and with_box.point is None and len(with_box.clicks) == 1
    for texts, message in (
        (["-32,60@b"], "every click removes something; click on the object itself"),
        (["+32,32@c"], r"object \+32,32@c: no such camera; the 2 cameras are"),
        (["+1,1@b"], r"object \+1,1@b: no Gaussian is visible at this pixel"),
        (["+64,1@b"], "outside of the 64 x 64 pixels of the view"),
        (["+1.2.3,1@b"], r"1\.2\.3,1 is not a pixel"),
        (["0,0,1", "0,0,2"], "object: 2 objects are given, 0,0,1 and others; give one, and correct it with clicks"),
    ):
        with pytest.raises(UserError, match=message):
            read_object(texts, cloud, posed)
    with pytest.raises(UserError, match="a pixel needs cameras"):
        read_object("+32,32@b", cloud, [])


def test_a_negative_click_on_a_shadow_keeps_the_foot() -> None:
    """A tongue of floor, 0.05 high, is connected to the ball's foot. A negative click on the tip of the tongue removes
    its outer half and keeps the ball, although the positive click is as far from the foot.
    """
    across, out = np.meshgrid(np.linspace(-0.12, 0.12, 9), np.linspace(-0.72, -0.2, 19))
    tongue = [np.column_stack([across.ravel(), out.ravel(), np.full(across.size, z)]) for z in (0.03, 0.05)]
    things = round_ones(np.concatenate([shell(), *tongue]), 0.025)
    cloud = concatenate(things, lying(level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.05)))
    top, tip = click(cloud, (0.0, -0.35, 0.85)), click(cloud, (0.0, -0.7, 0.06), inside=False)
    along = segment(cloud, FLOOR, ObjectSpec.of_clicks([top]))
    found = segment(cloud, FLOOR, ObjectSpec.of_clicks([top, tip]))
    outer = np.flatnonzero(cloud.means.numpy()[: things.count, 1] < -0.6)
    assert along.object_mask[outer].mean() > 0.9
    assert found.object_mask[outer].mean() < 0.05
    high = cloud.means.numpy()[:1500, 2] > 0.16
    assert found.object_mask[:1500][high].all()


def test_a_negative_click_on_a_shadow_keeps_a_thin_leg() -> None:
    """The leg is much nearer to the shadow than to the positive click above it and has the colour of the shadow, but it
    is more than twice as high.
    """
    angle, height = np.meshgrid(np.linspace(0.0, 6.1, 14), np.linspace(0.02, 0.7, 28))
    leg = np.column_stack([0.08 * np.cos(angle.ravel()), 0.08 * np.sin(angle.ravel()), height.ravel()])
    across, out = np.meshgrid(np.linspace(-0.12, 0.12, 9), np.linspace(-0.5, -0.06, 16))
    shadow = [np.column_stack([across.ravel(), out.ravel(), np.full(across.size, z)]) for z in (0.03, 0.05)]
    head = 0.6 * shell() + [0.0, 0.0, 0.68]
    things = round_ones(np.concatenate([head, leg, *shadow]), 0.025)
    cloud = concatenate(things, lying(level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.05)))
    top, beside = click(cloud, (0.0, -0.28, 1.05)), click(cloud, (0.0, -0.3, 0.06), inside=False)
    found = segment(cloud, FLOOR, ObjectSpec.of_clicks([top, beside]))
    means = things.means.numpy()
    assert found.object_mask[: things.count][means[:, 2] > 0.15].all()
    assert not found.object_mask[: things.count][(means[:, 1] < -0.25) & (means[:, 2] < 0.1)].any()
