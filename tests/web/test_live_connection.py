"""Connection of the page of a live creature in a real Chromium: its end, later and second pages."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from egs_warp.web.feed import LiveFeed
from egs_warp.web.session import Session
from tests.support.chromium import opened, wait_for_first_motion, wait_until
from tests.support.live_pages import in_browser, living
from tests.support.pages import served


def _shows_facing(page: Any) -> bool:
    """Return True if the page has drawn the arrow of the facing direction, whose colour is a green."""
    x, y = page.evaluate(
        """() => {
            const viewer = egs.viewers[0], point = egs.live.gizmos.facing.position.clone().project(viewer.camera);
            return [(0.5 + 0.5 * point.x) * innerWidth, (0.5 - 0.5 * point.y) * innerHeight];
        }"""
    )
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)
    red, green, blue = picture[int(y) - 8 : int(y) + 9, int(x) - 8 : int(x) + 9].reshape(-1, 3).T
    return bool(((green > red + 40.0) & (green > blue + 10.0)).sum() > 20)


@in_browser
def test_a_page_says_that_the_program_has_ended_and_reconnects_if_it_is_back(chromium: Any, session: Session):
    feed = LiveFeed(session)
    with served(feed=feed) as server:
        page, complaints = opened(chromium, server.address)
        page.keyboard.press(" ")
        wait_for_first_motion(page, "jump")
        assert complaints == []
        port, token = server.port, server.token
        # A page that sends messages must receive the reason of the end, too.
        page.evaluate("window.sending = setInterval(() => egs.viewers[0].source.send({ type: 'release' }), 1)")
    page.evaluate("clearInterval(sending)")
    wait_until(page, "document.body.classList.contains('lost')")
    assert page.text_content(".lost > .message").startswith("egs-warp has ended. To continue, start it again")
    assert page.evaluate("document.querySelector('.dock').inert")
    assert page.locator("canvas.view").is_visible()
    # A key has no effect, and the page does not claim that it has.
    page.keyboard.press("j")
    assert "long jump" not in page.text_content(".next") and "leap" not in page.text_content(".next")
    assert page.evaluate("egs.live.sent") is None
    wait_until(page, "document.querySelector('.pace').textContent === 'not connected'")
    page.evaluate("window.stayed = true")
    held = session.state.time
    with served(feed=feed, port=port, token=token):
        wait_until(page, f"egs.viewers[0].source.frames.at(-1).time > {held + 0.1}")
        assert not page.evaluate("document.body.classList.contains('lost') || document.querySelector('.dock').inert")
        page.evaluate("egs.viewers[0].source.socket.close()")
        wait_until(
            page,
            "document.querySelector('.lost > .message')?.textContent.startsWith('The connection to egs-warp is lost')",
        )
        wait_until(page, "!document.body.classList.contains('lost')")
        assert page.evaluate("window.stayed") and page.evaluate("egs.live.state?.doing") in ("jump", "stand")
        page.close()


@in_browser
@pytest.mark.slow
def test_a_page_says_what_is_known_if_the_server_is_silent_or_cannot_be_reached(chromium: Any, session: Session):
    """A stopped program keeps its sockets open; a killed one closes them without a code."""
    message = "document.querySelector('.lost > .message')?.textContent"
    with living(session) as server:
        page, _ = opened(chromium, server.address)
        wait_until(page, "egs.live.state !== undefined")
        page.evaluate(
            """() => {
                const socket = egs.viewers[0].source.socket;
                window.receive = socket.onmessage;
                socket.onmessage = () => {};
            }"""
        )
        wait_until(page, f"{message}?.startsWith('egs-warp does not answer: it is stopped or very busy')")
        assert page.evaluate("document.querySelector('.dock').inert && !egs.viewers[0].source.isConnected")
        page.evaluate("() => { egs.viewers[0].source.socket.onmessage = receive; }")
        wait_until(page, "!document.body.classList.contains('lost') && !document.querySelector('.dock').inert")
        # A socket on which nothing arrives for a longer time is replaced.
        page.evaluate(
            """() => {
                window.silent = egs.viewers[0].source.socket;
                silent.onmessage = () => {};
                const now = performance.now.bind(performance);
                performance.now = () => now() + 30000;
            }"""
        )
        wait_until(page, f"{message}?.startsWith('egs-warp does not answer')")
        wait_until(page, "egs.viewers[0].source.socket !== silent && egs.viewers[0].source.isConnected")
        wait_until(page, "!document.body.classList.contains('lost') && !document.querySelector('.dock').inert")
        page.evaluate(
            """() => {
                const { WebSocket } = window;
                window.WebSocket = class extends WebSocket { constructor() { super(`ws://${location.host}/none`); } };
                egs.viewers[0].source.socket.close();
            }"""
        )
        wait_until(page, f"{message}?.startsWith('The connection to egs-warp is lost')")
        assert page.evaluate("document.querySelector('.dock').inert")
        wait_until(page, f"{message}?.startsWith('There is no connection to egs-warp: it has ended, or the network')")
        page.close()


@in_browser
def test_a_page_that_is_opened_later_is_centred_on_the_creature_and_so_is_it_after_a_reset(
    chromium: Any, session: Session
):
    """The film's camera belongs to the start of the session, not to the first frame that a page receives."""
    seen = """() => {
        const viewer = egs.viewers[0], point = viewer.centreOfMass;
        viewer.camera.updateMatrixWorld();
        return point.project(viewer.camera).toArray().slice(0, 2);
    }"""
    with living(session) as server:
        page, complaints = opened(chromium, server.address)
        wait_until(page, "egs.live.state !== undefined")
        expected = page.evaluate(seen)
        page.close()
        state, travel = session.state, np.array([0.9, -1.4, 0.0]) * session.creature.body.height
        session.state = replace(state, positions=state.positions + travel)
        later, _ = opened(chromium, server.address)
        wait_until(later, "egs.live.state !== undefined")
        assert later.evaluate(seen) == pytest.approx(expected, abs=0.02)
        later.keyboard.press("Backspace")
        wait_until(later, "Math.hypot(egs.viewers[0].centreOfMass.x, egs.viewers[0].centreOfMass.y) < 0.1")
        assert later.evaluate(seen) == pytest.approx(expected, abs=0.02)
        for view in ("front", "film"):
            later.click("[title='Camera']")
            later.click(f"#view-{view}")
            assert later.evaluate(seen) == pytest.approx(expected, abs=0.1)
            # Neither the menu nor the item that was clicked keeps the keyboard.
            later.keyboard.press("Escape")
            assert not later.is_visible("#view-front")
        assert later.evaluate("document.activeElement === document.body")
        assert complaints == []
        later.close()


