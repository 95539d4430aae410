"""A live session behind a server, and its page in Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from egs_warp.web.feed import LiveFeed
from egs_warp.web.page import PAGE
from egs_warp.web.server import PageServer
from egs_warp.web.session import Session
from tests.support.chromium import NEEDED, opened
from tests.support.pages import served

needs_page = pytest.mark.skipif(not PAGE.is_file(), reason="the page is not built; make web builds it")
KEEP_SENT = """() => {
    const { source } = egs.viewers[0], send = source.send.bind(source);
    window.sent = [];
    source.send = (message) => { window.sent.push(message); send(message); };
}"""
"""JavaScript that, once it has run, records the page's requests."""


def in_browser(test: Any) -> Any:
    """Decorator that applies the marks of a test in Chromium."""
    for mark in NEEDED:
        test = mark(test)
    return test


@contextmanager
def living(session: Session, **place: Any) -> Iterator[PageServer]:
    """Run the server of a live session within the block."""
    with served(feed=LiveFeed(session), **place) as server:
        yield server


@contextmanager
def watched(chromium: Any, session: Session, *size: int, **settings: Any) -> Iterator[Any]:
    """Open the page of a live session, which must not report errors; ``settings`` are passed to ``opened``."""
    with living(session) as server:
        page, complaints = opened(chromium, server.address, *size, **settings)
        yield page
        assert complaints == []
        page.close()
