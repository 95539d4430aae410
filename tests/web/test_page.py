"""The page in a real Chromium, which renders in software if there is no GPU."""

from __future__ import annotations

import base64
import io
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
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
from egs_warp.render.shadow import ContactShadow
from egs_warp.web.page import export_page
from egs_warp.web.recording import Recording
from tests.support.chromium import BROWSER, NEEDED, opened, wait_until
from tests.support.page_camera import page_camera
from tests.support.pages import served

pytestmark = NEEDED
_BACKGROUND = (0xB9 / 255.0, 0xBE / 255.0, 0xC6 / 255.0)
_STAGE = "egs.viewers[0]"


@pytest.fixture(scope="module")
def recording(run_folder: Path) -> Recording:
    return Recording.read(run_folder)


@pytest.fixture(scope="module")
def file(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("page") / "page.html"
    export_page(path, [recording])
    return path.as_uri()


def _picture(page: Any, stage: int = 0) -> np.ndarray:
    """Return the canvas (H, W, 3) of a view, with values from 0 to 1, after its splats are sorted."""
    text = page.evaluate(
        """async (k) => {
            const viewer = window.egs.viewers[k];
            await viewer.drawSorted();
            const bytes = new Uint8Array(await (await viewer.screenshot()).arrayBuffer());
            return btoa(bytes.reduce((text, byte) => text + String.fromCharCode(byte), ""));
        }""",
        stage,
    )
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB"), np.float64) / 255.0


def _own_picture(recording: Recording, page: Any, frame: int) -> np.ndarray:
    """Return ``frame`` rendered by this package with the camera of the page."""
    camera = page_camera(page, _STAGE)
    t, splats = recording.trajectory, recording.creature.splats
    deformer = Deformer(splats, embed_gaussians(splats, TetMesh(t.rest_positions, t.tets)))
    cloud = deformer.deform(t.positions[recording.steps[frame]]).cloud
    return np.clip(render_gaussians(cloud, camera, background=_BACKGROUND).colour.numpy(), 0.0, 1.0)


def _psnr_on_body(ours: np.ndarray, theirs: np.ndarray) -> float:
    body = np.abs(ours - np.array(_BACKGROUND)).max(axis=-1) > 0.02
    assert 0.02 < body.mean() < 0.9
    return float(-10.0 * np.log10(((ours - theirs)[body] ** 2).mean()))


@pytest.mark.parametrize("preset", ["film", "front", "top"])
def test_canvas_is_like_our_own_picture_of_the_same_frame_and_camera(
    chromium: Any, file: str, recording: Recording, preset: str
):
    page, complaints = opened(chromium, file)
    page.evaluate("(name) => { egs.setLayer('ground', false); egs.viewers[0].preset(name); }", preset)
    for frame in (0, 12):
        page.evaluate("(frame) => egs.player.seek(frame)", frame)
        assert _psnr_on_body(_own_picture(recording, page, frame), _picture(page)) >= 40.0
    assert complaints == []
    page.close()


def test_a_capture_trained_with_antialiasing_is_drawn_so(chromium: Any, recording: Recording, tmp_path: Path):
    splats = replace(recording.creature.splats, antialiased=True)
    smooth = replace(recording, creature=replace(recording.creature, splats=splats))
    export_page(tmp_path / "page.html", [smooth])
    # In a smaller picture, more splats are smaller than a pixel.
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri(), 240, 240)
    page.evaluate("egs.setLayer('ground', false)")
    picture = _picture(page)
    likeness = _psnr_on_body(_own_picture(smooth, page, 0), picture)
    assert likeness >= max(40.0, 5.0 + _psnr_on_body(_own_picture(recording, page, 0), picture))
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
        np.clip(render_gaussians(cloud, page_camera(page, _STAGE), background=_BACKGROUND).colour.numpy(), 0.0, 1.0)
        for cloud in (relit, deformed.cloud)
    )
    picture = _picture(page)
    assert _psnr_on_body(ours, picture) >= 38.0 > 10.0 + _psnr_on_body(captured, picture)
    page.evaluate("egs.setLayer('ground', true); egs.setLayer('splats', false); egs.viewers[0].preset('top')")
    camera, floor = page_camera(page, _STAGE), _picture(page).mean(axis=-1)
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


def test_the_comparison_detects_another_frame(chromium: Any, file: str, recording: Recording):
    """The PSNR of images of different frames is clearly lower."""
    page, _ = opened(chromium, file)
    page.evaluate("egs.setLayer('ground', false); egs.player.seek(12)")
    assert _psnr_on_body(_own_picture(recording, page, 0), _picture(page)) < 35.0
    page.close()


