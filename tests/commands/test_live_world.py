"""``egs-warp live WORLD.yaml`` refuses flags that describe a single capture, before it prepares a body."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp import cli
from tests.support.live_pages import needs_page


@needs_page
@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ["--friction", "0.2"],
            "--friction: it is for a single capture; a world file describes its bodies; leave",
        ),
        (["--nodes", "100"], "--nodes: it is for a single capture"),
        (["--out", "takes"], "--out: it is for a single capture"),
    ],
)
def test_flags_of_a_single_capture_are_refused(
    tmp_path: Path, flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "world.yaml"
    file.write_text("bodies:\n  - {capture: missing.ply}\n")
    assert cli.main(["live", str(file), "--no-browser", *flags]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert cli.main(["live", str(file), "--no-browser"]) == 2
    assert "world.yaml, line 2: " in capsys.readouterr().err
