"""The system's Chromium, which draws in software where there is no GPU."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from egs_warp.web.page import PAGE

BROWSER = os.environ.get("EGS_WARP_BROWSER") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
NEEDED = [
    pytest.mark.browser,
    pytest.mark.skipif(not PAGE.is_file(), reason="the page is not built; make web builds it"),
    pytest.mark.skipif(BROWSER is None, reason="no Chromium; install it, or set EGS_WARP_BROWSER"),
]
"""Marks of tests in a browser."""


@contextmanager
def started() -> Iterator[Any]:
    """A browser of Playwright."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as begun:
        arguments = ["--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--no-sandbox"]
        browser = begun.chromium.launch(executable_path=BROWSER, args=arguments)
        yield browser
        browser.close()


def opened(chromium: Any, address: str, width: int = 480, height: int = 480) -> tuple[Any, list[str]]:
    """The page once it stands, and what the browser complains of."""
    page = chromium.new_page(viewport={"width": width, "height": height})
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(address)
    wait_until(page, "window.egs !== undefined")
    return page, complaints


def wait_until(page: Any, condition: str, *, seconds: float = 60.0) -> None:
    """Until the JavaScript ``condition`` holds; Playwright's own waiting is what the page's security policy forbids."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(50)