_AZIMUTH = """(preset) => {
    const { camera, controls } = egs.viewers[0];
    egs.viewers[0].preset(preset);
    const from = camera.position.clone().sub(controls.target);
    return Math.atan2(from.y, from.x) * 180 / Math.PI;
}"""
"""JavaScript that selects a view and returns the azimuth of the camera as seen from the body, degrees."""


def test_front_and_side_look_at_the_front_that_was_found(chromium: Any, file: str, recording: Recording):
    page, complaints = opened(chromium, file)
    front = recording.trajectory.front
    azimuth = float(np.degrees(np.arctan2(front[1], front[0])))
    # The facing direction is far from the x axis of the body, which is along its long side.
    assert 20.0 < abs(azimuth) < 160.0
    for turned in (0.0, 90.0):
        for preset, expected in (("front", azimuth), ("side", azimuth + 90.0)):
            off = page.evaluate(_AZIMUTH, preset) - expected - turned
            assert abs((off + 180.0) % 360.0 - 180.0) < 2.0, (preset, turned)
        # The front turns with the body.
        page.evaluate(
            """() => {
                const { positions } = egs.viewers[0].source.frames[12];
                for (let k = 0; k < positions.length; k += 3) {
                    [positions[k], positions[k + 1]] = [-positions[k + 1], positions[k]];
                }
                egs.player.seek(12);
            }"""
        )
    assert complaints == []
    page.close()


_COUNT_SPLATS_AT_START = """const timer = setInterval(() => {
    if (window.egs === undefined || egs.framePosition === 0) return;
    window.splatsAtStart = egs.viewers[0].splatRenderer.spark.activeSplats;
    clearInterval(timer);
}, 1)"""
"""JavaScript that counts the splats that are drawn when the second frame begins."""


def test_a_run_plays_by_itself_once_its_splats_are_sorted(chromium: Any, file: str):
    page, complaints = opened(chromium, file, plays=True, scripts=[_COUNT_SPLATS_AT_START])
    wait_until(page, "egs.player.playing && egs.player.framePosition > 3")
    assert page.evaluate("splatsAtStart") > 0
    page.keyboard.press(" ")
    assert not page.evaluate("egs.player.playing")
    page.close()
    still = chromium.new_page(reduced_motion="reduce")
    still.goto(file)
    wait_until(still, "window.egs !== undefined")
    wait_until(still, "!egs.viewers[0].dirty")
    assert still.evaluate("!egs.player.playing && egs.viewers[0].splatRenderer.spark.activeSplats > 0")
    assert complaints == []
    still.close()


