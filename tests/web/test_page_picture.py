"""Picture of the page in Chromium, compared with pictures of this package."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.main_light import MainLight, irradiance_form
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io import write_ply
from egs_warp.lighting.relighting import Relighter
from egs_warp.render.backdrop import studio_floor
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import ContactShadow, shadow_blur_radius
from egs_warp.web.page import export_page
from egs_warp.web.recording import Recording
from tests.support.chromium import NEEDED, opened
from tests.support.page_camera import page_camera
from tests.support.page_pictures import BACKGROUND, STAGE, picture_of, psnr_on_body

pytestmark = NEEDED


def _own_picture(recording: Recording, page: Any, frame: int) -> np.ndarray:
    """Return ``frame`` rendered by this package with the camera of the page."""
    camera = page_camera(page, STAGE)
    t, splats = recording.trajectory, recording.creature.splats
    deformer = Deformer(splats, embed_gaussians(splats, TetMesh(t.rest_positions, t.tets)))
    cloud = deformer.deform(t.positions[recording.steps[frame]]).cloud
    return np.clip(render_gaussians(cloud, camera, background=BACKGROUND).colour.numpy(), 0.0, 1.0)


@pytest.mark.parametrize("preset", ["film", "front", "top"])
def test_canvas_is_like_our_own_picture_of_the_same_frame_and_camera(
    chromium: Any, page_file: str, recording: Recording, preset: str
):
    page, complaints = opened(chromium, page_file)
    page.evaluate("(name) => { egs.setLayer('ground', false); egs.viewers[0].preset(name); }", preset)
    for frame in (0, 12):
        page.evaluate("(frame) => egs.player.seek(frame)", frame)
        assert psnr_on_body(_own_picture(recording, page, frame), picture_of(page)) >= 40.0
    assert complaints == []
    page.close()


def test_a_capture_trained_with_antialiasing_is_drawn_so(chromium: Any, recording: Recording, tmp_path: Path):
    splats = replace(recording.creature.splats, antialiased=True)
    smooth = replace(recording, creature=replace(recording.creature, splats=splats))
    export_page(tmp_path / "page.html", [smooth])
    # In a smaller picture, more splats are smaller than a pixel.
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri(), 240, 240)
    page.evaluate("egs.setLayer('ground', false)")
    picture = picture_of(page)
    likeness = psnr_on_body(_own_picture(smooth, page, 0), picture)
    assert likeness >= max(40.0, 5.0 + psnr_on_body(_own_picture(recording, page, 0), picture))
    assert complaints == []
    page.close()


def test_the_page_relights_the_body_and_casts_the_shadow_of_the_main_light(
    chromium: Any, recording: Recording, tmp_path: Path
):
    """A rotated body has the colours of the film, and the floor is darker on the side away from the light."""
    direction = np.array([0.48, 0.64, 0.6])
    light = MainLight(direction, 5.0, 0.5, irradiance_form(0.3, 0.0, np.array([0.0, 0.0, 1.0]), 1.0, direction))
    t = recording.trajectory
    turned = t.positions @ Rotation.from_euler("z", 150.0, degrees=True).as_matrix().T
    lit = replace(
        recording,
        trajectory=replace(t, positions=turned),
        creature=replace(recording.creature, light=light),
    )
    export_page(tmp_path / "page.html", [lit])
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri())
    page.evaluate("egs.setLayer('ground', false); egs.viewers[0].preset('front')")
    splats = recording.creature.splats
    deformed = Deformer(splats, embed_gaussians(splats, TetMesh(t.rest_positions, t.tets))).deform(turned[0])
    relit = Relighter(splats, light).relight(deformed.cloud, deformed.rotations)
    ours, captured = (
        np.clip(render_gaussians(cloud, page_camera(page, STAGE), background=BACKGROUND).colour.numpy(), 0.0, 1.0)
        for cloud in (relit, deformed.cloud)
    )
    picture = picture_of(page)
    assert psnr_on_body(ours, picture) >= 38.0 > 10.0 + psnr_on_body(captured, picture)
    page.evaluate("egs.setLayer('ground', true); egs.setLayer('splats', false); egs.viewers[0].preset('top')")
    camera, floor = page_camera(page, STAGE), picture_of(page).mean(axis=-1)
    centre = np.einsum("n,ni->i", t.node_mass, turned[0]) / t.node_mass.sum()
    foot = centre - centre[2] / direction[2] * direction
    levels = []
    for point in (foot, 2.0 * centre * [1.0, 1.0, 0.0] - foot):
        x, y, z = camera.rotation @ (point - camera.centre)
        column, row = round(camera.cx + camera.fx * x / z), round(camera.cy + camera.fy * y / z)
        levels.append(floor[row - 3 : row + 4, column - 3 : column + 4].mean())
    shadow, opposite = levels
    assert shadow < 0.75 * opposite
    assert complaints == []
    page.close()


def test_the_comparison_detects_another_frame(chromium: Any, page_file: str, recording: Recording):
    """The PSNR of images of different frames is clearly lower."""
    page, _ = opened(chromium, page_file)
    page.evaluate("egs.setLayer('ground', false); egs.player.seek(12)")
    assert psnr_on_body(_own_picture(recording, page, 0), picture_of(page)) < 35.0
    page.close()


def test_the_floor_hides_what_is_below_it(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
    page.evaluate(
        """() => {
            const { positions } = egs.viewers[0].source.frames[0];
            for (let k = 2; k < positions.length; k += 3) positions[k] -= 2;
            egs.viewers[0].preset("top");
            egs.player.seek(0);
        }"""
    )
    hidden = picture_of(page)
    page.evaluate("egs.setLayer('splats', false)")
    assert np.abs(hidden - picture_of(page)).max() < 0.02
    page.evaluate("egs.setLayer('ground', false)")
    empty = picture_of(page)
    page.evaluate("egs.setLayer('splats', true)")
    assert (np.abs(picture_of(page) - empty).max(axis=-1) > 0.05).mean() > 0.01
    assert complaints == []
    page.close()


def test_the_floor_is_like_that_of_a_film(chromium: Any, page_file: str, recording: Recording):
    page, complaints = opened(chromium, page_file)
    page.evaluate("egs.setLayer('splats', false); egs.viewers[0].preset('front')")
    camera, height = page_camera(page, STAGE), page.evaluate("egs.viewers[0].source.header.facts.height")
    splats = recording.creature.splats
    ground = ContactShadow(
        camera, Plane(np.array([0.0, 0.0, 1.0]), 0.0), centre=np.zeros(3), reach=2.0, device=splats.device
    )
    film = studio_floor(ground, cell=0.25 * height, shadow=False).background(splats).numpy()
    difference = np.abs(picture_of(page) - film).max(axis=-1)
    # Some pixels may differ, because the page draws a shadow under the body and edges of lines differ slightly.
    assert np.quantile(difference, 0.75) < 0.008
    assert len(np.unique(np.rint(255.0 * film).astype(int).reshape(-1, 3), axis=0)) > 20
    assert complaints == []
    page.close()


@pytest.mark.parametrize("is_lit", [False, True])
def test_the_shadow_of_a_body_in_the_air_is_like_that_of_a_film(
    chromium: Any, recording: Recording, tmp_path: Path, is_lit: bool
):
    """A third of a body height over the floor, the darkening by the shadow differs from that of the film by less than
    a tenth of its maximum."""
    direction, up = np.array([0.48, 0.64, 0.6]), np.array([0.0, 0.0, 1.0])
    light = MainLight(direction, 6.0, 0.4, irradiance_form(0.3, 0.0, up, 1.0, direction)) if is_lit else None
    t, splats = recording.trajectory, recording.creature.splats
    flying = t.positions + 0.35 * t.height * up
    run = replace(recording, trajectory=replace(t, positions=flying), creature=replace(recording.creature, light=light))
    export_page(tmp_path / "page.html", [run])
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri())
    page.evaluate("egs.setLayer('splats', false); egs.viewers[0].preset('top')")
    camera, picture = page_camera(page, STAGE), picture_of(page)
    cloud = Deformer(splats, embed_gaussians(splats, TetMesh(t.rest_positions, t.tets))).deform(flying[0]).cloud
    centre = np.einsum("n,ni->i", t.node_mass, flying[0]) / t.node_mass.sum() * [1.0, 1.0, 0.0]
    ground = ContactShadow(
        *(camera, Plane(up, 0.0)),
        centre=centre,
        reach=2.2 * t.height,
        device=splats.device,
        blur_radius=shadow_blur_radius(splats),
        height=t.height,
        body_reach=1.5 * t.height,
        light=light,
    )
    film, plain = (
        studio_floor(ground, cell=0.25 * t.height, shadow=shadow).background(cloud, centre).numpy()
        for shadow in (True, False)
    )
    darkening = (plain - film).mean(axis=-1)
    assert darkening.max() > 0.05
    # The median ignores the lines of the grid, whose edges differ slightly.
    in_shadow = darkening > 0.25 * darkening.max()
    difference = np.abs(picture - film).mean(axis=-1)[in_shadow]
    assert np.median(difference) < 0.1 * darkening.max()
    assert np.quantile(difference, 0.9) < 0.2 * darkening.max()
    assert complaints == []
    page.close()


def test_the_end_of_a_long_body_casts_a_shadow(chromium: Any, recording: Recording, tmp_path: Path):
    """The floor under the end of a body that is five times as long as high is darker than beside it."""
    t = recording.trajectory
    factor = 5.0 * t.height / np.ptp(t.positions[0, :, 0])
    stretched = t.positions * [factor, 1.0, 1.0]
    export_page(tmp_path / "page.html", [replace(recording, trajectory=replace(t, positions=stretched))])
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri())
    page.evaluate("egs.setLayer('splats', false); egs.viewers[0].preset('top')")
    camera, floor = page_camera(page, STAGE), picture_of(page).mean(axis=-1)
    centre = stretched[0].mean(axis=0) * [1.0, 1.0, 0.0]
    levels = []
    for beside in (0.0, 0.9):
        x, y, z = camera.rotation @ (centre + t.height * np.array([1.9, beside, 0.0]) - camera.centre)
        column, row = round(camera.cx + camera.fx * x / z), round(camera.cy + camera.fy * y / z)
        levels.append(np.median(floor[row - 5 : row + 6, column - 5 : column + 6]))
    shadow, plain = levels
    assert shadow < 0.95 * plain
    assert complaints == []
    page.close()


@pytest.fixture(scope="module")
def on_a_floor(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Write the page of the same run with a grey floor of flat Gaussians, stored with the run as ``background.ply``."""
    folder = tmp_path_factory.mktemp("floor") / "run"
    shutil.copytree(run_folder, folder)
    t = Recording.read(folder).trajectory
    along = np.linspace(-1.5, 1.5, 50)
    spots = np.stack([*map(np.ravel, np.meshgrid(along, along)), np.zeros(2500)], axis=1)
    turn = Rotation.from_matrix(t.body_axes.T).as_quat()[[3, 0, 1, 2]]
    floor = GaussianCloud.from_numpy(
        t.in_capture(spots),
        np.tile(turn, (2500, 1)),
        np.tile(np.log(np.array([0.05, 0.05, 0.002]) / t.metres_per_unit), (2500, 1)),
        np.full(2500, 4.0),
        np.zeros((2500, 1, 3)),
    )
    write_ply(folder / "background.ply", floor)
    path = folder / "page.html"
    export_page(path, [Recording.read(folder)])
    return path.as_uri()


def test_a_background_scene_is_on_the_ground_and_receives_the_shadow(chromium: Any, on_a_floor: str):
    page, complaints = opened(chromium, on_a_floor)
    assert not page.evaluate("document.getElementById('layer-ground').checked")
    page.evaluate("egs.viewers[0].preset('top'); egs.setLayer('splats', false)")
    picture = picture_of(page)
    # The floor is grey, and darker in the shadow under the creature.
    middle = picture[picture.shape[0] // 2, picture.shape[1] // 2]
    assert 0.12 < middle.mean() < 0.3
    assert abs(np.median(picture[180:300, 10:40]) - 0.5) < 0.03
    page.evaluate("egs.setLayer('scene', false)")
    np.testing.assert_allclose(picture_of(page)[240, 20], BACKGROUND, atol=0.01)
    assert complaints == []
    page.close()
