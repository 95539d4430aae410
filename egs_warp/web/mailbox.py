"""Between the thread of a live session and that of its page: what is asked, and what is to be sent."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from egs_warp.web.messages import Message, Release
from egs_warp.web.packets import Frame

News = Frame | dict[str, Any]

_MAX_QUEUED_FRAMES = 240
"""Frames for a page that is slow to take them; older ones are dropped."""
_MAX_QUEUED_MESSAGES = 1000
"""Messages that wait for a step to end."""


class Mailbox:
    """Two boxes and one condition, which is told of whatever is put in."""

    def __init__(self) -> None:
        self.watched = False
        """Whether a page takes what is sent."""
        self.stopping = False
        """Whether the session is to end."""
        self._inbox: deque[Message] = deque(maxlen=_MAX_QUEUED_MESSAGES)
        self._outbox: deque[News] = deque()
        self._changed = threading.Condition()
        self._wake: Callable[[], object] = lambda: None
        self._last_state: dict[str, Any] = {}

    # For the page.

    def put_request(self, message: Message) -> None:
        """Leave a message."""
        with self._changed:
            self._inbox.append(message)
            self._changed.notify_all()

    def subscribe(self, wake: Callable[[], object], first: Callable[[], Frame]) -> None:
        """``wake`` is called, from the session's thread, when ``waiting`` has something. It begins with ``first``."""
        with self._changed:
            self.watched, self._wake = True, wake
            self._outbox.clear()
            self._last_state = {}
            self._outbox.append(first())
            self._changed.notify_all()
        wake()

    def unsubscribe(self) -> None:
        """Nobody watches: let go of what is pulled."""
        with self._changed:
            self.watched, self._wake = False, lambda: None
            self._inbox.append(Release())

    def take_news(self) -> list[News]:
        """Frames and news since the last call."""
        with self._changed:
            taken = list(self._outbox)
            self._outbox.clear()
        return taken

    def stop(self) -> None:
        """End what waits."""
        with self._changed:
            self.stopping = True
            self._changed.notify_all()

    # For the session.

    def take_requests(self) -> list[Message]:
        """Messages since the last call."""
        with self._changed:
            messages = list(self._inbox)
            self._inbox.clear()
        return messages

    def wait_for_work(self, held: Callable[[], bool], waited: Callable[[], object]) -> bool:
        """Wait while the session is ``held`` and has nothing to do or to tell, and call ``waited`` after each time;
        False at the end."""
        with self._changed:
            while not self.stopping and held() and not self._inbox and self._last_state:
                self._changed.wait()
                waited()
            return not self.stopping

    def wait_until(self, left: Callable[[], float]) -> None:
        """Wait while there are seconds ``left``, or until something is asked."""
        while (seconds := left()) > 0.0 and not self.stopping:
            with self._changed:
                if self._inbox:
                    return
                self._changed.wait(seconds)

    def send(self, news: News) -> None:
        """Put it with what waits for the page, if one watches."""
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
        """One line for the user."""
        self.send({"type": "told", "text": line})

    @contextmanager
    def send_busy(self) -> Iterator[None]:
        """The page shows that it takes a while."""
        self.send({"type": "busy", "on": True})
        try:
            yield
        finally:
            self.send({"type": "busy", "on": False})

    def send_state(self, state: Mapping[str, Any]) -> None:
        """How things stand, where that is new to who watches."""
        if state != self._last_state:
            self._last_state = dict(state)
            self.send(dict(state))
