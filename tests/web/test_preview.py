"""Static capture that a live page shows while its creature is prepared."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncGenerator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egs_warp.assets.pawn import pawn
from egs_warp.geometry.frames import box_corners
from egs_warp.pipelines.facing_direction import Front
from egs_warp.web.feed import LiveFeed, live_camera
from egs_warp.web.preview import DISTANCE, FOV_DEGREES, PreviewFeed, preview_of, view_size
from egs_warp.web.session import Session
from tests.support.chromium import opened, wait_until
from tests.support.live_pages import in_browser
from tests.support.live_sessions import coarse_pawn
from tests.support.packets import read_packets
from tests.support.pages import served

_KEEP_STILL_WIDTH = """{
    const { remove } = Element.prototype;
    Element.prototype.remove = function () {
        if (this.classList.contains("still")) window.stillWidth = this.naturalWidth;
        remove.call(this);
    };
}"""
"""JavaScript that records the width of the picture that covers a page while it loads, when the picture is removed."""


@pytest.mark.parametrize("scale", [1.0, 40.0])
def test_the_capture_stands_upright_and_is_one_high(scale: float):
    scene = pawn(gaussian_count=2000)
    cloud, plane = scene.cloud, scene.plane
    if scale != 1.0:
        cloud = cloud.scaled(scale)
    facts, arrays, _ = read_packets(preview_of(cloud, up=plane.normal).header)
    assert facts["preparing"] and facts["flat"]
    low, high = np.percentile(arrays["splats_means"][:, 2], [1.0, 99.0])
    assert low == pytest.approx(0.0, abs=0.1) and high == pytest.approx(1.0, abs=0.1)


def test_the_camera_turns_with_the_front():
    """The camera keeps its height, its distance and its angle to the front, which is given in the capture's axes."""
    scene = pawn(gaussian_count=2000)
    preview = preview_of(scene.cloud, plane=scene.plane)
    middle, axes = preview.bounds.mean(axis=0), preview.body_frame.axes

    def seen(front: np.ndarray) -> tuple[float, float, float]:
        camera = preview.camera(Front(front, None).rotated(axes.T))
        offset = np.array(camera["position"]) - middle
        np.testing.assert_allclose(np.cross(offset, camera["forward"]), 0.0, atol=1e-9)
        aside = np.arctan2(front[0] * offset[1] - front[1] * offset[0], front[:2] @ offset[:2])
        return aside, offset[2], float(np.linalg.norm(offset))

    ahead, aslant = (seen(np.array(front)) for front in ([1.0, 0.0, 0.0], [-0.6, 0.8, 0.0]))
    assert ahead == pytest.approx(aslant)
    # A front that is known at the start needs no turn.
    facts, _, _ = read_packets(preview_of(scene.cloud, plane=scene.plane, front=axes[1]).header)
    assert facts["camera"]["position"] == pytest.approx(preview.camera(Front(axes[1], None))["position"])


@pytest.mark.parametrize("degrees", [None, 75.0, 180.0])
def test_the_camera_looks_in_the_direction_of_the_live_camera(degrees: float | None):
    """The view does not jump at the reload, even if the estimate of the front is not clear."""
    scene, creature = pawn(gaussian_count=2000), coarse_pawn()
    turned = None if degrees is None else np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
    creature = replace(creature, front=Front(np.array([1.0, 0.0, 0.0]), "a guess", turned))
    axes = creature.frame.axes
    preview = preview_of(scene.cloud, plane=scene.plane)
    shown = preview.body_frame.axes.T @ preview.camera(creature.front.rotated(axes.T))["forward"]
    np.testing.assert_allclose(shown, axes.T @ live_camera(creature).rotation[2], atol=0.01)


