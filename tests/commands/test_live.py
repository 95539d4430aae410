"""``egs-warp live`` prints the address of its page before any long computation."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect

from egs_warp import cli
from egs_warp.assets.pawn import pawn
from egs_warp.commands import live
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.ply import write_ply
from tests.support.live_pages import needs_page


@needs_page
def test_the_address_is_printed_and_the_page_shows_the_stage_before_up_is_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=500).cloud)
    stages: list[Any] = []

    def guessed_up(capture: GaussianCloud) -> tuple[np.ndarray, str]:
        found = re.search(r"open http://([\d.:]+)/(\S+)/\?live", capsys.readouterr().out)
        assert found is not None
        origin: Any = f"http://{found[1]}"
        with connect(f"ws://{found[1]}/{found[2]}/live", origin=origin) as page:
            stages.append(json.loads(page.recv(timeout=20)))
        raise UserError("the end of this test")

    monkeypatch.setattr(live, "guessed_up", guessed_up)
    assert cli.main(["live", str(tmp_path / "pawn.ply"), "--no-browser"]) == 2
    assert stages == [{"type": "preparing", "stage": "up direction"}]
    assert "the end of this test" in capsys.readouterr().err
