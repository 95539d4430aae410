"""The page as one HTML file: as built by npm, or with runs embedded in it."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from egs_warp.errors import UserError
from egs_warp.io.atomic import atomic_write
from egs_warp.io.run_folder import check_no_file_of_a_run

PAGE = Path(__file__).with_name("page.html")
"""The page that npm builds."""
_RUNS_MARKER = "<!-- runs -->"
"""Placeholder in the page that is replaced by the runs."""


class EncodedRun(Protocol):
    """A run that can be encoded for the page."""

    def bytes(self) -> bytes:
        """Return the header and all frames in the format of a file."""
        ...


def page_text() -> str:
    """Return the page without a run. Raises ``UserError`` if it has not been built."""
    try:
        return PAGE.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError(
            f"{PAGE}: the page is not built; run make web in the source tree (needs node 20 or newer), or install the"
            " egs-warp wheel, which contains it"
        ) from error


def export_page(path: Path, recordings: Sequence[EncodedRun]) -> int:
    """Write the page with ``recordings`` embedded as one HTML file; return its size in bytes.

    Equal runs give identical files. Raises ``UserError`` if ``path`` does not end in .html or is a file of a run.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"{path}: give a file name that ends in .html")
    check_no_file_of_a_run(path)
    scripts = [
        f'<script type="application/octet-stream" data-run="{number}">'
        f"{base64.b64encode(gzip.compress(recording.bytes(), mtime=0)).decode()}</script>"
        for number, recording in enumerate(recordings)
    ]
    text = page_text().replace(_RUNS_MARKER, "\n".join(scripts), 1)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return len(text.encode())