def test_a_wide_body_is_not_cut_off_at_its_sides():
    """Every corner of the box of a body of any width is in a square picture, from every direction; a body that is not
    wide is shown from the usual distance."""
    half = np.tan(np.radians(0.5 * FOV_DEGREES))
    for width in (0.5, 1.0, 3.0, 8.0):
        bounds = np.array([[-0.5 * width, -0.25 * width, 0.0], [0.5 * width, 0.25 * width, 1.0]])
        size = view_size(bounds)
        assert size == 1.0 or width > 1.0
        corners = box_corners(*bounds) - bounds.mean(axis=0)
        for angle in np.linspace(0.0, 2.0 * np.pi, 24):
            back = np.array([0.95 * np.cos(angle), 0.95 * np.sin(angle), 0.31])
            right = np.array([-np.sin(angle), np.cos(angle), 0.0])
            depth = DISTANCE * size - corners @ back
            assert np.abs(corners @ right / depth).max() < half


def test_a_page_that_connects_late_receives_the_front_and_the_expected_speed():
    scene = pawn(gaussian_count=500)
    feed = PreviewFeed()
    feed.show_stage("cage")
    preview = preview_of(scene.cloud, plane=scene.plane)
    feed.show_preview(preview)
    feed.show_note("the body has 444 nodes")
    front = Front(preview.body_frame.axes[1], None)
    feed.show_front(front)
    feed.show_stage("contact")

    async def first() -> Any:
        async for packet in feed.packets():
            if isinstance(packet, str):
                return json.loads(packet)

    event = asyncio.run(first())
    assert (event["stage"], event["note"]) == ("contact", "the body has 444 nodes")
    assert event["camera"] == preview.camera(front)


def test_stages_come_in_order_and_the_session_follows():
    scene = pawn(gaussian_count=500)
    feed = PreviewFeed()
    with pytest.raises(ValueError, match="is being prepared"):
        feed.receive({"type": "pause", "on": True})

    class Following:
        def header(self) -> bytes:
            return b"header"

        async def packets(self) -> AsyncGenerator[bytes | str]:
            yield b"frame"

        def receive(self, message: dict[str, object]) -> None:
            del message

    async def waited() -> list[Any]:
        stages = []
        async for event in feed.events_before_header():
            stages.append(json.loads(event)["stage"])
            if len(stages) == 1:
                feed.show_stage("up direction")
            else:
                feed.show_preview(preview_of(scene.cloud, plane=scene.plane))
        return stages

    async def heard() -> list[Any]:
        packets = []
        async for packet in feed.packets():
            packets.append(packet if isinstance(packet, bytes) else json.loads(packet))
            if len(packets) == 2:
                feed.show_stage("cage")
            if len(packets) == 3:
                feed.start(Following())
        return packets

    assert asyncio.run(waited()) == ["", "up direction"]
    assert feed.header()
    frame, first, stage, ready = asyncio.run(heard())
    assert isinstance(frame, bytes)
    assert (first, stage, ready) == (
        {"type": "preparing", "stage": "up direction"},
        {"type": "preparing", "stage": "cage"},
        {"type": "ready"},
    )
    assert feed.header() == b"header" and asyncio.run(waited()) == []
    assert asyncio.run(heard()) == [b"frame"]


@in_browser
def test_the_page_shows_the_capture_at_once_and_then_the_creature(chromium: Any, session: Session):
    """Before the up direction is known, the page shows the stage; later, the picture of the capture covers the page
    until the creature is drawn."""
    scene = pawn(gaussian_count=2000)
    feed = PreviewFeed()
    feed.show_stage("up direction")
    with served(feed=feed) as server:
        waiting = chromium.new_page()
        waiting.goto(server.address)
        waiting.locator("[role=alert]:has-text('Preparing the body: finding which way is up\u2026')").wait_for()
        waiting.close()
        feed.show_preview(preview_of(scene.cloud, title="pawn", plane=scene.plane))
        page, complaints = opened(chromium, server.address, scripts=[_KEEP_STILL_WIDTH])
        feed.show_stage("cage")
        wait_until(page, "/step 1 of 6: fitting a cage/.test(document.querySelector('.status').textContent)")
        feed.show_error("the capture is too flat")
        wait_until(page, "document.querySelector('.status.wrong')?.textContent === 'the capture is too flat'")
        assert page.evaluate("egs.live === undefined && egs.viewers.length === 1")
        with page.expect_navigation():
            feed.start(LiveFeed(session))
        wait_until(page, "window.egs?.live?.state !== undefined")
        wait_until(page, "window.stillWidth > 100 && document.querySelector('.still') === null")
        assert complaints == []
        page.close()


