"""The page of ``egs-warp pick`` in a real Chromium, with two balls on a floor."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.web.pick_session import PickSession
from tests.support.chromium import opened, wait_until
from tests.support.clicking import balls
from tests.support.live_pages import in_browser
from tests.support.page_design import check_controls
from tests.support.pages import served
from tests.support.picking import Commands, picking

EACH = 1500
BALLS = np.array([[-0.8, -0.5, 0.5], [0.8, -0.5, 0.5]])
"""Nearest point (3,) of each ball as seen from the front of the scene."""


@contextmanager
def opened_page(
    chromium: Any,
    path: Path,
    *size: int,
    commands: Commands | None = None,
) -> Iterator[tuple[Any, PickSession]]:
    """Open the page of a session that shows the balls from the front; the page must not report errors."""
    session, feed = picking(balls((-0.6, 0.9), between=1.6), path, commands)
    session.start()
    try:
        with served(feed=feed) as server:
            page, complaints = opened(chromium, server.address, *size)
            wait_until(page, "egs.pick.state !== undefined && egs.pick.work === ''")
            frame = session.source.frame
            eye, target = (frame.points(np.array(point)).tolist() for point in ([0.0, -6.5, 2.0], [0.0, 0.0, 0.4]))
            page.evaluate(
                f"""() => {{
                    const viewer = egs.viewers[0], at = viewer.nodePosition(0);
                    viewer.setCamera(at.clone().set(...{eye}), at.set(...{target}));
                }}"""
            )
            page.evaluate("() => egs.viewers[0].drawSorted()")
            yield page, session
            assert complaints == []
            page.close()
    finally:
        session.stop()


def place_of(page: Any, session: PickSession, point: np.ndarray) -> tuple[float, float]:
    """Return the position in the page, in pixels, of a ``point`` (3,) of the capture."""
    x, y, z = session.source.frame.points(point).tolist()
    return tuple(
        page.evaluate(
            f"""() => {{
                const {{ camera, canvas }} = egs.viewers[0];
                camera.updateMatrixWorld();
                const seen = egs.viewers[0].nodePosition(0).set({x}, {y}, {z}).project(camera);
                return [0.5 * (1 + seen.x) * canvas.clientWidth, 0.5 * (1 - seen.y) * canvas.clientHeight];
            }}"""
        )
    )


def changed(page: Any, act: Callable[[], Any]) -> None:
    """Call ``act``, which changes the objects, and wait for their new state."""
    page.evaluate("() => { window.before = egs.pick.state; }")
    act()
    wait_until(page, "egs.pick.state !== window.before && egs.pick.work === ''", seconds=120.0)


def lit(session: PickSession) -> tuple[bool, bool]:
    """Return (left, right), True for each ball that is selected."""
    mask = session.state.pick.mask
    return bool(mask[:EACH].mean() > 0.85), bool(mask[EACH : 2 * EACH].mean() > 0.85)


@in_browser
def test_clicks_add_a_wrong_part_and_remove_it_and_undo_brings_it_back(chromium: Any, tmp_path: Path):
    with opened_page(chromium, tmp_path / "picked.json", 640, 420) as (page, session):
        changed(page, lambda: page.click("button[title='Remove this object']"))
        assert lit(session) == (False, False)
        left, right = (place_of(page, session, point) for point in BALLS)
        changed(page, lambda: page.mouse.click(*left))
        assert lit(session) == (True, False)
        changed(page, lambda: page.mouse.click(*right))
        assert lit(session) == (True, True)
        page.keyboard.press("d")
        changed(page, lambda: page.mouse.click(*right))
        assert lit(session) == (True, False)
        changed(page, lambda: page.keyboard.press("Control+z"))
        assert lit(session) == (True, True)
        changed(page, lambda: page.click("#redo"))
        assert lit(session) == (True, False)
        assert page.text_content(".chip small") == f"{int(session.state.pick.mask.sum()):,}"


@in_browser
def test_what_is_lit_is_brighter_than_the_rest(chromium: Any, tmp_path: Path):
    with opened_page(chromium, tmp_path / "picked.json", 640, 420) as (page, session):
        changed(page, lambda: page.click("button[title='Remove this object']"))
        right = place_of(page, session, BALLS[1])

        def brightness() -> float:
            page.evaluate("() => egs.viewers[0].drawSorted()")
            return page.evaluate(
                f"""() => {{
                    const {{ canvas, renderer }} = egs.viewers[0], pixel = new Uint8Array(4);
                    egs.viewers[0].render();
                    const gl = renderer.getContext(), scale = canvas.height / canvas.clientHeight;
                    gl.readPixels({right[0]} * scale, canvas.height - {right[1]} * scale, 1, 1, gl.RGBA,
                        gl.UNSIGNED_BYTE, pixel);
                    return pixel[0] + pixel[1] + pixel[2];
                }}"""
            )

        plain = brightness()
        changed(page, lambda: page.mouse.click(*place_of(page, session, BALLS[0])))
        dimmed = brightness()
        page.keyboard.press("n")
        changed(page, lambda: page.mouse.click(*right))
        assert dimmed < 0.6 * plain and brightness() > 0.9 * plain


@in_browser
def test_the_ground_and_the_front_are_dragged(chromium: Any, tmp_path: Path):
    with opened_page(chromium, tmp_path / "picked.json", 640, 420) as (page, session):
        changed(page, lambda: page.click("button[title='Remove this object']"))
        changed(page, lambda: page.mouse.click(*place_of(page, session, BALLS[1])))

        def drag(handle: str, dx: float, dy: float) -> None:
            x, y = page.evaluate(
                f"""() => {{
                    const {{ camera, canvas }} = egs.viewers[0];
                    const seen = egs.pick.gizmos.handles().get("{handle}").project(camera);
                    return [0.5 * (1 + seen.x) * canvas.clientWidth, 0.5 * (1 - seen.y) * canvas.clientHeight];
                }}"""
            )
            page.mouse.move(x, y)
            page.mouse.down()
            page.mouse.move(x + 0.5 * dx, y + 0.5 * dy, steps=3)
            page.mouse.move(x + dx, y + dy, steps=3)
            page.mouse.up()

        before = session.state.pick
        eye = page.evaluate("egs.viewers[0].camera.position.toArray()")
        changed(page, lambda: drag("ground", 0, -30))
        raised = session.state.pick
        assert raised.plane.normal == pytest.approx(before.plane.normal)
        assert raised.plane.offset < before.plane.offset - 0.02 and raised.mask.sum() < before.mask.sum()
        changed(page, lambda: drag("up", 60, 0))
        assert 5.0 < np.degrees(np.arccos(session.state.pick.plane.normal @ before.plane.normal)) < 60.0
        changed(page, lambda: page.click("#undo"))
        changed(page, lambda: page.click("#undo"))
        assert session.state.pick.plane is before.plane
        # Uneven ground stays visible when its plane is moved, and is hidden while another object is selected.
        assert page.evaluate(
            """() => {
                const { gizmos, state } = egs.pick, [x, y, z, d] = state.plane;
                const axes = { first: [1, 0, 0], second: [0, 1, 0] };
                const grid = { ...axes, spacing: 18, count: 2, heights: [0.1, 0.1, 0.1, 0.1] };
                gizmos.showGround({ origin: [-9, -9, 0], ...grid });
                gizmos.show({ ...state, plane: [x, y, z, d - 0.2] });
                const isShown = gizmos.ground !== null;
                gizmos.show({ ...state, active: state.active + 1 });
                const isOther = gizmos.ground !== null;
                gizmos.show(state);
                return [isShown, isOther];
            }"""
        ) == [True, False]
        left = (session.source.frame.axes @ np.array([-1.0, 0.0, 0.0])).tolist()
        changed(page, lambda: page.evaluate(f"egs.viewers[0].source.send({{type: 'front', direction: {left}}})"))
        changed(page, lambda: drag("front", 10, 25))
        front = session.state.pick.front
        assert front is not None and abs(front @ before.plane.normal) < 1e-6
        # The front was turned towards the viewer.
        assert front @ session.source.frame.axes @ np.array([0.0, -1.0, 0.0]) > 0.1
        # The camera does not turn while a handle is dragged.
        assert page.evaluate("egs.viewers[0].camera.position.toArray()") == pytest.approx(eye, abs=1e-6)


@in_browser
def test_a_stroke_of_the_brush_marks(chromium: Any, tmp_path: Path):
    with opened_page(chromium, tmp_path / "picked.json", 640, 420) as (page, session):
        changed(page, lambda: page.click("button[title='Remove this object']"))
        page.keyboard.press("b")
        x, y = place_of(page, session, BALLS[1])

        def stroke() -> None:
            page.mouse.move(x - 15, y)
            page.mouse.down()
            page.mouse.move(x + 15, y + 5, steps=8)
            page.mouse.up()

        changed(page, stroke)
        assert lit(session) == (False, True) and len(session.state.pick.clicks[0].hits) > 3


@in_browser
def test_animate_and_live_write_the_file_and_start_their_commands(chromium: Any, tmp_path: Path, run_folder: Path):
    commands = Commands(run_folder)
    path = tmp_path / "new" / "picked.json"
    with opened_page(chromium, path, 640, 420, commands=commands) as (page, session):
        changed(page, lambda: page.mouse.click(*place_of(page, session, BALLS[1])))
        page.click("#animate")
        wait_until(page, "egs.pick.jobs.get('animate')?.address?.startsWith('http://127.0.0.1:') === true")
        assert page.text_content(".job a") == "show the film in 3D"
        page.click("#live")
        wait_until(page, "egs.pick.jobs.get('live')?.failed === true")
        assert "missing.ply" in page.text_content(".job.wrong")
        assert json.loads(path.read_text())["objects"]
        assert commands.values == [(f"{path}:object 1", "jump"), (f"{path}:object 1", None)]


@in_browser
def test_a_phone_shows_the_panel_on_demand(chromium: Any, tmp_path: Path):
    with opened_page(chromium, tmp_path / "picked.json", 390, 780) as (page, session):
        assert not page.is_visible(".panel")
        page.click("button.narrow")
        assert page.is_visible("#animate")
        assert check_controls(page, 390) > 10
        box = page.evaluate("document.querySelector('.dock').getBoundingClientRect().toJSON()")
        assert box["left"] >= 0 and box["right"] <= 390 and box["height"] < 70
        changed(page, lambda: page.click("button[title='Remove this object']"))
        assert page.is_disabled("#animate") and "click on the object" in page.text_content(".hints")
        assert not session.state.pick.mask.any()
