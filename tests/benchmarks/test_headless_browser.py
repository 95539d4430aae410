"""Flags and renderer of the browser of the benchmarks of pages."""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType

import pytest

from tests.support.chromium import BROWSER
from tests.support.scripts import module_of


@pytest.fixture
def headless_browser() -> ModuleType:
    return module_of("headless_browser")


def test_a_missing_browser_ends_the_benchmark_with_one_line(
    headless_browser: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    headless_browser.browser_flags(parser)
    with pytest.raises(SystemExit) as ended:
        headless_browser.check_browser(parser, parser.parse_args(["--browser", "no-such-browser"]))
    assert ended.value.code == 2
    assert "no-such-browser was not found; install Chromium" in capsys.readouterr().err


@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium; install it, or set EGS_WARP_BROWSER")
def test_the_flags_reach_chromium(headless_browser: ModuleType) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    parser = argparse.ArgumentParser()
    headless_browser.browser_flags(parser)
    options = parser.parse_args(
        ["--browser", str(BROWSER), "--browser-flags=--use-angle=swiftshader --js-flags=--expose-gc"]
    )

    def check() -> None:
        with playwright.sync_playwright() as started:
            browser = headless_browser.launched(started, options)
            page = browser.new_page()
            assert page.evaluate("typeof gc") == "function"
            assert not headless_browser.is_gpu(headless_browser.renderer_of(page))
            browser.close()

    # Playwright's event loop of an earlier test in this process may still be running in this thread.
    with ThreadPoolExecutor(1) as pool:
        pool.submit(check).result()
