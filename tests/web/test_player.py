"""The element ``<egs-player>`` in a real Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from egs_warp.geometry.main_light import MainLight, irradiance_form
from egs_warp.io.bundle import read_bundle
from egs_warp.lighting.relighting import Relighter
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.web.player import PLAYER, player_script
from tests.support.bundles import FRAMES, bundle_bytes
from tests.support.chromium import NEEDED, wait_until
from tests.support.page_camera import page_camera
from tests.support.page_design import check_controls
from tests.support.page_pictures import picture_of, psnr_on_body
from tests.support.static_site import served_folder

pytestmark = [*NEEDED, pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it")]
_SIZE = 240
_BACKGROUND = "#40607f"
_HEAD = '<!doctype html><html><head><link rel="icon" href="data:,"></head><body>'
_STAGE = "document.querySelector('egs-player').view"


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


@pytest.fixture(scope="module")
def folder(run: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    export_bundle(run, folder / "a.egs")
    (folder / "swing.egs").write_bytes(bundle_bytes())
    (folder / "cut.egs").write_bytes(bundle_bytes()[:-100])
    (folder / "player.js").write_text(player_script(), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def site(folder: Path) -> Iterator[str]:
    with served_folder(folder) as address:
        yield address


def _open(chromium: Any, site: str, folder: Path, body: str) -> tuple[Any, list[str]]:
    """Open a page with the player and the HTML ``body``; return the page and the list of the browser's errors and
    warnings."""
    html = f'{_HEAD}<script type="module" src="player.js"></script>{body}</body></html>'
    (folder / "index.html").write_text(html, encoding="utf-8")
    page = chromium.new_page(viewport={"width": 640, "height": 480})
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(f"{site}/index.html")
    return page, complaints


def _element(attributes: str, name: str = "one") -> str:
    return f'<egs-player id="{name}" style="width:{_SIZE}px" {attributes}></egs-player>'


def _wait_until_ready(page: Any) -> None:
    wait_until(page, "[...document.querySelectorAll('egs-player')].every((one) => one.readyState === 4)")


def _own_picture(run: FinishedRun, page: Any, frame: int) -> np.ndarray:
    """Return ``frame`` rendered by this package with the camera of the page."""
    cloud = run.deformer().deform(run.trajectory.positions[run.steps[frame]]).cloud
    red, green, blue = (int(_BACKGROUND[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    return np.clip(
        render_gaussians(cloud, page_camera(page, _STAGE), background=(red, green, blue)).colour.numpy(), 0.0, 1.0
    )


def test_the_main_light_casts_the_shadow_and_relights_the_turned_body(
    chromium: Any, site: str, folder: Path, run: FinishedRun
) -> None:
    """A rotated body has the colours of the film, and the floor is darker on the side away from the light."""
    direction = np.array([0.48, 0.64, 0.6])
    light = MainLight(direction, 5.0, 0.5, irradiance_form(0.3, 0.0, np.array([0.0, 0.0, 1.0]), 1.0, direction))
    t = run.trajectory
    turned = t.positions @ Rotation.from_euler("z", 150.0, degrees=True).as_matrix().T
    lit = replace(run, trajectory=replace(t, positions=turned), creature=replace(run.creature, light=light))
    export_bundle(lit, folder / "lit.egs", every=12)
    page, complaints = _open(chromium, site, folder, _element(f'src="lit.egs" background="{_BACKGROUND}"'))
    _wait_until_ready(page)
    picture, camera = picture_of(page, _STAGE), page_camera(page, _STAGE)
    deformed = run.deformer().deform(turned[run.steps[0]])
    relit = Relighter(run.creature.splats, light).relight(deformed.cloud, deformed.rotations)
    red, green, blue = (int(_BACKGROUND[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    ours, captured = (
        np.clip(render_gaussians(cloud, camera, background=(red, green, blue)).colour.numpy(), 0.0, 1.0)
        for cloud in (relit, deformed.cloud)
    )
    assert psnr_on_body(ours, picture) >= 38.0 > 10.0 + psnr_on_body(captured, picture)
    page.evaluate("document.querySelector('egs-player').removeAttribute('background')")
    centre = turned[run.steps[0]].mean(axis=0)
    page.evaluate(
        """(centre) => {
            const { view } = document.querySelector("egs-player");
            view.camera.position.set(centre[0], centre[1] + 0.01, 5 * view.height);
            view.controls.target.set(centre[0], centre[1], 0);
            view.controls.update();
            view.creature.object.visible = false;
        }""",
        centre.tolist(),
    )
    camera, floor = page_camera(page, _STAGE), picture_of(page, _STAGE).mean(axis=-1)
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


def test_picture_is_like_our_own_picture_of_the_same_frame(
    chromium: Any, site: str, folder: Path, run: FinishedRun
) -> None:
    page, complaints = _open(chromium, site, folder, _element(f'src="a.egs" background="{_BACKGROUND}"'))
    _wait_until_ready(page)
    pictures = []
    for frame in (0, 12):
        page.evaluate("(seconds) => { document.querySelector('egs-player').currentTime = seconds; }", frame / 60.0)
        pictures.append(picture_of(page, _STAGE))
        assert psnr_on_body(_own_picture(run, page, frame), pictures[-1]) >= 45.0
    assert psnr_on_body(_own_picture(run, page, 0), pictures[1]) < 40.0
    assert complaints == []
    page.close()


def test_the_reader_in_the_browser_agrees_with_ours(chromium: Any, site: str, folder: Path) -> None:
    page, complaints = _open(chromium, site, folder, "")
    read = page.evaluate(
        """async () => {
            const { loadBundle } = await import("./player.js");
            const bundle = await loadBundle("swing.egs");
            await bundle.complete;
            const [block, scene] = bundle.bodies;
            const { splats, cage } = block;
            const list = (values) => values.length === undefined ? values : [...values];
            const lists = (record) => Object.fromEntries(
                Object.entries(record).map(([name, values]) => [name, list(values)]));
            return {
                splats: lists(splats), embedding: lists(cage.embedding), rest: [...cage.rest], tets: [...cage.tets],
                surface: [...cage.surface], frames: cage.frames.map((frame) => [...frame]),
                title: bundle.facts.title, hasCage: scene.cage !== undefined,
            };
        }"""
    )
    body, _ = read_bundle(folder / "swing.egs").bodies
    splats, cage = body.splats, body.cage
    assert cage is not None and read["title"] == "block" and not read["hasCage"]
    deviations = np.exp(splats.log_scales.numpy())
    for name, values in {
        "means": splats.means.numpy(),
        "scales": deviations,
        "opacities": splats.opacities(),
        "colours": 0.5 + 0.28209479 * splats.sh.numpy()[:, 0],
    }.items():
        np.testing.assert_allclose(read["splats"][name], values.ravel(), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(read["splats"]["rotations"], splats.rotations.numpy().ravel(), atol=1e-6)
    bands = np.reshape(read["splats"]["bands"], (splats.count, -1, 3)).astype(float)
    written = (bands - 128.0) / 127.0 * np.array(read["splats"]["bandScales"])[:, None]
    np.testing.assert_allclose(written, splats.sh.numpy()[:, 1:], atol=1e-5)
    np.testing.assert_allclose(read["frames"], cage.nodes.reshape(FRAMES, -1), atol=4e-6)
    for name, values in {"rest": cage.rest_nodes, "tets": cage.cage_tets, "surface": cage.surface}.items():
        np.testing.assert_array_equal(read[name], values.ravel())
    embedding = read["embedding"]
    assert embedding["maxStretch"] == 1.5
    np.testing.assert_array_equal(embedding["meanTets"], np.where(cage.carriers == 0, cage.tets, -1 - cage.tets))
    rows = np.reshape(embedding["arms"], (-1, 15))
    arms, rigid = rows[[0, 2]], rows[1]
    assert rigid[6] == 3.0
    np.testing.assert_array_equal(arms[:, :6], cage.arm_tets)
    own = deviations[cage.carriers == 1]
    shares = np.where(cage.arm_lengths > 0, -cage.arm_lengths * np.tile(own, 2), cage.arm_shares)
    np.testing.assert_allclose(arms[:, 6:12], shares, rtol=1e-5)
    np.testing.assert_allclose(arms[:, 12:], cage.arm_bulges * own, rtol=1e-5)
    assert complaints == []
    page.close()


def test_a_bundle_can_play_before_all_of_it_has_arrived(chromium: Any, site: str, folder: Path) -> None:
    page, complaints = _open(chromium, site, folder, "")
    arrived = page.evaluate(
        """async () => {
            const { readBundle } = await import("./player.js");
            const bytes = new Uint8Array(await (await fetch("swing.egs")).arrayBuffer());
            const text = JSON.parse(new TextDecoder().decode(
                bytes.subarray(12, 12 + new DataView(bytes.buffer).getUint32(8, true))));
            const length = new DataView(bytes.buffer).getUint32(8, true);
            const first = 12 + length + text.bodies[0].blocks[1].arrays.residuals.offset;
            let control;
            const stream = new ReadableStream({ start: (controller) => { control = controller; } });
            for (let k = 0; k < first; k += 97) control.enqueue(bytes.slice(k, Math.min(k + 97, first)));
            const bundle = await readBundle(stream);
            const early = bundle.available;
            control.enqueue(bytes.slice(first));
            control.close();
            await bundle.complete;
            return [early, bundle.available];
        }"""
    )
    assert arrived == [60, FRAMES] and complaints == []
    page.close()


def test_play_ends_and_loop_does_not(chromium: Any, site: str, folder: Path) -> None:
    page, complaints = _open(chromium, site, folder, _element('src="a.egs" controls'))
    _wait_until_ready(page)
    page.evaluate(
        """() => {
            window.heard = [];
            const one = document.querySelector("egs-player");
            for (const name of ["play", "pause", "ended", "seeked"]) one.addEventListener(name, () => heard.push(name));
            one.playbackRate = 2;
            one.play();
        }"""
    )
    wait_until(page, "heard.includes('ended')")
    paused, time, duration = page.evaluate(
        "(({ paused, currentTime, duration }) => [paused, currentTime, duration])(document.querySelector('egs-player'))"
    )
    assert paused and time == duration == pytest.approx(12 / 60)
    assert page.evaluate("heard") == ["play", "ended"]
    page.evaluate(
        """() => {
            window.times = [];
            const one = document.querySelector("egs-player");
            one.setAttribute("loop", "");
            one.addEventListener("timeupdate", () => times.push(one.currentTime));
            one.play();
        }"""
    )
    wait_until(page, "times.filter((time, k) => k > 0 && time < times[k - 1]).length >= 3")
    assert page.evaluate("heard") == ["play", "ended", "play"]
    page.locator("egs-player button[title^=Pause]").click()
    assert page.evaluate("document.querySelector('egs-player').paused")
    assert complaints == []
    page.close()


def test_the_bar_does_not_cover_the_creature(chromium: Any, site: str, folder: Path) -> None:
    """The picture keeps clear of the bar; without a bar, it fills the element."""
    body = _element(f'src="a.egs" controls background="{_BACKGROUND}"')
    page, complaints = _open(chromium, site, folder, body)
    _wait_until_ready(page)
    lowest = []
    for has_bar in (True, False):
        page.evaluate("(on) => document.querySelector('egs-player').toggleAttribute('controls', on)", has_bar)
        page.wait_for_timeout(100)
        picture = picture_of(page, _STAGE)
        rows = np.flatnonzero((np.abs(picture - picture[0, 0]).max(axis=-1) > 0.05).any(axis=1))
        lowest.append(rows.max())
        if has_bar:
            bar = page.evaluate("document.querySelector('egs-player').shadowRoot.querySelector('.dock').offsetTop")
            assert rows.min() > 0 and rows.max() < bar
    assert lowest[0] < lowest[1] - 20
    assert complaints == []
    page.close()


def test_slider_keys_and_drag(chromium: Any, site: str, folder: Path) -> None:
    page, complaints = _open(chromium, site, folder, _element('src="a.egs" controls'))
    _wait_until_ready(page)
    page.locator("egs-player input").fill("6")
    assert page.evaluate("document.querySelector('egs-player').currentTime") == pytest.approx(0.1)
    # The position is in the middle of the canvas, above the bar.
    box = page.locator("egs-player").bounding_box()
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.4 * box["height"]
    assert check_controls(page, 640) > 4
    before = page.evaluate("document.querySelector('egs-player').view.camera.position.toArray()")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y, steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    after = page.evaluate("document.querySelector('egs-player').view.camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 0.1
    # Each key moves to the next whole frame.
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.querySelector('egs-player').currentTime") == pytest.approx(7 / 60)
    page.keyboard.press(" ")
    wait_until(page, "document.querySelector('egs-player').currentTime > 0.13")
    assert complaints == []
    page.close()


def test_canvas_follows_the_size_of_the_element(chromium: Any, site: str, folder: Path) -> None:
    page, complaints = _open(chromium, site, folder, _element('src="a.egs"'))
    _wait_until_ready(page)
    size = "[one.view.canvas.width, one.view.canvas.height, one.view.camera.aspect]"
    assert page.evaluate(size) == [_SIZE, _SIZE, 1.0]
    page.evaluate("document.querySelector('egs-player').style.cssText = 'width: 300px; height: 150px'")
    wait_until(page, "document.querySelector('egs-player').view.canvas.width === 300")
    assert page.evaluate(size) == [300, 150, 2.0]
    assert complaints == []
    page.close()


def test_two_players_on_one_page_are_independent(chromium: Any, site: str, folder: Path) -> None:
    body = _element('src="a.egs" autoplay loop') + _element('src="swing.egs" controls', "two")
    page, complaints = _open(chromium, site, folder, body)
    _wait_until_ready(page)
    wait_until(page, "one.currentTime > 0")
    assert page.evaluate("[one.paused, two.paused, two.currentTime]") == [False, True, 0]
    page.evaluate("two.currentTime = 1.5")
    assert page.evaluate("[two.currentTime, two.duration]") == [1.5, pytest.approx((FRAMES - 1) / 60)]
    assert complaints == []
    page.close()


def test_the_example_page_shows_three_creatures(chromium: Any, tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "examples" / "web_player" / "index.html"
    (tmp_path / "index.html").write_text(example.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "egs-player.js").write_text(player_script(), encoding="utf-8")
    for name in ("jump", "hop", "twist"):
        (tmp_path / f"{name}.egs").write_bytes(bundle_bytes())
    with served_folder(tmp_path) as site:
        page = chromium.new_page(viewport={"width": 1000, "height": 700})
        complaints: list[str] = []
        page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
        page.goto(f"{site}/index.html")
        _wait_until_ready(page)
        wait_until(page, "document.querySelectorAll('egs-player')[2].currentTime > 0")
        read = "({ paused, playbackRate }) => [paused, playbackRate]"
        played = page.evaluate(f"[...document.querySelectorAll('egs-player')].map({read})")
        assert played == [[False, 1], [True, 0.5], [False, 1]]
        assert complaints == []
        page.close()


_COUNT_RESOURCES = """() => {
    window.resources = { Texture: 0, Buffer: 0, Framebuffer: 0, VertexArray: 0, Program: 0, Shader: 0 };
    const context = WebGL2RenderingContext.prototype;
    for (const kind of Object.keys(resources)) {
        const [create, remove] = [context[`create${kind}`], context[`delete${kind}`]];
        context[`create${kind}`] = function (...values) { resources[kind]++; return create.apply(this, values); };
        context[`delete${kind}`] = function (one) {
            if (one) resources[kind]--;
            return remove.call(this, one);
        };
    }
    window.loops = 0;
    document.addEventListener("timeupdate", ({ target }) => {
        if (target.currentTime < target.last) loops++;
        target.last = target.currentTime;
    }, { capture: true });
}"""
"""JavaScript that counts the existing WebGL objects and the loops of all players."""


def _memory(page: Any) -> tuple[float, dict[str, int]]:
    """Return the memory that scripts use, including array buffers, in MB, and the number of WebGL objects of each
    kind."""
    # The player is paused, because the buffers of a running sort would be in transfer between the page and a worker.
    page.evaluate("for (const player of document.querySelectorAll('egs-player')) player.pause()")
    wait_until(page, "[...document.querySelectorAll('egs-player')].every(({ view }) => !view.sorting)")
    session = page.context.new_cdp_session(page)
    for _ in range(3):
        session.send("HeapProfiler.collectGarbage")
        page.wait_for_timeout(50)
    usage = session.send("Runtime.getHeapUsage")
    session.detach()
    return (usage["usedSize"] + usage["backingStorageSize"]) / 1e6, page.evaluate("({ ...resources })")


@pytest.mark.slow
def test_memory_is_flat_over_a_hundred_loops_of_two_players(chromium: Any, site: str, folder: Path) -> None:
    body = _element('src="a.egs" autoplay loop controls') + _element('src="a.egs" autoplay loop', "two")
    html = f'{_HEAD}<script type="module" src="player.js"></script>{body}</body></html>'
    (folder / "loops.html").write_text(html, encoding="utf-8")
    page = chromium.new_page(viewport={"width": 640, "height": 480})
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.add_init_script(f"({_COUNT_RESOURCES})()")
    page.goto(f"{site}/loops.html")
    _wait_until_ready(page)
    # The browser compiles scripts in the first loops, which are not measured.
    wait_until(page, "loops >= 60")
    before, resources = _memory(page)
    page.evaluate("loops = 0; one.play(); two.play()")
    wait_until(page, "loops >= 200", seconds=240)
    after, resources_after = _memory(page)
    assert resources_after == resources
    assert after - before < 1.0, (before, after)
    assert complaints == []
    page.close()


def test_the_poster_is_shown_until_the_first_picture(chromium: Any, site: str, folder: Path) -> None:
    Image.new("RGB", (8, 8), (255, 0, 0)).save(folder / "poster.png")
    page, complaints = _open(chromium, site, folder, _element('poster="poster.png"'))
    poster = "one.shadowRoot.querySelector('img').hidden"
    assert page.evaluate(poster) is False
    page.evaluate(
        """() => {
            const { prototype } = WebGL2RenderingContext, draw = prototype.drawArraysInstanced;
            window.draws = 0;
            prototype.drawArraysInstanced = function (...values) { draws++; return draw.apply(this, values); };
            one.addEventListener("canplay", () => { window.drawsBefore = draws; });
            one.setAttribute("src", "a.egs");
        }"""
    )
    _wait_until_ready(page)
    assert page.evaluate(poster) is True
    # On a slow machine, each further image of the splats would delay the first picture.
    assert page.evaluate("drawsBefore") == 1
    assert complaints == []
    page.close()


@pytest.mark.parametrize(
    ("name", "said"),
    [("none.egs", "cannot be read (404)"), ("cut.egs", "incomplete"), ("player.js", "is not a bundle")],
)
def test_a_file_that_cannot_be_read_is_reported(name: str, said: str, chromium: Any, site: str, folder: Path) -> None:
    page, _ = _open(chromium, site, folder, _element(f'src="{name}" controls'))
    message = "one.shadowRoot.querySelector('.message')"
    wait_until(page, f"!{message}.hidden")
    assert said in page.evaluate(f"{message}.textContent")
    page.close()


def test_removing_the_element_releases_its_arrays_and_adding_it_starts_it_again(
    chromium: Any, site: str, folder: Path
) -> None:
    page, complaints = _open(chromium, site, folder, _element('src="a.egs"'))
    session = page.context.new_cdp_session(page)
    sizes = []
    page.evaluate("window.kept = one")
    for _ in range(3):
        _wait_until_ready(page)
        page.evaluate("kept.remove()")
        assert page.evaluate("kept.readyState") == 0
        # The WebGL context is released after the sort in progress.
        page.wait_for_timeout(300)
        session.send("HeapProfiler.collectGarbage")
        sizes.append(session.send("Runtime.getHeapUsage")["backingStorageSize"])
        page.evaluate("document.body.append(kept)")
    _wait_until_ready(page)
    assert sizes[2] - sizes[0] < 20_000, sizes
    assert complaints == []
    page.close()
