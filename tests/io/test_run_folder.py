"""Output folder of a run: files of different runs are not mixed, and no earlier output is lost."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.io.run_folder import MANIFEST, check_run_folder, clean_up, run_folder
from tests.support.concurrent_runs import error_of_second_process


def finished(folder: Path, **files: str) -> None:
    with run_folder(folder, overwrite=True) as run:
        for name, text in files.items():
            run.file(f"{name}.txt").write_text(text)
        run.finish()


def manifest(folder: Path) -> dict:
    return json.loads((folder / MANIFEST).read_text())


def test_the_manifest_is_written_last_with_checksums(tmp_path: Path) -> None:
    with run_folder(tmp_path / "out") as run:
        run.file("a.txt").write_text("one")
        assert manifest(run.path)["finished"] is False and manifest(run.path)["files"] == {"a.txt": None}
        run.file("b.txt").write_text("three")
        run.finish()
    content = manifest(tmp_path / "out")
    assert content["finished"] is True
    assert content["files"]["b.txt"] == {"bytes": 5, "sha256": hashlib.sha256(b"three").hexdigest()}
    assert sorted(os.listdir(tmp_path / "out")) == ["a.txt", "b.txt", MANIFEST]


def test_initial_files_are_written_before_the_first_file(tmp_path: Path) -> None:
    """Initial files are written once, after an earlier run has been moved aside; a run that writes no file writes no
    initial files."""
    finished(tmp_path, flags="1")
    begun: list[list[str]] = []
    with run_folder(tmp_path, overwrite=True) as run:

        def begin() -> None:
            run.file("flags.txt").write_text("2")
            begun.append(sorted(os.listdir(tmp_path)))

        run.begin_with(begin)
        assert (tmp_path / "flags.txt").read_text() == "1"
        run.file("a.txt")
        run.file("b.txt")
    assert len(begun) == 1 and "earlier-1" in begun[0]
    assert list(manifest(tmp_path)["files"]) == ["flags.txt", "a.txt", "b.txt"]
    assert (tmp_path / "earlier-1" / "flags.txt").read_text() == "1"


def test_an_earlier_run_is_refused_or_moved_aside_whole(tmp_path: Path) -> None:
    finished(tmp_path, hop="1", report="1")
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match=r"it has an earlier run, .*move it aside with overwrite"), run_folder(tmp_path):
        raise AssertionError("must not come here")
    finished(tmp_path, jump="2", report="2")
    assert sorted(os.listdir(tmp_path)) == ["earlier-1", "jump.txt", MANIFEST, "mine.txt", "report.txt"]
    assert (
        (tmp_path / "earlier-1" / "hop.txt").read_text() == (tmp_path / "earlier-1" / "report.txt").read_text() == "1"
    )
    assert set(manifest(tmp_path / "earlier-1")["files"]) == {"hop.txt", "report.txt"}
    finished(tmp_path, jump="3")
    assert (tmp_path / "earlier-2" / "jump.txt").read_text() == "2"


def test_a_run_that_writes_nothing_leaves_the_earlier_one(tmp_path: Path) -> None:
    """Bad input is found after the folder has been locked and before the first file has been written."""
    finished(tmp_path, a="1")
    with pytest.raises(UserError, match="flat"), run_folder(tmp_path, overwrite=True):
        raise UserError("object: it is flat")
    assert sorted(os.listdir(tmp_path)) == ["a.txt", MANIFEST] and (tmp_path / "a.txt").read_text() == "1"


def test_an_unfinished_run_is_reported_and_moved_aside_too(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), run_folder(tmp_path) as run:
        run.file("trajectory.txt").write_text("hours")
        run.file("film.txt")
        raise KeyboardInterrupt
    assert manifest(tmp_path)["finished"] is False
    with pytest.raises(UserError, match="it has an earlier run"):
        check_run_folder(tmp_path)
    finished(tmp_path, film="2")
    assert (tmp_path / "earlier-1" / "trajectory.txt").read_text() == "hours"
    assert not (tmp_path / "trajectory.txt").exists()


def test_files_without_a_run_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("precious")
    with (
        pytest.raises(UserError, match=r"it has a\.txt, which would be mixed with this one"),
        run_folder(tmp_path) as run,
    ):
        run.file("a.txt")
    assert os.listdir(tmp_path) == ["a.txt"]
    finished(tmp_path, a="new")
    assert (tmp_path / "earlier-1" / "a.txt").read_text() == "precious"


def test_two_runs_at_once(tmp_path: Path) -> None:
    with run_folder(tmp_path):
        assert error_of_second_process(run_folder, tmp_path) == (
            f"{tmp_path}: another run is writing into this folder; wait for it, or choose another folder"
        )
    with run_folder(tmp_path):
        pass
    assert os.listdir(tmp_path) == []


def test_a_broken_manifest_counts_as_a_run(tmp_path: Path) -> None:
    """Names in the manifest that point outside the folder are ignored."""
    outside = tmp_path / "secret.txt"
    outside.write_text("secret")
    folder = tmp_path / "out"
    folder.mkdir()
    for text in ("nonsense", json.dumps({"files": {"../secret.txt": None}}), json.dumps({"files": 3})):
        (folder / MANIFEST).write_text(text)
        with pytest.raises(UserError, match="it has an earlier run"):
            check_run_folder(folder)
        finished(folder, a="1")
        assert outside.read_text() == "secret"
        (folder / MANIFEST).unlink()
        (folder / "a.txt").unlink()


def test_paths_are_checked_before_the_work_and_not_created(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out, said in (
        ("", "out '': give the name of a folder"),
        (tmp_path / "file", r"cannot write into this folder \(.*file is a file\)"),
        (tmp_path / "file" / "deeper", r"cannot write into this folder \(.*file is a file\)"),
        (tmp_path / ("x" * 300), "cannot be created"),
        (f"{tmp_path}/a\0b", "cannot be created"),
    ):
        with pytest.raises(UserError, match=said):
            check_run_folder(out)
    check_run_folder(tmp_path / "new" / "deeper")
    assert os.listdir(tmp_path) == ["file"]


def test_remnants_of_a_killed_run_are_removed_by_the_next(tmp_path: Path) -> None:
    """Remnants of any age are removed: an ffmpeg process that outlives its run may write after the next run has
    started."""
    left = tmp_path / f".egs-{'0' * 16}.mp4"
    with run_folder(tmp_path) as run:
        run.file("a.txt").write_text("one")
    with run_folder(tmp_path, resume=True) as run:
        left.write_text("half")
        run.file("a.txt").write_text("two")
        run.finish()
    assert sorted(os.listdir(tmp_path)) == ["a.txt", MANIFEST]


def test_a_run_killed_before_its_first_file_does_not_count(tmp_path: Path) -> None:
    """The manifest of a run that was killed before its first file lists files, none of which exists."""
    with run_folder(tmp_path) as run:
        run.file("a.txt")
    assert manifest(tmp_path)["files"] == {"a.txt": None}
    with (
        pytest.raises(UserError, match="no run has written here; start one without resuming"),
        run_folder(tmp_path, resume=True),
    ):
        raise AssertionError("must not come here")
    check_run_folder(tmp_path)
    with run_folder(tmp_path) as run:
        run.file("a.txt").write_text("one")
        run.finish()
    assert sorted(os.listdir(tmp_path)) == ["a.txt", MANIFEST] and manifest(tmp_path)["finished"] is True
    with pytest.raises(UserError, match="it has an earlier run"):
        check_run_folder(tmp_path)


def test_remnants_of_a_run_killed_at_its_end(tmp_path: Path) -> None:
    """The run is killed after its last update of the manifest and before its end. Files of a run that is still running
    are not touched."""
    with run_folder(tmp_path) as run:
        run.file("a.txt").write_text("one")
        run.finish()
        (tmp_path / "parts").mkdir()
        (tmp_path / "parts" / "b.npz").write_text("step")
        clean_up(tmp_path, "parts")
        assert (tmp_path / "parts" / "b.npz").exists()
    (tmp_path / ".egs-run.lock").write_text("")
    clean_up(tmp_path, "parts")
    assert sorted(os.listdir(tmp_path)) == ["a.txt", MANIFEST]


def test_a_resumed_run(tmp_path: Path) -> None:
    """A resumed run keeps its files, does not write its initial files again, and removes its folders when it
    finishes."""
    with pytest.raises(UserError, match="no run has written here"), run_folder(tmp_path, resume=True):
        raise AssertionError("must not come here")
    with run_folder(tmp_path) as run:
        run.file("a.txt").write_text("one")
        run.file("parts").mkdir()
    with run_folder(tmp_path, resume=True) as run:
        run.begin_with(lambda: pytest.fail("it has begun"))
        assert run.file("a.txt").read_text() == "one" and run.file("parts").is_dir()
        run.file("b.txt").write_text("two")
        run.finish()
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "b.txt", MANIFEST]
    assert set(manifest(tmp_path)["files"]) == {"a.txt", "b.txt"}
    with pytest.raises(UserError, match="this run has finished"), run_folder(tmp_path, resume=True):
        raise AssertionError("must not come here")
