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
from egs_warp.web.preview import PreviewFeed
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


@needs_page
def test_a_front_that_points_up_is_reported_before_the_capture_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=500).cloud)
    shown: list[object] = []
    monkeypatch.setattr(PreviewFeed, "show_preview", lambda _, preview: shown.append(preview))
    assert cli.main(["live", str(tmp_path / "pawn.ply"), "--up", "z", "--front", "z", "--no-browser"]) == 2
    assert "--front 0,0,1: points up or down; give a direction along the ground" in capsys.readouterr().err
    assert shown == []


@needs_page
def test_one_line_states_the_number_of_nodes_and_the_expected_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=500).cloud)
    shown: list[str] = []

    def placed_front(*_: object) -> None:
        raise UserError("the end of this test")

    monkeypatch.setattr("egs_warp.pipelines.creature.placed_front", placed_front)
    monkeypatch.setattr(PreviewFeed, "show_note", lambda _, note: shown.append(note))
    assert cli.main(["live", str(tmp_path / "pawn.ply"), "--up", "z", "--nodes", "60", "--no-browser"]) == 2
    (note,) = shown
    assert re.fullmatch(
        r"the simulation takes longer: the cage needs \d+ nodes instead of 60 to enclose the thin parts of the body; "
        r"expect (about [\d.e-]+ of )?real time",
        note,
    )
    lines = [line for line in capsys.readouterr().err.splitlines() if "nodes" in line]
    assert lines == [f"egs-warp: {note}; --nodes chooses another number"]
