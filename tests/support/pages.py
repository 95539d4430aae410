"""Server of the page in a thread, and feed of frames for its socket."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Iterator
from contextlib import contextmanager
from typing import Any

from egs_warp.web.recording import Recording
from egs_warp.web.server import FrameFeed, PageServer, SharedFeed


class RecordedFeed:
    """Feed that sends the frames of a recording in a loop."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.received: list[dict[str, object]] = []

    def header(self) -> bytes:
        """Return the header of the recording."""
        return self._recording.header()

    async def packets(self) -> AsyncGenerator[bytes | str]:
        """Yield the frames of the recording in a loop."""
        while True:
            for frame in self._recording.frames():
                yield frame.packet()
                await asyncio.sleep(0.01)

    def receive(self, message: dict[str, object]) -> None:
        """Record a pause message; raise ``ValueError`` for any other message."""
        if message.get("type") != "pause":
            raise ValueError(f"type {message.get('type')}")
        self.received.append(message)


@contextmanager
def served(*runs: Recording, feed: FrameFeed | SharedFeed | None = None, **place: Any) -> Iterator[PageServer]:
    """Run a server within the block; ``place`` may contain its port and token."""
    server = PageServer([run.bytes for run in runs], feed=feed, **place)
    thread = threading.Thread(target=server.serve)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(timeout=20)
        assert not thread.is_alive()
