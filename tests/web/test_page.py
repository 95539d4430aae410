"""Playback, files and errors of the page in a real Chromium, which renders in software if there is no GPU."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3
import numpy as np
import pytest
from PIL import Image

from egs_warp.web.recording import Recording
from tests.support.chromium import BROWSER, NEEDED, opened, wait_until
from tests.support.page_pictures import picture_of
from tests.support.pages import served

pytestmark = NEEDED


_COUNT_SPLATS_AT_START = """const timer = setInterval(() => {
    if (window.egs === undefined || egs.framePosition === 0) return;
    window.splatsAtStart = egs.viewers[0].splatRenderer.spark.activeSplats;
    clearInterval(timer);
}, 1)"""
"""JavaScript that counts the splats that are drawn when the second frame begins."""


def test_a_run_plays_by_itself_once_its_splats_are_sorted(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file, plays=True, scripts=[_COUNT_SPLATS_AT_START])
    wait_until(page, "egs.player.playing && egs.player.framePosition > 3")
    assert page.evaluate("splatsAtStart") > 0
    page.keyboard.press(" ")
    assert not page.evaluate("egs.player.playing")
    page.close()
    still = chromium.new_page(reduced_motion="reduce")
    still.goto(page_file)
    wait_until(still, "window.egs !== undefined")
    wait_until(still, "!egs.viewers[0].dirty")
    assert still.evaluate("!egs.player.playing && egs.viewers[0].splatRenderer.spark.activeSplats > 0")
    assert complaints == []
    still.close()


def test_play_advances_and_loops(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
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


def test_a_slow_machine_waits_for_its_splats_to_be_sorted(chromium: Any, page_file: str):
    """Playback does not advance until the splats are sorted, because with an outdated order the ground could be drawn
    over the moved body."""
    page, _ = opened(chromium, page_file)
    page.evaluate("Object.defineProperty(egs.viewers[0], 'sorting', { get: () => window.held })")
    page.evaluate("() => { window.held = true; egs.player.playing = true; egs.frameTime = 0.001; }")
    wait_until(page, "egs.player.framePosition > 0")
    page.evaluate("() => { egs.frameTime = 1; window.at = egs.player.framePosition; }")
    page.wait_for_timeout(500)
    assert page.evaluate("egs.player.playing && egs.player.framePosition === window.at")
    page.evaluate("window.held = false")
    wait_until(page, "egs.player.framePosition !== window.at")
    page.close()


def test_two_runs_side_by_side_share_time_and_camera(chromium: Any, recording: Recording):
    with served(recording, recording) as server:
        page, complaints = opened(chromium, server.address, 800, 400)
        page.evaluate("egs.setLayer('ground', false); egs.viewers[0].preset('side'); egs.player.seek(6)")
        first, second = picture_of(page), picture_of(page, "egs.viewers[1]")
        assert first.shape == second.shape
        assert np.abs(first - second).max() < 0.02
        assert complaints == []
        page.close()


_DRAW_SLOWLY = """() => {
    const [viewer] = egs.viewers, draw = viewer.drawSorted.bind(viewer);
    viewer.drawSorted = async () => {
        await new Promise((resolve) => setTimeout(resolve, 100));
        await draw();
    };
}"""
"""JavaScript that makes the drawing of each frame of a video take longer."""


def test_screenshot_and_video_are_files(chromium: Any, page_file: str, tmp_path: Path):
    page, complaints = opened(chromium, page_file)
    with page.expect_download() as picture:
        page.keyboard.press("s")
    assert picture.value.suggested_filename == "pawn-jump-0.png"
    picture.value.save_as(tmp_path / "picture.png")
    assert Image.open(tmp_path / "picture.png").size == (480, 480)
    # On a slow machine, the video contains the same frames. The body moves in each frame.
    page.evaluate(_DRAW_SLOWLY)
    page.evaluate(
        """() => {
            const step = 0.04 * egs.viewers[0].height;
            egs.viewers[0].source.frames.forEach(({ positions }, frame) => {
                for (let k = 0; k < positions.length; k += 3) positions[k] += step * frame;
            });
            egs.player.seek(4);
        }"""
    )
    with page.expect_download(timeout=60_000) as video:
        page.click("[title^=Record]")
    assert video.value.suggested_filename == "pawn-jump.mp4"
    video.value.save_as(tmp_path / "video.mp4")
    facts = imageio.v3.immeta(tmp_path / "video.mp4", plugin="FFMPEG")
    assert facts["fps"] == 60.0 and facts["duration"] == pytest.approx(13 / 60, abs=0.011)
    frames = imageio.v3.imread(tmp_path / "video.mp4", plugin="FFMPEG") / 255.0
    assert frames.shape == (13, 480, 480, 3)
    assert page.evaluate("egs.player.framePosition") == 4
    for frame in (0, 7, 12):
        page.evaluate(f"egs.player.seek({frame})")
        seen = picture_of(page)
        errors = [float(((seen - one) ** 2).mean()) for one in frames]
        assert errors.index(min(errors)) == frame and errors[frame] < 1e-3
    assert complaints == []
    page.close()


def test_a_video_can_be_cancelled(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
    page.evaluate(_DRAW_SLOWLY)
    page.evaluate("() => { window.saved = 0; egs.saveVideo = () => { saved++; }; egs.player.seek(5); }")
    page.click("[title^=Record]")
    # The canvas and the controls must not change the frames.
    assert page.evaluate("document.querySelector('.views').inert && document.querySelector('.dock').inert")
    page.click("text=Cancel")
    page.wait_for_selector(".recording", state="hidden")
    assert page.evaluate("[saved, egs.player.framePosition, document.querySelector('.dock').inert]") == [0, 5, False]
    assert complaints == []
    page.close()


def test_a_stopped_server_is_reported(chromium: Any, recording: Recording):
    page = chromium.new_page()
    with served(recording) as server:
        page.route("**/run/0", lambda route: route.fulfill(status=404, body=""))
        page.goto(server.address)
        page.wait_for_selector("[role=alert]:has-text('is egs-warp view still running?')")
    page.close()


def test_a_browser_without_webgl2_gets_a_message(page_file: str):
    # Playwright can be started only once in a process.
    script = f"""
from playwright.sync_api import sync_playwright
with sync_playwright() as started:
    browser = started.chromium.launch(executable_path={BROWSER!r}, args=["--disable-3d-apis", "--no-sandbox"])
    page = browser.new_page()
    page.goto({page_file!r})
    page.wait_for_selector("[role=alert]:has-text('WebGL2')")
    browser.close()
"""
    pytest.importorskip("playwright.sync_api")
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)
