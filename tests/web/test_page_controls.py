"""Views, layers, keys and layout of the page in Chromium."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from egs_warp.web.recording import Recording
from tests.support.chromium import NEEDED, opened
from tests.support.page_pictures import BACKGROUND, picture_of

pytestmark = NEEDED


_AZIMUTH = """(preset) => {
    const { camera, controls } = egs.viewers[0];
    egs.viewers[0].preset(preset);
    const from = camera.position.clone().sub(controls.target);
    return Math.atan2(from.y, from.x) * 180 / Math.PI;
}"""
"""JavaScript that selects a view and returns the azimuth of the camera as seen from the body, degrees."""


def test_front_and_side_look_at_the_front_that_was_found(chromium: Any, page_file: str, recording: Recording):
    page, complaints = opened(chromium, page_file)
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


def test_the_menu_of_views_stays_open_and_ticks_the_view(chromium: Any, page_file: str):
    page, _ = opened(chromium, page_file)
    page.click("[title=Camera]")
    ticked = ".item[aria-pressed=true]"
    assert page.inner_text(ticked) == "Film"
    for name in ("Side", "Top"):
        page.click(f".item:has-text('{name}')")
        assert page.locator(ticked).all_inner_texts() == [name]
    page.mouse.move(100, 200)
    page.mouse.wheel(0, 100)
    page.wait_for_selector(ticked, state="detached")
    page.keyboard.press("Escape")
    assert not page.is_visible(".item")
    page.close()


def test_orbit_turns_the_camera(chromium: Any, page_file: str):
    page, _ = opened(chromium, page_file)
    before = page.evaluate("egs.viewers[0].camera.position.toArray()")
    page.mouse.move(240, 200)
    page.mouse.down()
    page.mouse.move(340, 200, steps=4)
    page.mouse.up()
    page.wait_for_timeout(100)
    after = page.evaluate("egs.viewers[0].camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 0.2
    page.close()


def test_the_question_mark_shows_the_keys(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
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


def test_each_layer_shows(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
    page.evaluate("egs.player.seek(8)")
    page.click("[title=Layers]")
    before = picture_of(page)
    for layer in ("cage", "muscles", "contacts", "path", "feet", "ground", "splats"):
        page.click(f"#layer-{layer}")
        after = picture_of(page)
        assert (np.abs(after - before).max(axis=-1) > 0.05).mean() > 2e-4, layer
        before = after
    assert complaints == []
    page.close()


def test_each_shown_overlay_has_its_legend(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
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


def test_muscles_at_rest_differ_from_the_body(chromium: Any, page_file: str):
    """In the first state, without activations, the pixels of muscle lines are clearly lighter or darker than the
    body."""
    page, _ = opened(chromium, page_file)
    body = picture_of(page)
    page.evaluate("egs.setLayer('muscles', true)")
    contrast = np.abs(picture_of(page) - body).max(axis=-1)
    drawn = contrast[contrast > 0.02]
    assert len(drawn) > 500
    assert np.median(drawn) > 0.2
    page.close()


def test_a_foot_is_bright_while_the_ground_bears_it(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
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
        picture = picture_of(page)
        shown = np.abs(picture - np.array(BACKGROUND)).max(axis=-1) > 0.05
        assert shown.mean() > 2e-3
        green[carried] = float((picture[..., 1] - picture[..., 2])[shown].mean())
    # Feet with contacts are mint, which is greenish; feet without are bluish grey.
    assert green[True] > 0.01 and green[False] < -0.01
    assert complaints == []
    page.close()


def test_curves_move_with_the_time_line(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file)
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


def test_a_phone_shows_creature_and_controls(chromium: Any, page_file: str):
    page, complaints = opened(chromium, page_file, 360, 740)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    for part in (".dock", ".tools", ".play", ".line"):
        box = page.locator(part).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] + box["height"] <= 740, part
    page.evaluate("egs.setLayer('ground', false)")
    picture = picture_of(page)
    body = np.abs(picture - np.array(BACKGROUND)).max(axis=-1) > 0.05
    columns = np.flatnonzero(body.any(axis=0))
    assert columns.min() > 2 and columns.max() < picture.shape[1] - 3
    assert complaints == []
    page.close()


def test_open_curves_do_not_cover_the_creature_on_a_phone(chromium: Any, page_file: str):
    """The picture moves up when the curves open, and back when they close."""
    page, complaints = opened(chromium, page_file, 390, 844)
    page.evaluate("egs.setLayer('ground', false)")
    rows = []
    for press in (None, "c", "c"):
        if press is not None:
            page.keyboard.press(press)
        page.wait_for_timeout(100)
        picture = picture_of(page)
        body = np.flatnonzero((np.abs(picture - np.array(BACKGROUND)).max(axis=-1) > 0.05).any(axis=1))
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


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (900, 560), (390, 844)])
def test_panels_do_not_cover_each_other(chromium: Any, page_file: str, width: int, height: int):
    """With all layers, the curves and the keys open, every panel is inside the window and beside the others."""
    page, complaints = opened(chromium, page_file, width, height)
    for key in "45678c?":
        page.keyboard.press(key)
    page.wait_for_timeout(600)
    boxes = page.evaluate(
        """[".legend", ".curves", ".tools", ".sheet:not([hidden])", ".dock", "figcaption"]
            .map((one) => document.querySelector(one)).filter((one) => one.checkVisibility())
            .map((one) => [one.className || one.localName, one.getBoundingClientRect()])
            .map(([name, { left, top, right, bottom }]) => [name, left, top, right, bottom])"""
    )
    assert len(boxes) == (4 if width < 560 else 6)
    for k, (name, left, top, right, bottom) in enumerate(boxes):
        assert left >= 0 and top >= 0 and right <= width and bottom <= height, name
        for other, low, high, end, foot in boxes[:k]:
            assert right <= low or left >= end or bottom <= high or top >= foot, (name, other)
    assert complaints == []
    page.close()
