"""Record of the finished stages in a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.io.stage_record import NAME, StageRecord, StageState, stage_key


def test_a_stage_is_used_again_only_with_equal_inputs_options_and_files(tmp_path: Path) -> None:
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    out.mkdir()
    (photos / "a.png").write_bytes(b"a")
    key = stage_key({"n": 1}, [photos])
    record = StageRecord(out)
    assert record.state("train", key) is StageState.MISSING
    record.begin("train", key)
    assert StageRecord(out).state("train", key) is StageState.INTERRUPTED
    (out / "capture.ply").write_bytes(b"capture")
    record.finish("train", key, [out / "capture.ply"])
    assert StageRecord(out).state("train", key) is StageState.FINISHED
    # The key depends only on the content: a copy of the photos is the same input, and hidden files are ignored.
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "a.png").write_bytes(b"a")
    (tmp_path / "copy" / ".cache").write_bytes(b"x")
    assert stage_key({"n": 1}, [tmp_path / "copy"]) == key
    others = [stage_key({"n": 2}, [photos])]
    (photos / "a.png").rename(photos / "b.png")
    others.append(stage_key({"n": 1}, [photos]))
    (photos / "b.png").rename(photos / "a.png")
    (photos / "a.png").write_bytes(b"b")
    others.append(stage_key({"n": 1}, [photos]))
    assert [StageRecord(out).state("train", other) for other in others] == [StageState.OTHER] * 3
    (out / "capture.ply").write_bytes(b"changed")
    assert StageRecord(out).state("train", key) is StageState.OTHER


def test_a_damaged_record_is_one_line(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text('{"train": 1}')
    with pytest.raises(UserError, match="not a record of stages; choose another folder, or move this file away"):
        StageRecord(tmp_path)
