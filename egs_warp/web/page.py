"""The page as one file: as npm built it, and with runs inside, for any browser and any host."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from pathlib import Path

from egs_warp.errors import UserError
from egs_warp.io.atomic import atomic_write
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.web.recording import Recording

PAGE = Path(__file__).with_name("page.html")
_RUNS_MARKER = "<!-- runs -->"


def page_text() -> str:
    """The page without a run. Raises ``UserError`` in a source tree where it has not been built."""
    try:
        return PAGE.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError(
            f"{PAGE}: the page is not built; run make web in the source tree (it needs node 20 or newer), or install"
            " the egs-warp wheel, which holds it"
        ) from error


def export_page(path: Path, recordings: Sequence[Recording]) -> int:
    """Write ``recordings`` and the page that shows them as one HTML file; returns its size in bytes.

    The same runs give the same file. Raises ``UserError`` for another ending than .html, and a file of a run.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"{path}: give a name that ends in .html")
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