def test_the_question_mark_shows_the_keys(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    sheet = page.locator("[aria-label=Keys].sheet")
    assert not sheet.is_visible()
    page.keyboard.press("?")
    assert "play or pause" in sheet.text_content()
    assert sheet.is_visible()
    page.keyboard.press("Escape")
    assert not sheet.is_visible()
    page.click("[title^=Keys]")
    assert sheet.is_visible()
    assert complaints == []
    page.close()


def test_each_shown_overlay_has_its_legend(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    legend = page.locator(".legend")
    assert not legend.is_visible()
    for layer, text in (
        ("cage", "surface of the cage"),
        ("muscles", "muscle at rest"),
        ("contacts", "contact force"),
        ("path", "centre of mass"),
        ("feet", "foot that carries load"),
    ):
        page.evaluate("(layer) => egs.setLayer(layer, true)", layer)
        assert text in legend.inner_text(), layer
        page.evaluate("(layer) => egs.setLayer(layer, false)", layer)
        assert not legend.is_visible()
    assert complaints == []
    page.close()


def test_muscles_at_rest_differ_from_the_body(chromium: Any, file: str):
    """In the first state, without activations, the pixels of muscle lines are clearly lighter or darker than the
    body."""
    page, _ = opened(chromium, file)
    body = _picture(page)
    page.evaluate("egs.setLayer('muscles', true)")
    contrast = np.abs(_picture(page) - body).max(axis=-1)
    drawn = contrast[contrast > 0.02]
    assert len(drawn) > 500
    assert np.median(drawn) > 0.2
    page.close()


def test_the_floor_hides_what_is_below_it(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    page.evaluate(
        """() => {
            const { positions } = egs.viewers[0].source.frames[0];
            for (let k = 2; k < positions.length; k += 3) positions[k] -= 2;
            egs.viewers[0].preset("top");
            egs.player.seek(0);
        }"""
    )
    hidden = _picture(page)
    page.evaluate("egs.setLayer('splats', false)")
    assert np.abs(hidden - _picture(page)).max() < 0.02
    page.evaluate("egs.setLayer('ground', false)")
    empty = _picture(page)
    page.evaluate("egs.setLayer('splats', true)")
    assert (np.abs(_picture(page) - empty).max(axis=-1) > 0.05).mean() > 0.01
    assert complaints == []
    page.close()


def test_the_floor_is_like_that_of_a_film(chromium: Any, file: str, recording: Recording):
    page, complaints = opened(chromium, file)
    page.evaluate("egs.setLayer('splats', false); egs.viewers[0].preset('front')")
    camera, height = page_camera(page, _STAGE), page.evaluate("egs.viewers[0].source.header.facts.height")
    splats = recording.creature.splats
    ground = ContactShadow(
        camera, Plane(np.array([0.0, 0.0, 1.0]), 0.0), centre=np.zeros(3), reach=2.0, device=splats.device
    )
    film = studio_floor(ground, cell=0.25 * height, shadow=False).background(splats).numpy()
    difference = np.abs(_picture(page) - film).max(axis=-1)
    # Some pixels may differ, because the page draws a shadow under the body and edges of lines differ slightly.
    assert np.quantile(difference, 0.75) < 0.008
    assert len(np.unique(np.rint(255.0 * film).astype(int).reshape(-1, 3), axis=0)) > 20
    assert complaints == []
    page.close()


def test_play_advances_and_loops(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    page.click("button.play")
    wait_until(page, "egs.player.framePosition > 3")
    wait_until(page, "egs.player.framePosition > 9")
    wait_until(page, "egs.player.framePosition < 6")
    page.keyboard.press(" ")
    stopped = page.evaluate("egs.player.framePosition")
    page.wait_for_timeout(200)
    assert page.evaluate("egs.player.framePosition") == stopped
    page.keyboard.press("ArrowRight")
    assert page.evaluate("egs.player.framePosition") == min(round(stopped) + 1, 12)
    page.click("#loop")
    page.select_option(".speed", "2")
    page.evaluate("egs.player.seek(0)")
    page.click("button.play")
    wait_until(page, "!egs.player.playing && egs.player.framePosition === 12")
    assert page.text_content(".clock") == "0.20 / 0.20 s"
    assert complaints == []
    page.close()


def test_a_slow_machine_waits_for_its_splats_to_be_sorted(chromium: Any, file: str):
    """Playback does not advance until the splats are sorted, because with an outdated order the ground could be drawn
    over the moved body."""
    page, _ = opened(chromium, file)
    page.evaluate("Object.defineProperty(egs.viewers[0], 'sorting', { get: () => window.held })")
    page.evaluate("() => { window.held = true; egs.player.playing = true; egs.frameTime = 0.001; }")
    wait_until(page, "egs.player.framePosition > 0")
    page.evaluate("() => { egs.frameTime = 1; window.at = egs.player.framePosition; }")
    page.wait_for_timeout(500)
    assert page.evaluate("egs.player.playing && egs.player.framePosition === window.at")
    page.evaluate("window.held = false")
    wait_until(page, "egs.player.framePosition !== window.at")
    page.close()


def test_each_layer_shows(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    page.evaluate("egs.player.seek(8)")
    page.click("[title=Layers]")
    before = _picture(page)
    for layer in ("cage", "muscles", "contacts", "path", "feet", "ground", "splats"):
        page.click(f"#layer-{layer}")
        after = _picture(page)
        assert (np.abs(after - before).max(axis=-1) > 0.05).mean() > 2e-4, layer
        before = after
    assert complaints == []
    page.close()


def test_a_foot_is_bright_while_the_ground_bears_it(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    page.evaluate("egs.setLayer('splats', false); egs.setLayer('ground', false); egs.setLayer('feet', true)")
    green = {}
    for carried in (True, False):
        if not carried:
            page.evaluate(
                "for (const frame of egs.viewers[0].source.frames)"
                " Object.defineProperty(frame, 'contacts', { value: new Float32Array(0) })"
            )
        # The first state has no previous step and therefore no forces.
        page.evaluate("egs.player.seek(0); egs.player.seek(4)")
        picture = _picture(page)
        shown = np.abs(picture - np.array(_BACKGROUND)).max(axis=-1) > 0.05
        assert shown.mean() > 2e-3
        green[carried] = float((picture[..., 1] - picture[..., 2])[shown].mean())
    # Feet with contacts are mint, which is greenish; feet without are bluish grey.
    assert green[True] > 0.01 and green[False] < -0.01
    assert complaints == []
    page.close()


def test_curves_move_with_the_time_line(chromium: Any, file: str):
    page, complaints = opened(chromium, file)
    page.click("[title^=Curves]")
    said = []
    for frame in (0, 12):
        page.evaluate("(frame) => egs.player.seek(frame)", frame)
        said.append(page.text_content(".row .value"))
    assert page.locator(".curve").count() == 5 and said[0] != said[1]
    page.locator(".curve").first.click(position={"x": 100, "y": 5})
    assert 0 < page.evaluate("egs.player.framePosition") < 12
    assert complaints == []
    page.close()


def test_orbit_turns_the_camera(chromium: Any, file: str):
    page, _ = opened(chromium, file)
    before = page.evaluate("egs.viewers[0].camera.position.toArray()")
    page.mouse.move(240, 200)
    page.mouse.down()
    page.mouse.move(340, 200, steps=4)
    page.mouse.up()
    page.wait_for_timeout(100)
    after = page.evaluate("egs.viewers[0].camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 0.2
    page.close()


def test_screenshot_and_video_are_files(chromium: Any, file: str, tmp_path: Path):
    page, complaints = opened(chromium, file)
    with page.expect_download() as picture:
        page.keyboard.press("s")
    assert picture.value.suggested_filename == "pawn-jump-0.png"
    picture.value.save_as(tmp_path / "picture.png")
    assert Image.open(tmp_path / "picture.png").size == (480, 480)
    with page.expect_download(timeout=60_000) as video:
        page.click("[title^=Record]")
    video.value.save_as(tmp_path / "video")
    assert (tmp_path / "video").stat().st_size > 2000
    assert (tmp_path / "video").read_bytes()[:4] == b"\x1aE\xdf\xa3" or b"ftyp" in (tmp_path / "video").read_bytes()[
        :16
    ]
    assert complaints == []
    page.close()


def test_a_phone_shows_creature_and_controls(chromium: Any, file: str):
    page, complaints = opened(chromium, file, 360, 740)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    for part in (".dock", ".tools", ".play", ".line"):
        box = page.locator(part).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] + box["height"] <= 740, part
    page.evaluate("egs.setLayer('ground', false)")
    picture = _picture(page)
    body = np.abs(picture - np.array(_BACKGROUND)).max(axis=-1) > 0.05
    columns = np.flatnonzero(body.any(axis=0))
    assert columns.min() > 2 and columns.max() < picture.shape[1] - 3
    assert complaints == []
    page.close()


def test_open_curves_do_not_cover_the_creature_on_a_phone(chromium: Any, file: str):
    """The picture moves up when the curves open, and back when they close."""
    page, complaints = opened(chromium, file, 390, 844)
    page.evaluate("egs.setLayer('ground', false)")
    rows = []
    for press in (None, "c", "c"):
        if press is not None:
            page.keyboard.press(press)
        page.wait_for_timeout(100)
        picture = _picture(page)
        body = np.flatnonzero((np.abs(picture - np.array(_BACKGROUND)).max(axis=-1) > 0.05).any(axis=1))
        covered = page.locator(".dock").bounding_box()["y"]
        if press == "c" and len(rows) == 1:
            covered = page.locator(".curves").bounding_box()["y"]
            assert covered < 700
        assert body.max() < covered and body.min() > 0
        rows.append(body)
    assert rows[1].max() < rows[0].max() - 20
    np.testing.assert_allclose(rows[2][[0, -1]], rows[0][[0, -1]], atol=1)
    assert complaints == []
    page.close()


def test_two_runs_side_by_side_share_time_and_camera(chromium: Any, recording: Recording):
    with served(recording, recording) as server:
        page, complaints = opened(chromium, server.address, 800, 400)
        page.evaluate("egs.setLayer('ground', false); egs.viewers[0].preset('side'); egs.player.seek(6)")
        first, second = _picture(page, 0), _picture(page, 1)
        assert first.shape == second.shape
        assert np.abs(first - second).max() < 0.02
        assert complaints == []
        page.close()


def test_a_stopped_server_is_reported(chromium: Any, recording: Recording):
    page = chromium.new_page()
    with served(recording) as server:
        page.route("**/run/0", lambda route: route.fulfill(status=404, body=""))
        page.goto(server.address)
        page.wait_for_selector("[role=alert]:has-text('is egs-warp view still running?')")
    page.close()


def test_a_browser_without_webgl2_gets_a_message(file: str):
    # Playwright can be started only once in a process.
    script = f"""
from playwright.sync_api import sync_playwright
with sync_playwright() as started:
    browser = started.chromium.launch(executable_path={BROWSER!r}, args=["--disable-3d-apis", "--no-sandbox"])
    page = browser.new_page()
    page.goto({file!r})
    page.wait_for_selector("[role=alert]:has-text('WebGL2')")
    browser.close()
"""
    pytest.importorskip("playwright.sync_api")
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)


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
    picture = _picture(page)
    # The floor is grey, and darker in the shadow under the creature.
    middle = picture[picture.shape[0] // 2, picture.shape[1] // 2]
    assert 0.12 < middle.mean() < 0.3
    assert abs(np.median(picture[180:300, 10:40]) - 0.5) < 0.03
    page.evaluate("egs.setLayer('scene', false)")
    np.testing.assert_allclose(_picture(page)[240, 20], _BACKGROUND, atol=0.01)
    assert complaints == []
    page.close()
