"""Fixture of the page tests, which provides a live session."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from egs_warp.web.session import Session
from tests.support.live_sessions import coarse_pawn, session_of


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    """Run a session of a coarse pawn in its thread."""
    made = session_of(coarse_pawn(), tmp_path)
    made.start()
    yield made
    made.stop()
