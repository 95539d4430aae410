"""WCAG rules on every page, in light and dark colours, with menus and panels closed and open, and operation by
keyboard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from egs_warp.pipelines.bundle import export_bundle
from egs_warp.web.page import export_page
from egs_warp.web.player import PLAYER, player_script
from egs_warp.web.recording import Recording
from egs_warp.web.session import Session
from tests.support.accessibility import axe, needs_axe, violations
from tests.support.chromium import NEEDED, opened, wait_until
from tests.support.clicking import balls
from tests.support.live_pages import watched
from tests.support.page_design import check_controls, check_focus, contrast
from tests.support.pages import served
from tests.support.picking import picking
from tests.support.static_site import served_folder

pytestmark = NEEDED
SCHEMES = pytest.mark.parametrize("scheme", ["light", "dark"])


@needs_axe
@SCHEMES
def test_view(chromium: Any, run_folder: Path, tmp_path: Path, scheme: str) -> None:
    export_page(tmp_path / "page.html", [Recording.read(run_folder)])
    address = (tmp_path / "page.html").as_uri()
    page, complaints = opened(chromium, address, 390, 780, color_scheme=scheme, scripts=[axe()])
    assert violations(page) == []
    page.evaluate("egs.setLayer('muscles', true)")
    page.keyboard.press("c")
    page.click("[title=Layers]")
    assert violations(page) == []
    page.click("[title=Camera]")
    page.keyboard.press("?")
    assert violations(page) == []
    # A deliberate violation shows that the checks detect one.
    page.evaluate("document.querySelector('.play').removeAttribute('title')")
    page.evaluate("document.querySelector('.play').removeAttribute('aria-label')")
    (found,) = violations(page)
    assert found.startswith("button-name")
    assert complaints == []
    page.close()


@needs_axe
@SCHEMES
def test_live(chromium: Any, session: Session, scheme: str) -> None:
    with watched(chromium, session, 390, 780, color_scheme=scheme, scripts=[axe()]) as page:
        assert violations(page) == []
        for sheet in ("Keys", "Style"):
            page.click(f"[title^={sheet}]")
            assert violations(page) == [], sheet


@SCHEMES
def test_a_phone_has_labelled_readable_controls_within_its_width(
    chromium: Any, run_folder: Path, tmp_path: Path, scheme: str
) -> None:
    export_page(tmp_path / "page.html", [Recording.read(run_folder)])
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri(), 360, 740, color_scheme=scheme)
    page.evaluate("egs.setLayer('muscles', true)")
    page.keyboard.press("c")
    for menu in ("Layers", "Camera"):
        page.click(f"[title={menu}]")
        assert page.get_attribute(f"[title={menu}]", "aria-expanded") == "true"
        assert check_controls(page, 360) > 20
    check_focus(page, 8)
    for text in (".clock", ".menu:not([hidden]) .item", ".legend", ".curves small"):
        assert contrast(page, text, ".dock") >= 4.5, text
    assert (page.evaluate("getComputedStyle(document.body).color") == "rgb(217, 222, 232)") == (scheme == "dark")
    edge = page.evaluate("getComputedStyle(document.querySelector('.legend i')).filter")
    assert ("rgba(217, 222, 232, 0.8)" in edge) == (scheme == "dark"), edge
    assert complaints == []
    page.close()


def test_the_space_bar_operates_the_focused_control_or_playback(
    chromium: Any, run_folder: Path, tmp_path: Path
) -> None:
    export_page(tmp_path / "page.html", [Recording.read(run_folder)])
    page, complaints = opened(chromium, (tmp_path / "page.html").as_uri())
    canvas, layers, cage = (page.locator(selector) for selector in (".view", "[title=Layers]", "#layer-cage"))
    assert canvas.get_attribute("role") == "application"
    page.keyboard.press("Tab")
    assert canvas.evaluate("(canvas) => canvas === document.activeElement")
    page.keyboard.press("Tab")
    page.keyboard.press(" ")
    assert layers.get_attribute("aria-expanded") == "true"
    cage.focus()
    page.keyboard.press(" ")
    assert cage.is_checked() and not page.evaluate("egs.player.playing")
    canvas.focus()
    page.keyboard.press(" ")
    assert page.evaluate("egs.player.playing")
    assert complaints == []
    page.close()


def test_the_keyboard_opens_panels_and_moves_sliders(chromium: Any, session: Session) -> None:
    with watched(chromium, session, 1000, 640) as page:
        wait_until(page, "egs.live.state !== undefined")
        opener, slider = page.locator("[title^=Style]"), page.locator("[aria-label=Friction]")
        opener.focus()
        page.keyboard.press("Enter")
        assert opener.get_attribute("aria-expanded") == "true" and slider.is_visible()
        slider.focus()
        before = float(slider.input_value())
        for _ in range(3):
            page.keyboard.press("ArrowRight")
        after = float(slider.input_value())
        assert after > before + 2.5 * float(slider.get_attribute("step"))
        assert slider.get_attribute("aria-valuetext") == f"{after:.2f}"
        wait_until(page, f"Math.abs(egs.live.state.friction - {after}) < 1e-6")
        page.keyboard.press("Escape")
        assert opener.get_attribute("aria-expanded") == "false"
        page.keyboard.press("?")
        assert page.get_attribute("[title^=Keys]", "aria-expanded") == "true"


@needs_axe
@SCHEMES
def test_pick(chromium: Any, tmp_path: Path, scheme: str) -> None:
    session, feed = picking(balls((-0.6, 0.9), between=1.6), tmp_path / "picked.json")
    session.start()
    try:
        with served(feed=feed) as server:
            page, complaints = opened(chromium, server.address, 1000, 640, color_scheme=scheme, scripts=[axe()])
            wait_until(page, "egs.pick.state !== undefined && egs.pick.work === ''")
            assert violations(page) == []
            assert complaints == []
            page.close()
    finally:
        session.stop()


@needs_axe
@SCHEMES
@pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it")
def test_player(chromium: Any, run_folder: Path, tmp_path: Path, scheme: str) -> None:
    export_bundle(Recording.read(run_folder), tmp_path / "a.egs")
    (tmp_path / "player.js").write_text(player_script(), encoding="utf-8")
    (tmp_path / "index.html").write_text(
        '<!doctype html><html lang="en"><head><title>Player</title><link rel="icon" href="data:,">'
        '<script type="module" src="player.js"></script></head><body><main><h1>Player</h1>'
        '<egs-player style="width:300px" src="a.egs" controls></egs-player>'
        '<egs-player style="width:300px" src="a.egs"></egs-player>'
        '<egs-player style="width:300px" src="none.egs"></egs-player></main></body></html>',
        encoding="utf-8",
    )
    with served_folder(tmp_path) as site:
        page = chromium.new_page(viewport={"width": 390, "height": 1000}, color_scheme=scheme)
        page.add_init_script(axe())
        page.goto(f"{site}/index.html")
        wait_until(
            page, "[...document.querySelectorAll('egs-player')].slice(0, 2).every((one) => one.readyState === 4)"
        )
        assert violations(page) == []
        page.close()
