"""Takes that a live session records, and its scripts."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.request import MotionRequest
from egs_warp.motions.script import motion
from egs_warp.motions.style import PRESETS, Style
from egs_warp.pipelines.report import AUDIT_LIMITS
from egs_warp.web.recording import Recording
from egs_warp.web.recordings import script_text
from tests.support.disk_faults import fail_once
from tests.support.live_sessions import SteppedSession, coarse_pawn


def test_a_script_lists_the_motions(tmp_path: Path):
    asked = motion("jump 0.3 0.2, twist 90, hop")
    path = tmp_path / "script.json"
    path.write_text(script_text(asked.requests))
    assert motion(str(path)) == asked
    layered = motion("walk 0.3 + nod 15 at=0.5, bow")
    path.write_text(script_text(layered.requests))
    assert motion(str(path)) == layered
    assert json.loads(script_text([MotionRequest("jump", {"distance": 0.5, "height": 0.2})])) == [
        {"motion": "jump", "distance": 0.5, "height": 0.2}
    ]


@pytest.mark.parametrize("style", [Style(), Style(**PRESETS["light"]), Style(squash=1.35)], ids=str)
def test_a_script_keeps_the_style_of_each_jump(style: Style, tmp_path: Path):
    jump, walk = motion("jump 0.3 0.2, walk 0.2").requests
    styled = replace(jump, style=style)
    path = tmp_path / "script.json"
    path.write_text(script_text([styled, walk, jump]))
    assert motion(str(path)).requests == (styled, walk, jump)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[SteppedSession, Path]:
    """Record a jump from its crouch until the body rests, after a twist that is not part of the take."""
    folder = tmp_path_factory.mktemp("takes")
    played = SteppedSession(coarse_pawn(), folder)
    played.request("motion", text="twist 20 0 0.1")
    played.until_idle()
    played.request("record", on=True)
    played.request("motion", text="jump 0.2 0.15")
    played.until_idle()
    played.request("record", on=False)
    return played, folder / "take-1"


@pytest.mark.slow
def test_a_take_is_a_run_like_any_other(take: tuple[SteppedSession, Path]):
    played, path = take
    assert played.messages[-1].startswith(f"wrote {path} (")
    assert played.messages[-1].endswith(f"egs-warp view {path}")
    assert json.loads((path / "manifest.json").read_text())["finished"]
    recording = Recording.read(path)
    assert recording.title == "pawn · jump"
    frames = list(recording.frames())
    assert len(frames) == len(recording.trajectory.dt) + 1
    np.testing.assert_allclose(frames[-1].positions, played.frames[-1].positions)


@pytest.mark.slow
def test_the_report_is_measured_and_the_audit_passes(take: tuple[SteppedSession, Path]):
    report = json.loads((take[1] / "report.json").read_text())
    (jump,) = report["motion"]
    assert jump["name"] == "jump" and jump["asked"] == {"distance": 0.2, "height": 0.15}
    assert jump["reached"]["distance"] == pytest.approx(0.2, abs=0.08)
    assert jump["reached"]["airborne_frames"] > 5
    assert {name for name, limit in AUDIT_LIMITS.items() if not report["audit"][name] <= limit} == set()
    assert report["asked"] == {"live": True, "friction": 0.8, "sag": 0.05}
    assert report["notes"] == []


@pytest.mark.slow
def test_the_script_repeats_only_the_motions(take: tuple[SteppedSession, Path]):
    assert motion(str(take[1] / "script.json")) == motion("jump 0.2 0.15")


@pytest.mark.slow
def test_the_script_of_all_motions_is_reported(take: tuple[SteppedSession, Path], tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.request("script")
    assert played.news[-1] == {"type": "script", "text": "[\n\n]\n", "motions": 0}
    take[0].request("script")
    told, path = take[0].news[-1], tmp_path / "script.json"
    path.write_text(str(told["text"]))
    assert told["motions"] == 2 and motion(str(path)) == motion("twist 20 0 0.1, jump 0.2 0.15")


def test_a_take_with_a_pull_passes_the_audit_and_a_second_take_is_another_folder(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    for _ in range(2):
        played.request("record", on=True)
        played.step(2)
        played.request("pull", node=0, x=0.1, y=0.0, z=0.2)
        played.step(3)
        played.request("release")
        played.request("record", on=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["take-1", "take-2"]
    report = json.loads((tmp_path / "take-2" / "report.json").read_text())
    assert report["notes"] == ["the user pulled or pushed the body; script.json does not repeat this"]
    assert {name for name, limit in AUDIT_LIMITS.items() if not report["audit"][name] <= limit} == set()
    assert Trajectory.load(tmp_path / "take-2" / "trajectory.npz").kick_step.tolist() == [2, 3, 4]
    # The energy of the pushes is far above the bound of the audit.
    assert abs(report["energy"]["flows"]["pushes"]) > 1e3 * AUDIT_LIMITS["energy_residual"]


def test_an_empty_take_and_an_unwritable_folder_are_reported(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path / "file" / "takes")
    played.request("record", on=True)
    played.request("record", on=False)
    assert played.messages[-1] == "nothing has moved since the take started; no take is written"
    (tmp_path / "file").write_text("")
    played.request("record", on=True)
    played.step()
    played.request("record", on=False)
    assert played.messages[-1].startswith("the take cannot be written: ")
    assert not played.session.state_message()["recording"]


@pytest.mark.parametrize(
    "reason",
    [
        pytest.param(errno.ENOSPC, id="full"),
        pytest.param(errno.EACCES, id="refused", marks=pytest.mark.slow),
        pytest.param(errno.EPIPE, id="pipe", marks=pytest.mark.slow),
    ],
)
def test_each_file_operation_of_a_take_fails_once(reason: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is reported, no half-written or finished take is left, and the session continues."""
    for number in range(100):
        folder = tmp_path / str(number)
        played = SteppedSession(coarse_pawn(), folder)
        played.request("record", on=True)
        played.step()
        with monkeypatch.context() as patch:
            failed = fail_once(patch, number, reason)
            played.request("record", on=False)
        finished = [path for path in folder.glob("*/manifest.json") if json.loads(path.read_text())["finished"]]
        assert not list(folder.rglob(".egs-*"))
        if not failed:
            break
        assert (
            played.messages[-1].startswith("the take cannot be written: ")
            and os.strerror(reason) in played.messages[-1]
        )
        assert not finished and not played.session.state_message()["recording"]
        played.step()
    assert number > 8 and len(finished) == 1 and played.messages[-1].startswith("wrote ")
