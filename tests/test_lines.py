"""Line lengths of the web page's sources."""

from __future__ import annotations

from pathlib import Path

import egs_warp.web

SOURCES = Path(egs_warp.web.__file__).parent / "client" / "src"


def test_no_line_of_the_page_is_longer_than_120() -> None:
    """The maximum is the line length of ruff for Python."""
    files = sorted(SOURCES.iterdir())
    assert len(files) > 20
    long = [
        f"{path.name}:{number}"
        for path in files
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > 120
    ]
    assert long == []
