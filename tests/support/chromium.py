"""Support for tests in the system's Chromium, which renders in software on a machine without a GPU."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from egs_warp.web.page import PAGE

BROWSER = os.environ.get("EGS_WARP_BROWSER") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
SHOTS = os.environ.get("EGS_WARP_SHOTS")
"""Folder that receives a screenshot of each page when its test closes it."""
NEEDED = [
    pytest.mark.browser,
    pytest.mark.skipif(not PAGE.is_file(), reason="the page is not built; make web builds it"),
    pytest.mark.skipif(BROWSER is None, reason="no Chromium; install it, or set EGS_WARP_BROWSER"),
]
"""Pytest marks of tests in a browser."""


@contextmanager
def started() -> Iterator[Any]:
    """Start a browser with Playwright."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as playwright_context:
        arguments = ["--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--no-sandbox"]
        browser = playwright_context.chromium.launch(executable_path=BROWSER, args=arguments)
        yield browser
        browser.close()


def opened(
    chromium: Any,
    address: str,
    width: int = 480,
    height: int = 480,
    *,
    plays: bool = False,
    scripts: Sequence[str] = (),
    **context: Any,
) -> tuple[Any, list[str]]:
    """Open a page and wait until it is loaded; return the page and the list of the browser's errors and warnings.

    Unless ``plays`` is true, a recorded run is stopped at its first frame. ``scripts`` run before the page's own
    scripts; ``context`` contains further settings of the browser, such as ``color_scheme``.
    """
    page = chromium.new_page(viewport={"width": width, "height": height}, **context)
    for script in scripts:
        page.add_init_script(script)
    if SHOTS is not None:
        _keep_shot(page, Path(SHOTS))
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(address)
    wait_until(page, "window.egs !== undefined")
    if not plays:
        page.evaluate("if (egs.live === undefined) { egs.player.playing = false; egs.player.seek(0); }")
    return page, complaints


def _keep_shot(page: Any, folder: Path) -> None:
    close = page.close
    test = os.environ.get("PYTEST_CURRENT_TEST", "page").rpartition("::")[2].partition(" ")[0]

    def shoot_and_close() -> None:
        name = re.sub(r"[^\w-]+", "-", test).strip("-")
        page.screenshot(path=str(folder / f"{name}.png"))
        close()

    page.close = shoot_and_close


def wait_until(page: Any, condition: str, *, seconds: float = 60.0) -> None:
    """Wait until the JavaScript expression ``condition`` is true, also if the page is reloaded in the meantime.

    The page's security policy forbids Playwright's own function for this.
    """
    end = time.monotonic() + seconds
    while not _is_true(page, condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(50)


def wait_for_first_motion(page: Any, name: str) -> None:
    """Wait until the live page shows the first motion of its session, called ``name``, or that it has ended.

    A page that draws few images may show none of a short motion.
    """
    wait_until(page, f"egs.live.state?.doing === '{name}' || egs.live.state?.motions > 0")


def _is_true(page: Any, condition: str) -> bool:
    """Return whether ``condition`` is true; False if the page is being reloaded."""
    try:
        return bool(page.evaluate(condition))
    except pytest.importorskip("playwright.sync_api").Error as error:
        if "Execution context was destroyed" not in error.message:
            raise
        return False