@in_browser
def test_a_key_before_the_body_is_ready_is_queued_or_refused(chromium: Any, session: Session):
    """The page says which at once; the queued motion is performed when the body is ready."""
    scene = pawn(gaussian_count=2000)
    downloads: list[object] = []
    feed = PreviewFeed()
    feed.show_stage("up direction")
    with served(feed=feed) as server:
        page = chromium.new_page()
        page.goto(server.address)
        page.locator("[role=alert]:has-text('finding which way is up')").wait_for()
        page.keyboard.press("j")
        answer = page.locator(".answer")
        assert answer.text_content() == "Queued: long jump. It starts when the body is ready; Esc cancels it."
        feed.show_preview(preview_of(scene.cloud, plane=scene.plane))
        feed.show_stage("cage")
        wait_until(page, "window.egs?.isDrawn")
        page.keyboard.press("Escape")
        assert answer.text_content() == "Cancelled: long jump."
        page.keyboard.press("b")
        assert answer.text_content() == "The body is not ready yet."
        # The keys of a recorded run are not available: S saves no image, and C shows no curves.
        page.on("download", lambda download: downloads.append(download))
        page.keyboard.press("c")
        page.keyboard.press("s")
        assert answer.text_content().startswith("Queued: turn around.")
        page.wait_for_timeout(500)
        assert downloads == [] and page.locator(".curves:visible").count() == 0
        page.keyboard.press(" ")
        assert answer.text_content().startswith("Queued: jump.") and answer.is_visible()
        feed.start(LiveFeed(session))
        wait_until(page, "window.egs?.live?.state?.motions === 1")
        assert [request.name for request in session.steering.requests] == ["jump"]
        assert page.locator(".answer").count() == 0
        page.close()


class _SlowFeed(LiveFeed):
    """Feed whose header is available only after ``is_released`` is set."""

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.is_released = threading.Event()

    def header(self) -> bytes:
        assert self.is_released.wait(60.0)
        return super().header()


@in_browser
def test_keys_are_queued_while_the_page_of_the_creature_loads(chromium: Any, session: Session):
    scene = pawn(gaussian_count=2000)
    feed, slow = PreviewFeed(), _SlowFeed(session)
    feed.show_preview(preview_of(scene.cloud, plane=scene.plane))
    with served(feed=feed) as server:
        page, complaints = opened(chromium, server.address)
        page.keyboard.press("j")
        with page.expect_navigation():
            feed.start(slow)
        page.locator(".answer:has-text('Queued: long jump.')").wait_for()
        page.keyboard.press("h")
        assert page.text_content(".answer").startswith("Queued: hop.")
        slow.is_released.set()
        wait_until(page, "window.egs?.live?.state?.motions === 1")
        assert [request.name for request in session.steering.requests] == ["hop"]
        assert page.locator(".answer").count() == 0 and complaints == []
        page.close()


