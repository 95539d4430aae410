"""Output files that the user names: files of different runs are not mixed, and no earlier output is lost."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.io.named_files import check_named_files, named_files
from tests.support.concurrent_runs import error_of_second_process


def write(*paths: Path, text: str, overwrite: bool = False) -> None:
    with named_files(*paths, overwrite=overwrite) as files:
        files.begin()
        for path in paths:
            path.write_text(text)


def test_existing_files_are_refused_or_moved_aside(tmp_path: Path) -> None:
    first, second = tmp_path / "made" / "a.ply", tmp_path / "made" / "a.png"
    write(first, second, text="1")
    first.unlink()
    with pytest.raises(UserError, match=r"out .*a\.ply: a\.png exists already; .*move it aside with overwrite"):
        write(first, second, text="2")
    write(first, second, text="2", overwrite=True)
    write(first, second, text="3", overwrite=True)
    assert sorted(os.listdir(first.parent)) == ["a.ply", "a.png", "earlier-1", "earlier-2"]
    assert os.listdir(first.parent / "earlier-1") == ["a.png"]
    assert (first.parent / "earlier-2" / "a.ply").read_text() == "2"
    assert first.read_text() == second.read_text() == "3"


def test_a_run_that_fails_before_its_first_file_leaves_the_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write(path, text="1")
    with pytest.raises(KeyboardInterrupt), named_files(path, overwrite=True):
        raise KeyboardInterrupt
    assert path.read_text() == "1" and os.listdir(tmp_path) == ["a.ply"]


def test_two_runs_at_once(tmp_path: Path) -> None:
    """Only the name that is in use is locked, not other names in the same folder."""
    with named_files(tmp_path / "a.ply"):
        assert error_of_second_process(named_files, tmp_path / "a.ply") == (
            f"{tmp_path / 'a.ply'}: another run is writing this file; wait for it, or choose another name"
        )
        assert error_of_second_process(named_files, tmp_path / "b.ply") is None
    assert os.listdir(tmp_path) == []


def test_paths_are_checked_before_the_work_and_not_created(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(UserError, match=r"folder\.ply: is a folder; give the name of a file"):
        check_named_files(tmp_path / "folder.ply")
    with pytest.raises(UserError, match=r"cannot write into this folder \(.*file is a file\)"):
        check_named_files(tmp_path / "file" / "a.ply")
    check_named_files(tmp_path / "new" / "a.ply")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.ply"]


def test_recent_remnants_of_a_killed_run_are_removed_at_the_end(tmp_path: Path) -> None:
    """Half-written files are removed whatever their age, because a training may be killed, resumed and finished within
    seconds."""
    left = tmp_path / ".egs-0123456789abcdef.npz"
    left.write_text("half")
    write(tmp_path / "a.ply", text="1")
    assert sorted(os.listdir(tmp_path)) == ["a.ply"]
