"""Feed of the page of ``egs-warp pick``: it sends the capture and the events of the session, and receives the messages
of the page."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator

from egs_warp.web.pick_messages import read_pick_message
from egs_warp.web.pick_session import PickSession
from egs_warp.web.preview import StillRun


class PickFeed:
    """``FrameFeed`` of a session that picks objects."""

    def __init__(self, session: PickSession, shown: StillRun) -> None:
        """Create the feed of ``session``; ``shown`` is the capture in the frame of the page."""
        self._session, self._shown = session, shown

    def header(self) -> bytes:
        """Return the header of the capture."""
        return self._shown.header

    async def packets(self) -> AsyncGenerator[bytes | str]:
        """Yield the frame of the capture, and then the events, until the consumer closes the generator."""
        loop, has_news = asyncio.get_running_loop(), asyncio.Event()
        yield self._shown.frame
        self._session.subscribe(lambda: loop.call_soon_threadsafe(has_news.set))
        try:
            while True:
                await has_news.wait()
                has_news.clear()
                for event in self._session.take_events():
                    yield json.dumps(event)
        finally:
            self._session.unsubscribe()

    def receive(self, message: dict[str, object]) -> None:
        """Queue a message from the page for the session. Raises ``ValueError`` for an invalid message."""
        self._session.put_request(read_pick_message(message))
