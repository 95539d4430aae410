"""Inpainted floor: position (Eq. 18), appearance and error messages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.spatial import KDTree

from egs_warp.assets import scene
from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.laplace_fill import laplace_fill
from egs_warp.inpainting import inpaint as inpaint_module
from egs_warp.inpainting.holes import Hole, disc, footprint, unseen
from egs_warp.inpainting.inpaint import InpaintOptions, InpaintResult, inpaint
from egs_warp.inpainting.inpainters import OpenCvInpainter
from egs_warp.inpainting.new_floor import rim_heights, with_gloss
from egs_warp.inpainting.patch_synthesis import PatchSynthesis
from egs_warp.inpainting.rectified import PlaneWindow, RectifiedImage, diffuse_only, mean_colours, rectify
from egs_warp.io import read_capture, write_ply
from egs_warp.io.planes import PlaneRecord, write_planes
from egs_warp.render import render_gaussians
from egs_warp.segmentation.plane_fit import plane_depth
from egs_warp.segmentation.votes import MaskedView
from egs_warp.training.metrics import psnr
from tests.support.floors import PLANE, floor, on_plane, pattern
from tests.support.scenes import FLOOR, blocks, round_ones

RADIUS = 0.22


def look(azimuth: float, elevation: float, *, size: int = 160) -> Camera:
    first, second = PLANE.tangents()
    away = np.cos(elevation) * (np.cos(azimuth) * first + np.sin(azimuth) * second) + np.sin(elevation) * PLANE.normal
    target = on_plane(0.1, 0.05)
    return Camera.look_at(target + 2.0 * away, target, PLANE.normal, width=size, height=size, vertical_fov_degrees=22.0)


def holed(truth: GaussianCloud, hole: Hole) -> GaussianCloud:
    """Return the floor with a dark blob in place of its Gaussians in the hole."""
    kept = truth.subset(~hole.window.sample(hole.mask, truth.means.numpy()))
    blob = GaussianCloud.from_numpy(
        on_plane(0.1, 0.05)[None] + 0.03 * PLANE.normal,
        np.array([[1.0, 0, 0, 0]]),
        np.full((1, 3), np.log(0.05)),
        np.array([2.0]),
        np.full((1, truth.sh.shape[1], 3), -1.0) * (np.arange(truth.sh.shape[1]) == 0)[:, None],
        device=str(truth.device),
    )
    return concatenate(kept, blob)


@pytest.fixture(scope="module")
def done() -> tuple[GaussianCloud, InpaintResult]:
    """Return a glossy floor without a hole, and the result of filling a hole in it."""
    truth, hole = floor(gloss=0.1), disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    return truth, inpaint(holed(truth, hole), hole, options=InpaintOptions(steps=30))


def test_filled_floor_looks_like_the_truth(done: tuple[GaussianCloud, InpaintResult]) -> None:
    """From oblique views, the PSNR in the hole is at least 28 dB, so the blob is gone and the new floor is opaque."""
    truth, result = done
    for azimuth, elevation in ((0.3, 0.6), (2.5, 1.0)):
        camera = look(azimuth, elevation)
        before, after = render_gaussians(truth, camera), render_gaussians(result.cloud, camera)
        hole = render_gaussians(result.cloud.subset(result.is_new), camera).alpha.numpy() > 0.5
        assert hole.sum() > 1000
        assert psnr(after.colour.numpy()[hole], before.colour.numpy()[hole]) > 28.0
        assert after.alpha.numpy()[hole].min() > 0.94


def test_depth_is_that_of_the_plane(done: tuple[GaussianCloud, InpaintResult]) -> None:
    """Eq. (18): the rendered depth of the new Gaussians differs from the depth of the plane by at most half a spacing.
    It is not exact, because each splat has a single depth, and splats in front hide those behind."""
    _, result = done
    camera = look(1.0, 0.7)
    image = render_gaussians(result.cloud.subset(result.is_new), camera)
    seen = image.alpha.numpy() > 0.9
    expected = plane_depth(PLANE, camera)[seen]
    off = image.depth.numpy()[seen] - expected
    assert np.abs(off).mean() < 0.005 and np.abs(off).max() < 0.012


def test_new_gaussians_are_flat_dense_and_lie_on_the_plane(done: tuple[GaussianCloud, InpaintResult]) -> None:
    _, result = done
    new = result.cloud.subset(result.is_new)
    heights = PLANE.heights(new.means.numpy())
    assert np.median(np.abs(heights)) < 2e-4 and np.abs(heights).max() < 2.0 * result.window.texel
    assert new.log_scales.numpy()[:, 2].max() <= -10.0 + 1e-6
    spacing = np.sqrt(np.pi * RADIUS**2 / new.count)
    assert spacing < 0.025
    assert new.sh_degree == 3


def test_new_gaussians_have_the_gloss_of_the_floor_but_their_own_colour(
    done: tuple[GaussianCloud, InpaintResult],
) -> None:
    """The new Gaussians have the highlight of the floor; the painted image determines their mean colour over all
    directions."""
    truth, result = done
    new = result.cloud.subset(result.is_new)
    assert new.sh.numpy()[:, 1:] == pytest.approx(
        np.broadcast_to(truth.sh.numpy()[0, 1:], (new.count, 15, 3)), abs=1e-4
    )
    matte = replace(new, sh=wp.array(new.sh.numpy()[:, :1], dtype=wp.vec3))
    glossy = with_gloss(matte, truth, result.window)
    assert mean_colours(glossy, PLANE) == pytest.approx(mean_colours(matte, PLANE), abs=1e-5)
    assert not np.allclose(mean_colours(matte, PLANE), mean_colours(new, PLANE), atol=1e-3)


@pytest.mark.slow
def test_training_reduces_the_error_to_the_painted_image() -> None:
    """Seen face-on, the difference from the painted image decreases by at least 30 %, and the means stay the same. The
    result without training is deterministic."""
    truth, hole = floor(), disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    damaged = holed(truth, hole)

    def run(steps: int) -> tuple[InpaintResult, float]:
        result = inpaint(damaged, hole, inpainter=OpenCvInpainter(), options=InpaintOptions(steps=steps))
        image = render_gaussians(diffuse_only(result.cloud, PLANE), result.window.camera())
        return result, float(np.abs(image.colour.numpy() - result.painted)[result.hole].mean())

    (start, before), (end, after) = run(0), run(60)
    assert after < 0.7 * before
    assert np.array_equal(start.cloud.means.numpy(), end.cloud.means.numpy())
    again, _ = run(0)
    assert np.array_equal(again.cloud.sh.numpy(), start.cloud.sh.numpy())


def test_new_floor_continues_a_floor_beside_the_plane() -> None:
    """If the floor is 0.02 above the fitted plane, so is the new floor."""
    truth, hole = floor(height=0.02), disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    result = inpaint(holed(truth, hole), hole, inpainter=OpenCvInpainter(), options=InpaintOptions(steps=0))
    heights = PLANE.heights(result.cloud.means.numpy()[result.is_new])
    assert np.median(heights) == pytest.approx(0.02, abs=1e-3)
    assert heights.max() < 0.022


def test_laplace_fill_and_rim_heights() -> None:
    """The solution of the Laplace equation reproduces harmonic polynomials; the heights at the rim of a tilted floor
    ignore a crack."""
    rows, columns = (values - 20.0 for values in np.indices((41, 41)).astype(float))
    hole = np.hypot(rows, columns) < 12
    saddle = rows**2 - columns**2 + 3.0 * columns
    assert laplace_fill(np.where(hole, 0.0, saddle), hole) == pytest.approx(saddle, abs=1e-8)
    tilted = 0.01 * rows - 0.02 * columns + 0.5
    cracked = np.where(np.abs(columns + rows) < 2, tilted - 3.0, tilted)
    image = RectifiedImage(np.zeros((41, 41, 3)), np.ones((41, 41)), np.where(hole, 0.0, cracked).astype(np.float32))
    assert rim_heights(image, hole, ~hole)[hole] == pytest.approx(tilted[hole], abs=0.02)


def test_window_camera_and_rectified_image() -> None:
    """The camera of a window projects its texels onto its pixels; a rectified image has the colours of the pattern and
    the heights of the floor."""
    window = PlaneWindow(PLANE, on_plane(0.2, -0.1), 0.01, 60, 80)
    pixels = np.array([[0.5, 0.5], [79.5, 10.5], [33.0, 59.0]])
    points = window.points(pixels)
    assert PLANE.heights(points) == pytest.approx(0.0, abs=1e-12)
    assert window.pixels(points + 0.3 * PLANE.normal) == pytest.approx(pixels)
    camera = window.camera()
    seen = points @ camera.rotation.T + camera.translation
    assert seen[:, :2] / seen[:, 2:] * camera.fx + [camera.cx, camera.cy] == pytest.approx(pixels)
    image = rectify(floor(height=0.01, gloss=0.2), window, thickness=0.1)
    columns, rows = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    first, second = PLANE.tangents()
    places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1)) + PLANE.offset * PLANE.normal
    wanted = pattern(places @ first, places @ second).reshape(60, 80, 3)
    # The gloss adds the same colour to every texel.
    off = image.colour - wanted
    assert np.std(off - off.mean(axis=(0, 1))) < 0.045
    assert image.height[5:-5, 5:-5] == pytest.approx(0.01, abs=2e-3)
    assert rectify(floor(height=0.1), window, thickness=0.09).alpha.max() == 0.0


def test_threads_at_two_heights_keep_their_contrast() -> None:
    """Bright threads are above dark ones, so each oblique view shows them displaced in another direction. The plain
    mean of the views would have a contrast of 0.11 instead of 0.23."""
    window = PlaneWindow(PLANE, on_plane(0.0, 0.0), 0.01, 80, 80)
    columns, rows = np.meshgrid(*[np.arange(-20.0, 100.0, 0.5) + 0.25] * 2)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    bright, count = np.floor(pixels[:, 0] / 4) % 2 == 0, len(pixels)
    threads = GaussianCloud.from_numpy(
        window.points(pixels) + np.where(bright, 0.02, 0.0)[:, None] * PLANE.normal,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full((count, 3), np.log(0.003)),
        np.full(count, 4.0),
        np.where(bright, 0.8, -0.8)[:, None, None] * np.ones((1, 1, 3)),
    )
    colour = rectify(threads, window, thickness=0.1).colour[10:-10, 10:-10, 0]
    assert colour.mean(axis=0).std() > 0.14
    assert colour.mean(axis=1).std() < 0.02


def test_footprints_and_common_occlusion() -> None:
    """The footprint of a pawn is a disc, and that of a stool is four small feet; masks of a disc on the plane yield the
    disc."""
    pawn, stool = scene("pawn"), scene("stool")
    assert footprint(pawn.object, pawn.plane).area == pytest.approx(np.pi * 0.3**2, rel=0.1)
    feet = footprint(stool.object, stool.plane)
    assert 0.01 < feet.area < 0.1 * feet.bounds()[1] ** 2
    hole = disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    assert hole.area == pytest.approx(np.pi * RADIUS**2, rel=0.01)
    views = []
    for azimuth in (0.0, 2.0, 4.0):
        camera = look(azimuth, 0.7)
        depth = plane_depth(PLANE, camera)
        v, u = np.mgrid[:160, :160] + 0.5
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        points = camera.centre + depth[..., None] * (rays @ camera.rotation)
        # In each view, another object hides a different part of the floor.
        mask = hole.window.sample(hole.mask, points.reshape(-1, 3)).reshape(160, 160)
        mask[60:70, 20:32] = True
        views.append(MaskedView(camera, mask))
    found = unseen(PLANE, views)
    assert found.area == pytest.approx(hole.area, rel=0.05)
    assert found.bounds()[0] == pytest.approx(hole.bounds()[0], abs=0.02)
    nowhere = MaskedView(look(0.0, 0.7), np.indices((160, 160)).sum(axis=0) < 12)
    with pytest.raises(UserError, match="the masks hide no floor in common"):
        unseen(PLANE, [views[1], nowhere])
    down, turn = look(0.0, 0.7), np.diag([1.0, -1.0, -1.0])
    up = replace(down, rotation=turn @ down.rotation, translation=turn @ down.translation)
    with pytest.raises(UserError, match="no pixel of a mask shows the plane, so the hole is not on it"):
        unseen(PLANE, [MaskedView(up, np.ones((160, 160), bool))])


def test_overhanging_objects_stay() -> None:
    """A shelf above the floor, at a height equal to the diameter of the hole, is not removed; the blob in the hole
    is."""
    truth, hole = floor(spacing=0.04), disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    shelf = floor(spacing=0.04, half=0.4, height=2.0 * RADIUS)
    background = concatenate(holed(truth, hole), shelf)
    result, bare = (
        inpaint(cloud, hole, inpainter=OpenCvInpainter(), options=InpaintOptions(steps=0))
        for cloud in (background, holed(truth, hole))
    )
    assert np.count_nonzero(PLANE.heights(result.cloud.means.numpy()) > RADIUS) == shelf.count
    assert result.removed == bare.removed > 0


def test_the_sides_below_the_edge_of_a_floor_stay() -> None:
    """The hole in the top of a block extends 0.05 beyond its edge. All Gaussians of the sides remain; a Gaussian below
    the middle of the hole is removed."""
    block = blocks(((-0.5, -0.5, -0.6), (0.5, 0.5, 0.0)))
    cloud = concatenate(block, round_ones(np.array([[0.1, 0.0, -0.3]]), 0.02))
    hole = disc(FLOOR, np.array([0.1, 0.0, 0.0]), 0.45)
    result = inpaint(cloud, hole, inpainter=OpenCvInpainter(), options=InpaintOptions(steps=0))
    means = cloud.means.numpy()
    is_side = (np.abs(means[:, :2]).max(axis=1) > 0.49) & (means[:, 2] < -0.15)
    assert is_side.sum() > 1000 and result.is_retained[is_side].all()
    assert not result.is_retained[-1]


def test_a_narrow_rim_between_a_gap_and_the_edge_stays() -> None:
    """The top of a block is known only at its edge, and a gap separates it from the hole. The edge remains, and the new
    floor closes the gap."""
    block = blocks(((-0.5, -0.5, -0.6), (0.5, 0.5, 0.0)))
    means = block.means.numpy()
    reach = np.abs(means[:, :2]).max(axis=1)
    cloud = block.subset((reach > 0.48) | (means[:, 2] < -0.01))
    mask = np.pad(np.ones((80, 80), bool), 10)
    hole = Hole(PlaneWindow(FLOOR, np.zeros(3), 0.01, 100, 100), mask)
    result = inpaint(cloud, hole, inpainter=OpenCvInpainter(), options=InpaintOptions(steps=0))
    means = cloud.means.numpy()
    assert result.is_retained[np.abs(means[:, :2]).max(axis=1) > 0.49].all()
    new = result.cloud.subset(result.is_new).means.numpy()
    across = np.linspace(-0.42, 0.42, 43)
    grid = np.stack([*np.meshgrid(across, across), np.zeros((43, 43))], axis=-1).reshape(-1, 3)
    assert KDTree(new).query(grid)[0].max() < 0.03 and np.abs(new[:, :2]).max() < 0.51


def test_without_patches_the_colours_are_continued_smoothly(monkeypatch: pytest.MonkeyPatch) -> None:
    """If patch synthesis, the default, finds no patches, colours are continued smoothly. The error of an inpainter that
    the caller has chosen is raised instead."""

    def refuse(*_: object, **__: object) -> None:
        raise UserError("inpaint: no piece is known")

    monkeypatch.setattr(PatchSynthesis, "fill", refuse)
    truth, hole = floor(spacing=0.04), disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    result = inpaint(holed(truth, hole), hole, options=InpaintOptions(steps=0))
    assert result.notes[0] == "the colours around the hole were continued smoothly (inpaint: no piece is known)"
    smooth = inpaint(holed(truth, hole), hole, inpainter=OpenCvInpainter(), options=InpaintOptions(steps=0))
    np.testing.assert_array_equal(result.painted, smooth.painted)
    with pytest.raises(UserError, match="no piece is known"):
        inpaint(holed(truth, hole), hole, inpainter=PatchSynthesis(), options=InpaintOptions(steps=0))


@pytest.mark.parametrize(
    ("place", "radius", "message"),
    [
        ((5.0, 5.0), 0.2, "the hole is off the floor: nothing lies on the plane around it"),
        ((1.3, 0.0), 0.35, "the hole is off the floor: only"),
        ((0.0, 0.0), 1.2, "the hole covers nearly all of the floor; make it smaller"),
        ((0.0, 0.0), 3.0, "the hole covers the whole capture; make it smaller"),
        ((0.0, 0.0), -1.0, "the hole has the radius -1 and the centre .*; give a positive radius"),
        ((0.0, 0.0), np.nan, "the hole has the radius nan and the centre"),
    ],
)
def test_holes_that_cannot_be_filled(place: tuple[float, float], radius: float, message: str) -> None:
    with pytest.raises(UserError, match=message):
        inpaint(floor(spacing=0.05), disc(PLANE, on_plane(*place), radius), options=InpaintOptions(steps=0))


def test_a_hole_narrower_than_the_new_gaussians_names_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inpaint_module, "flat_gaussians", lambda *_, **__: None)
    with pytest.raises(UserError, match=r"^inpaint: the hole is too narrow: its \d+ texels fill no more than half of"):
        inpaint(
            floor(spacing=0.05),
            disc(PLANE, on_plane(0.0, 0.0), 0.3),
            inpainter=OpenCvInpainter(),
            options=InpaintOptions(steps=0),
        )


def test_bad_options_and_objects() -> None:
    with pytest.raises(UserError, match=r"steps -1: give a whole number of at least 0"):
        InpaintOptions(steps=-1)
    with pytest.raises(UserError, match=r"margin 2: give a fraction of the side of the hole from 0 to 1"):
        InpaintOptions(margin=2)
    window = disc(PLANE, on_plane(0, 0), 0.1).window
    with pytest.raises(UserError, match="the hole is empty; give the object, a mask, or a point on the plane"):
        Hole(window, np.zeros((256, 256), bool))
    pawn = scene("pawn")
    high = replace(pawn.plane, offset=pawn.plane.offset - 5.0)
    with pytest.raises(UserError, match="the object does not touch the plane"):
        footprint(pawn.object, high)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command writes a capture whose hole is filled without a gap, and an image; errors are one line."""
    truth, hole = floor(spacing=0.04), disc(PLANE, on_plane(0.1, 0.05), RADIUS)
    write_ply(tmp_path / "background.ply", holed(truth, hole))
    write_planes(tmp_path / "plane.json", [PlaneRecord(PLANE)])
    x, y, z = on_plane(0.1, 0.05)
    files = [str(tmp_path / "background.ply"), "--plane", str(tmp_path / "plane.json"), "--out"]
    where = [f"--hole={x},{y},{z},{RADIUS}"]
    assert main(["inpaint", *files, str(tmp_path / "filled.ply"), *where, "--steps", "0", "--inpainter", "ns"]) == 0
    assert "were replaced by" in capsys.readouterr().out
    filled = read_capture(tmp_path / "filled.ply").cloud
    camera = look(0.4, 0.8)
    assert render_gaussians(filled, camera).alpha.numpy()[70:90, 70:90].min() > 0.97
    assert (tmp_path / "filled.png").stat().st_size > 10_000
    before = (tmp_path / "filled.ply").read_bytes()
    assert main(["inpaint", *files, str(tmp_path / "filled.ply"), *where, "--steps", "0"]) == 2
    assert f"--out {tmp_path / 'filled.ply'}: it exists already; choose another name" in capsys.readouterr().err
    quick = [*files, str(tmp_path / "other.ply"), *where, "--steps", "0", "--inpainter", "telea", "--picture"]
    for flags, message in (
        ([*quick, str(tmp_path / "gone" / "a.png")], "a.png: its folder does not exist; create"),
        ([*quick, str(tmp_path / "a.jpg")], "a.jpg: give the name of a .png file"),
        ([*files, str(tmp_path / "gone" / "a.ply"), *where], "a.ply: its folder does not exist; create"),
        ([*files, "a.ply"], "the hole is not defined; give one of --object, --mask with --cameras, or --hole"),
        ([*files, "a.txt", *where], "--out a.txt: give the name of a .ply file"),
        ([*files, "a.ply", "--hole", "1,2"], "--hole 1,2: give four numbers x,y,z,radius"),
        ([*files, "a.ply", "--mask", "gone.png"], "--mask gone.png: no such file or folder"),
        (
            [*files, "a.ply", "--mask", files[0]],
            "--mask: a mask needs its camera; give --cameras",
        ),
        (
            [*files, "a.ply", *where, "--inpainter", "magic"],
            "--inpainter magic: give patch, telea, ns or an ONNX file",
        ),
    ):
        assert main(["inpaint", *flags]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert (tmp_path / "filled.ply").read_bytes() == before
