"""Static capture that a live page shows while its creature is prepared."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from typing import Any

import numpy as np
import pytest

from egs_warp.assets.pawn import pawn
from egs_warp.web.feed import LiveFeed
from egs_warp.web.preview import PreviewFeed, preview_of
from egs_warp.web.session import Session
from tests.support.chromium import opened, wait_until
from tests.support.live_pages import in_browser
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
        waiting.locator("[role=alert]:has-text('Preparing the body: up direction\u2026')").wait_for()
        waiting.close()
        feed.show_preview(preview_of(scene.cloud, title="pawn", plane=scene.plane))
        page, complaints = opened(chromium, server.address, scripts=[_KEEP_STILL_WIDTH])
        feed.show_stage("cage")
        wait_until(page, "document.querySelector('.status').textContent === 'Preparing the body: cage\\u2026'")
        feed.show_error("the capture is too flat")
        wait_until(page, "document.querySelector('.status.wrong')?.textContent === 'the capture is too flat'")
        assert page.evaluate("egs.live === undefined && egs.viewers.length === 1")
        with page.expect_navigation():
            feed.start(LiveFeed(session))
        wait_until(page, "window.egs?.live?.state !== undefined")
        wait_until(page, "window.stillWidth > 100 && document.querySelector('.still') === null")
        assert complaints == []
        page.close()
