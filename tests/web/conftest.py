"""The browser that the page's tests share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.chromium import started


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """One browser for all of them: Playwright runs but once in a process."""
    with started() as browser:
        yield browser
