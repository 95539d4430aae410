"""Thread-safe queues between a live session and its page: messages to the session, frames and events to the page."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from egs_warp.web.messages import Message, Release
from egs_warp.web.packets import Frame

News = Frame | dict[str, Any]
"""A frame, or an event as a JSON object."""

_MAX_QUEUED_FRAMES = 240
"""Maximum number of frames and events that are queued for a slow page; if there are more, the oldest frames are
dropped."""
_MAX_QUEUED_MESSAGES = 1000
"""Maximum number of messages that are queued during a step; if there are more, the oldest are dropped."""


class Mailbox:
    """Queue of messages to the session and queue of news for the page, with one condition that signals every change."""

    def __init__(self, changed: threading.Condition | None = None) -> None:
        """Create empty queues. ``changed`` is a condition that several mailboxes share; None creates a condition."""
        self.watched = False
        """True if a page is subscribed."""
        self.stopping = False
        """True if the session is to end."""
        self._inbox: deque[Message] = deque(maxlen=_MAX_QUEUED_MESSAGES)
        self._outbox: deque[News] = deque()
        self._changed = threading.Condition() if changed is None else changed
        self._wake: Callable[[], object] = lambda: None
        self._last_state: dict[str, Any] = {}

    # The page calls the following methods.

    def put_request(self, message: Message) -> None:
        """Queue a message for the session."""
        with self._changed:
            self._inbox.append(message)
            self._changed.notify_all()

    def subscribe(self, wake: Callable[[], object], first: Callable[[], Frame]) -> None:
        """Subscribe a page.

        Args:
            wake: function that is called from the thread of the session when ``take_news`` has new entries.
            first: function that returns the first frame to send.
        """
        with self._changed:
            self.watched, self._wake = True, wake
            self._outbox.clear()
            self._last_state = {}
            self._outbox.append(first())
            self._changed.notify_all()
        wake()

    def unsubscribe(self) -> None:
        """Unsubscribe the page, and end a pull by its user."""
        with self._changed:
            self.watched, self._wake = False, lambda: None
            self._inbox.append(Release())

    def take_news(self) -> list[News]:
        """Return and remove the queued frames and events."""
        with self._changed:
            news = list(self._outbox)
            self._outbox.clear()
        return news

    def stop(self) -> None:
        """End the session: wake its thread and make ``wait_for_work`` return False."""
        with self._changed:
            self.stopping = True
            self._changed.notify_all()

    # The session calls the following methods.

    @property
    def has_requests(self) -> bool:
        """True if there are queued messages."""
        return bool(self._inbox)

    @property
    def has_work(self) -> bool:
        """True if there are queued messages, or if the subscribed page has not received a state yet."""
        return bool(self._inbox) or (self.watched and not self._last_state)

    def take_requests(self) -> list[Message]:
        """Return and remove the queued messages."""
        with self._changed:
            messages = list(self._inbox)
            self._inbox.clear()
        return messages

    def wait_for_work(self, is_suspended: Callable[[], bool], on_wake: Callable[[], object]) -> bool:
        """Block while the session is suspended, has no messages, and has sent its state.

        Args:
            is_suspended: function that returns True if no step has to be computed.
            on_wake: function that is called after each wait.

        Returns:
            False if the session is to end.
        """
        with self._changed:
            while not self.stopping and is_suspended() and not self._inbox and self._last_state:
                self._changed.wait()
                on_wake()
            return not self.stopping

    def wait_until(self, seconds_left: Callable[[], float]) -> None:
        """Block while ``seconds_left`` is positive and no message is queued."""
        while (seconds := seconds_left()) > 0.0 and not self.stopping:
            with self._changed:
                if self._inbox:
                    return
                self._changed.wait(seconds)

    def send(self, news: News) -> None:
        """Queue a frame or an event for the page, if one is subscribed."""
        with self._changed:
            if not self.watched:
                return
            self._outbox.append(news)
            if len(self._outbox) > _MAX_QUEUED_FRAMES:
                oldest = next((one for one in self._outbox if isinstance(one, Frame)), None)
                if oldest is not None:
                    self._outbox.remove(oldest)
            wake = self._wake
        wake()

    def send_line(self, line: str) -> None:
        """Send one line of text to the user."""
        self.send({"type": "told", "text": line})

    @contextmanager
    def send_busy(self) -> Iterator[None]:
        """Show on the page that the session is busy, within the context."""
        self.send({"type": "busy", "on": True})
        try:
            yield
        finally:
            self.send({"type": "busy", "on": False})

    def send_state(self, state: Mapping[str, Any]) -> None:
        """Send ``state`` if it differs from the last state that the page received."""
        if state != self._last_state:
            self._last_state = dict(state)
            self.send(dict(state))
