"""Fixtures of the page tests: a live session, and the page of a recorded run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from egs_warp.web.page import export_page
from egs_warp.web.recording import Recording
from egs_warp.web.session import Session
from tests.support.live_sessions import coarse_pawn, session_of


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    """Run a session of a coarse pawn in its thread."""
    made = session_of(coarse_pawn(), tmp_path)
    made.start()
    yield made
    made.stop()


@pytest.fixture(scope="module")
def recording(run_folder: Path) -> Recording:
    """Return the run of ``run_folder``, ready for the page."""
    return Recording.read(run_folder)


@pytest.fixture(scope="module")
def page_file(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the address of the exported page of ``recording``."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    export_page(path, [recording])
    return path.as_uri()
