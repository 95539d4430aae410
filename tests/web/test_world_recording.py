"""Page of a world in Chromium, which shows all bodies and selects the one that is clicked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from egs_warp import cli
from egs_warp.errors import UserError
from egs_warp.web.world_recording import WorldRecording, read_recording
from tests.support.chromium import opened
from tests.support.finished_worlds import write_world_run
from tests.support.live_pages import in_browser

_CLICK_ON = """(index) => {
    const viewer = egs.viewers[0], [first, count] = viewer.parts[index].nodes;
    const box = viewer.canvas.getBoundingClientRect();
    viewer.camera.updateMatrixWorld();
    for (let node = first; node < first + count; node++) {
        const point = viewer.nodePosition(node).project(viewer.camera);
        const at = [box.left + (0.5 + 0.5 * point.x) * box.width, box.top + (0.5 - 0.5 * point.y) * box.height];
        // The positions of clicks are whole pixels.
        at.forEach((value, k) => { at[k] = Math.round(value); });
        const hit = viewer.pick(...at);
        if (hit !== undefined && viewer.bodyOf(hit.node) === index) return at;
    }
}"""
"""JavaScript that returns a window position at which a body is visible."""


@pytest.mark.parametrize("scheme", ["dark", "light"])
@in_browser
def test_a_click_selects_a_body(chromium: Any, tmp_path: Path, scheme: str) -> None:
    folder, file = write_world_run(tmp_path / "run"), tmp_path / "world.html"
    assert cli.main(["view", str(folder), "--export", str(file)]) == 0
    page, complaints = opened(chromium, file.as_uri(), 700, 460, color_scheme=scheme)
    rows = page.locator(".bodies .body")
    assert rows.count() == 2 and page.evaluate("egs.selected") is None
    page.mouse.click(*page.evaluate(_CLICK_ON, 1))
    assert page.evaluate("egs.selected") == 1
    assert rows.nth(1).get_attribute("aria-pressed") == "true" and rows.nth(0).get_attribute("aria-pressed") == "false"
    assert rows.nth(1).locator(".detail").inner_text() == "box-1 fell"
    page.keyboard.press("c")
    assert page.locator(".curves .row:visible").count() == 5
    page.keyboard.press("c")
    centre = page.evaluate("egs.viewers[0].centreOfMass.toArray()")
    rows.nth(0).click()
    assert page.evaluate("egs.selected") == 0
    assert page.evaluate("egs.viewers[0].centreOfMass.toArray()")[2] < centre[2] - 0.2
    page.mouse.click(*page.evaluate(_CLICK_ON, 0))
    assert page.evaluate("egs.selected") is None
    assert complaints == []
    page.close()


def test_a_background_is_refused(tmp_path: Path) -> None:
    folder = write_world_run(tmp_path / "run")
    assert isinstance(read_recording(folder), WorldRecording)
    with pytest.raises(UserError, match="a scene behind the body is for the run of a single capture; leave it out"):
        read_recording(folder, background=tmp_path / "a.ply")
