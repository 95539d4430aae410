"""The browser shared by the tests of the page, and a session for each test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from egs_warp.web.session import Session
from tests.support.chromium import started
from tests.support.live_sessions import coarse_pawn, session_of


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """One browser for all tests: Playwright can run only once in a process."""
    with started() as browser:
        yield browser


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    """Session of a coarse pawn that runs in its thread."""
    made = session_of(coarse_pawn(), tmp_path)
    made.start()
    yield made
    made.stop()
