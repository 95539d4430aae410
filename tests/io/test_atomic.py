"""Atomic writing: files appear complete or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from egs_warp.errors import UserError
from egs_warp.io import atomic_write, writable_folder


def test_a_finished_file_replaces_the_old_one(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".json"
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["a.json"]
    # Other users can read the file like any new file; files of mkstemp are readable only by their owner.
    (tmp_path / "plain").write_text("")
    assert target.stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_unfinished_file_leaves_the_old_one(error: type[BaseException], tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(error), atomic_write(target) as temporary:
        temporary.write_text("ne")
        raise error
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(UserError) as caught, atomic_write(target) as temporary:
        temporary.write_text("ne")
        raise OSError(28, "No space left on device")
    assert str(caught.value) == f"{target}: cannot be written (No space left on device); choose another path"
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link.ply").symlink_to(tmp_path / "real" / "a.ply")
    with atomic_write(tmp_path / "link.ply") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "real" / "a.ply").read_text() == "new"
    assert (tmp_path / "link.ply").is_symlink()


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path, message in (
        (tmp_path / "missing" / "a", f"its folder does not exist; create {tmp_path / 'missing'} first"),
        (tmp_path, "is a folder; give the name of a file"),
    ):
        with pytest.raises(UserError) as caught, atomic_write(path):
            raise AssertionError("must not come here")
        assert str(caught.value) == f"{path}: {message}"
    for path, reason in ((tmp_path / "file", "File exists"), (tmp_path / "file" / "a", "Not a directory")):
        with pytest.raises(UserError) as caught:
            writable_folder(path)
        assert str(caught.value) == f"{path}: cannot write into this folder ({reason}); choose another one"


def test_a_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The refusal by the operating system is simulated, because root may write anywhere."""

    def refused(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "touch", refused)
    with pytest.raises(UserError, match=r"cannot write into this folder \(Permission denied\)"):
        writable_folder(tmp_path)


def test_a_writable_folder_is_created_empty(tmp_path: Path) -> None:
    assert writable_folder(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert writable_folder(tmp_path / "a" / "b").is_dir()
    assert os.listdir(tmp_path / "a" / "b") == []


def old(path: Path) -> Path:
    path.write_text("half")
    os.utime(path, (1.0, 1.0))
    return path


def test_remnants_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    """Only temporary files with names of this package are removed, but none that a running process is writing."""
    left = old(tmp_path / ".egs-0123456789abcdef.ply")
    other, young = old(tmp_path / ".egs-notes"), tmp_path / ".egs-0123456789abcdee.ply"
    young.write_text("just begun")
    with atomic_write(tmp_path / "a.json") as living:
        os.utime(living, (1.0, 1.0))
        writable_folder(tmp_path)
        assert living.exists() and young.exists() and other.exists() and not left.exists()
        living.write_text("{}")
    assert (tmp_path / "a.json").read_text() == "{}"


def test_a_temporary_file_is_opened_exclusively(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link that another process has created under the temporary name is not followed."""
    (tmp_path / "victim").write_text("precious")
    (tmp_path / ".egs-guessed.json").symlink_to(tmp_path / "victim")
    monkeypatch.setattr("egs_warp.io.atomic._temporary_name", lambda folder, suffix: folder / f".egs-guessed{suffix}")
    with (
        pytest.raises(UserError, match=r"a\.json: cannot be written \(File exists\)"),
        atomic_write(tmp_path / "a.json"),
    ):
        raise AssertionError("must not come here")
    assert (tmp_path / "victim").read_text() == "precious"