@in_browser
def test_a_hidden_tab_loads_the_creature_although_its_camera_cannot_turn(chromium: Any, session: Session):
    scene = pawn(gaussian_count=2000)
    feed, preview = PreviewFeed(), preview_of(scene.cloud, plane=scene.plane)
    feed.show_preview(preview)
    with served(feed=feed) as server:
        page, complaints = opened(chromium, server.address)
        page.evaluate("egs.viewers[0].renderer.setAnimationLoop(null)")
        feed.show_front(Front(np.array([-0.6, 0.8, 0.0]), None).rotated(preview.body_frame.axes.T))
        wait_until(page, "egs.viewers[0].turn.isActive")
        page.evaluate("Object.defineProperty(document, 'hidden', { value: true })")
        with page.expect_navigation():
            feed.start(LiveFeed(session))
        wait_until(page, "window.egs?.live?.state !== undefined")
        assert complaints == []
        page.close()


_AZIMUTH = """(() => {
    const { camera, controls } = egs.viewers[0], { x, y } = camera.position.clone().sub(controls.target);
    return Math.atan2(y, x) * 180 / Math.PI;
})()"""
"""JavaScript for the angle of the camera about the vertical, degrees."""


def _azimuth_of(camera: dict[str, Any]) -> float:
    """Return the same angle for the entry ``camera`` of a header or an event."""
    x, y, _ = camera["forward"]
    return float(np.degrees(np.arctan2(-y, -x)))


def _turn(to: float, start: float) -> float:
    """Return the smaller angle between two directions, degrees."""
    return (to - start + 180.0) % 360.0 - 180.0


@in_browser
@pytest.mark.parametrize("drags", [False, True])
def test_the_camera_turns_smoothly_to_the_front_and_stays_there(chromium: Any, session: Session, drags: bool):
    """Neither the front nor the change to the creature makes the picture jump; the view of a user stays. A click is no
    change of the view."""
    scene = pawn(gaussian_count=2000)
    feed, preview = PreviewFeed(), preview_of(scene.cloud, plane=scene.plane)
    front = Front(np.array([-0.6, 0.8, 0.0]), None).rotated(preview.body_frame.axes.T)
    feed.show_preview(preview)
    with served(feed=feed) as server:
        page, complaints = opened(chromium, server.address)
        wait_until(page, "egs.isDrawn")
        if drags:
            start = page.evaluate(_AZIMUTH)
            # Without inertia, the camera stops with the pointer.
            page.evaluate("egs.viewers[0].controls.enableDamping = false")
            page.mouse.move(240, 100)
            page.mouse.down()
            page.mouse.move(300, 100, steps=3)
            page.mouse.up()
            wait_until(page, f"Math.abs({_AZIMUTH} - ({start})) > 20")
        else:
            page.mouse.click(240, 200)
            page.locator(".answer:has-text('The body is not ready yet.')").wait_for()
        start = page.evaluate(_AZIMUTH)
        page.evaluate(
            f"""() => {{
                window.seen = [];
                const look = () => {{ window.seen.push({_AZIMUTH}); requestAnimationFrame(look); }};
                look();
            }}"""
        )
        feed.show_front(front)
        text = "its front is found; " + ("your view stays" if drags else "the camera turns to it")
        page.locator(f".status:has-text('{text}')").wait_for()
        wait_until(page, "!egs.viewers[0].turn.isActive")
        page.wait_for_timeout(300)
        steps = np.abs(np.diff(np.unwrap(page.evaluate("window.seen"), period=360.0)))
        end, film = page.evaluate(_AZIMUTH), _azimuth_of(preview.camera(front))
        if drags:
            assert _turn(end, start) == pytest.approx(0.0, abs=0.5) and abs(_turn(end, film)) > 20.0
        else:
            assert _turn(end, film) == pytest.approx(0.0, abs=0.5)
            assert steps.max() < 0.7 * abs(_turn(end, start)) and (steps > 0.5).sum() >= 3
        with page.expect_navigation():
            feed.start(LiveFeed(session))
        wait_until(page, "window.egs?.live?.state !== undefined")
        live_film = _azimuth_of(page.evaluate("egs.viewers[0].source.header.facts.camera"))
        assert _turn(page.evaluate(_AZIMUTH), live_film) == pytest.approx(_turn(end, film), abs=1.0)
        assert complaints == []
        page.close()