@in_browser
def test_a_second_page_shows_the_creature_when_the_first_is_closed(chromium: Any, session: Session):
    with living(session) as server:
        first, complaints = opened(chromium, server.address)
        second = chromium.new_page()
        second.goto(server.address)
        message = second.locator("[role=alert]:has-text('another page shows this session')")
        message.wait_for()
        size, colour = message.evaluate("(one) => [getComputedStyle(one).fontSize, getComputedStyle(one).color]")
        assert float(size.removesuffix("px")) >= 16.0
        assert colour == second.evaluate("getComputedStyle(document.body).color")
        first.keyboard.press(" ")
        wait_for_first_motion(first, "jump")
        assert complaints == []
        first.close()
        wait_until(second, "window.egs !== undefined && egs.live.state !== undefined")
        second.close()


@in_browser
def test_a_second_page_takes_the_creature_over_and_the_first_takes_it_back(chromium: Any, session: Session):
    with living(session) as server:
        first, complaints = opened(chromium, server.address)
        wait_until(first, "egs.live.state !== undefined")
        second = chromium.new_page()
        second.goto(server.address)
        second.click("[role=alert]:has-text('another page shows this session') button:text-is('Take over')")
        wait_until(second, "window.egs?.live?.state?.resting && egs.isDrawn && !egs.viewers[0].sorting")
        second.wait_for_timeout(300)
        assert _shows_facing(second), "the direction of a body at rest is drawn"
        second.keyboard.press(" ")
        wait_for_first_motion(second, "jump")
        taken = first.locator("[role=alert]:has-text('another page shows this session') button")
        # The button stays the same while the page tries to reconnect.
        taken.evaluate("(one) => { one.id = 'first' }")
        first.wait_for_timeout(1500)
        first.click("#first")
        wait_until(first, "egs.live.state?.motions === 1 && !document.body.classList.contains('lost')")
        second.locator(".lost > [role=alert] button").wait_for()
        assert complaints == [] and first.locator("[role=alert]").count() == 0
        first.close()
        second.close()
