"""Folder with the results of one run: it is locked during the run, and its manifest is completed last.

``manifest.json`` contains ``schema``, ``version``, ``command``, ``finished`` and ``files``. ``files`` maps the name of
each file, including files in folders of the run, to its size and SHA-256. In an unfinished run, it maps the names of
files and folders to null.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.atomic import atomic_write, lock, result_folder, sweep, sweep_all
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.text import load_json, parse_json, read_text
from egs_warp.version import __version__

MANIFEST = "manifest.json"
CONFIG = "run.yaml"
"""Name of the file with the flags of a run, with which the command can be resumed."""
ANIMATE, ANIMATE_WORLD = "animate", "animate world"
"""Names, in the manifest, of the commands whose runs can be resumed: ``animate`` for a single capture, and for a
world."""
RESUMABLE = (ANIMATE, ANIMATE_WORLD)
_LOCK = ".egs-run.lock"
_SCHEMA = 1
_FILE_ENDINGS = (".mp4", ".mov", ".webm", ".png", ".ply", ".spz", ".splat", ".sog", ".glb", ".json", ".npz", ".yaml")
"""Endings of file names; the name of a run folder must not end with one of them."""


class RunFolder:
    """Output folder of one run, created by ``run_folder``."""

    def __init__(
        self, path: Path, *, command: str = ANIMATE, overwrite: bool = False, names: Sequence[str] = ()
    ) -> None:
        """Open the folder. ``names`` are the files of an interrupted run that is resumed."""
        self.path = path
        self.resumed = bool(names)
        self._command = command
        self._overwrite = overwrite
        self._result_folders: set[str] = set()
        self._names = list(names)
        self._begin: Callable[[], object] | None = None

    def begin_with(self, begin: Callable[[], object]) -> None:
        """Call ``begin``, which writes files, before any other file is written, so that every interrupted run contains
        these files. A resumed run contains them already and does not call ``begin``."""
        if not self.resumed:
            self._begin = begin

    def file(self, name: str) -> Path:
        """Return the path of the file ``name`` of the run. The first call backs up an earlier run, if that is allowed.

        Raises ``UserError`` for an existing file of this name that belongs to no run, unless files may be overwritten.
        """
        begin, self._begin = self._begin, None
        if begin is not None:
            begin()
        if not self._names:
            back_up(self.path, _known(self.path))
        if name not in self._names:
            self._names.append(name)
            if (self.path / name).exists():
                if not self._overwrite:
                    raise _occupied(self.path, f"it has {name}")
                back_up(self.path, [name])
            self._write_manifest(dict.fromkeys(self._names), finished=False)
        return self.path / name

    def has(self, name: str) -> bool:
        """Return True if the run has written the file ``name``."""
        return name in self._names and (self.path / name).is_file()

    def folder(self, name: str) -> Path:
        """Return the path of the folder ``name`` of the run, like ``file``. All files in it are results."""
        self._result_folders.add(name)
        return self.file(name)

    def finish(self) -> None:
        """Write the final manifest, which describes all files and marks the run as finished. Folders with paths from
        ``file``, which are needed only for resuming, are removed; folders with paths from ``folder`` are kept."""
        files = {name: self.path / name for name in self._names}
        for name in self._result_folders:
            files |= {path.relative_to(self.path).as_posix(): path for path in sorted(files[name].rglob("*"))}
        facts = {name: _facts(path) for name, path in files.items() if path.is_file()}
        self._write_manifest(facts, finished=True)
        for name in self._names:
            if name not in facts and name not in self._result_folders:
                shutil.rmtree(self.path / name, ignore_errors=True)
        # Remove leftovers of an interrupted run again: they may have been too young when this run started.
        sweep_all(self.path)

    def _write_manifest(self, files: dict[str, Any], *, finished: bool) -> None:
        about = {"schema": _SCHEMA, "version": __version__, "command": self._command, "finished": finished}
        content = {**about, "files": files}
        with atomic_write(self.path / MANIFEST) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n")


def back_up(folder: Path, names: Sequence[str]) -> None:
    """Move the existing files ``names`` into the first unused subfolder ``earlier-1``, ``earlier-2``, ... of
    ``folder``.

    Raises ``UserError`` if that fails.
    """
    existing = [name for name in names if (folder / name).exists()]
    if not existing:
        return
    number = 1
    while (folder / f"earlier-{number}").exists():
        number += 1
    backup = folder / f"earlier-{number}"
    try:
        backup.mkdir()
        # Move the manifest last, because it lists the files that have not been moved yet.
        for name in existing:
            os.replace(folder / name, backup / name)
    except OSError as error:
        raise UserError(
            f"{folder}: the earlier run cannot be moved aside ({error.strerror}); choose another folder"
        ) from error


@contextmanager
def run_folder(
    out: Path | str | RunFolder, *, command: str = ANIMATE, overwrite: bool = False, resume: bool = False
) -> Iterator[RunFolder]:
    """Create and lock the folder ``out`` for one run of ``command``; a ``RunFolder`` is yielded unchanged.

    Raises ``UserError`` if another run is writing, if an earlier run exists and may not be backed up (``overwrite``),
    or if there is no interrupted run to ``resume``.
    """
    if isinstance(out, RunFolder):
        yield out
        return
    _check(out, overwrite=overwrite, resume=resume)
    with result_folder(out) as folder, lock(folder / _LOCK) as acquired:
        if not acquired:
            raise UserError(f"{out}: another run is writing into this folder; wait for it, or choose another folder")
        # Check again: files may have been created between the first check and the lock.
        _check(out, overwrite=overwrite, resume=resume)
        sweep(folder)
        yield RunFolder(folder, command=command, overwrite=overwrite, names=_known(folder)[:-1] if resume else ())


def clean_up(out: Path | str, scratch: str) -> None:
    """Remove the leftovers in the folder ``out`` of a run that was killed at its end: the folder ``scratch``, the lock
    and unfinished files. Nothing is removed while a run is active."""
    folder = Path(out)
    try:
        with lock(folder / _LOCK) as acquired:
            if acquired:
                shutil.rmtree(folder / scratch, ignore_errors=True)
                sweep(folder)
    # Leftovers remain if the process has no permission to remove them.
    except OSError:
        pass


def _check(out: Path | str, *, overwrite: bool, resume: bool) -> None:
    if not resume:
        check_run_folder(out, overwrite=overwrite)
    elif has_finished(out):
        raise UserError(f"{out}: this run has finished; there is nothing to resume")


def is_interrupted(folder: Path) -> bool:
    """Return True if a run of ``animate`` in ``folder`` has started to write files but has not finished."""
    manifest = _manifest(folder) if (folder / MANIFEST).is_file() else None
    if not isinstance(manifest, dict) or manifest.get("finished") is not False or _is_unfinished(folder):
        return False
    return manifest.get("command", ANIMATE) in RESUMABLE


def check_finished(folder: Path) -> None:
    """Raise ``UserError`` if ``folder`` is not a folder, or contains a run that has not finished."""
    if not folder.is_dir():
        problem = "a file; a finished run is a folder" if folder.is_file() else "no such folder"
        raise UserError(f"{folder}: {problem}; give the one that egs-warp animate wrote")
    if is_interrupted(folder):
        cure = f"egs-warp resume {folder} continues it" if (folder / CONFIG).is_file() else "start it again"
        raise UserError(f"{folder}: the run has not finished; if it was interrupted, {cure}")


def has_finished(out: Path | str) -> bool:
    """Return True if the run in the folder ``out`` has finished. Raises ``UserError`` if there is no run that can be
    resumed, or if it belongs to another version."""
    check_out(out)
    path = Path(out) / MANIFEST
    if not path.is_file() or _is_unfinished(Path(out)):
        raise UserError(f"{out}: no run has written here; start one without resuming")
    manifest = parse_json(read_text(path), path)
    if not isinstance(manifest, dict) or not _names_in(manifest):
        raise UserError(f"{path}: not a manifest of a run; start the run again")
    command = manifest.get("command", ANIMATE)
    if command not in RESUMABLE:
        raise UserError(
            f"{out}: it has an output of egs-warp {command}, which cannot be resumed; run that command again"
        )
    if manifest.get("finished") is True:
        return True
    if manifest.get("version") != __version__:
        raise UserError(
            f"{path}: the run was started by egs-warp {manifest.get('version')}, but this is version"
            f" {__version__}, whose steps may differ; start the run again"
        )
    return False


def check_run_folder(out: Path | str, *, overwrite: bool = False, writes: Sequence[str] = ()) -> None:
    """Raise the predictable errors of ``run_folder``, and of its method ``file`` for the files that the run ``writes``,
    before any long computation and without creating anything."""
    check_out(out)
    if Path(out).suffix.lower() in _FILE_ENDINGS and not Path(out).is_dir():
        problem = f"the results are a folder of files; give a name without {Path(out).suffix}"
        raise ArgumentError("out", problem, value=out)
    if overwrite:
        return
    if (Path(out) / MANIFEST).is_file() and not _is_unfinished(Path(out)):
        raise _occupied(out, "it has an earlier run")
    for name in writes:
        if (Path(out) / name).exists():
            raise _occupied(out, f"it has {name}")


def check_no_file_of_a_run(path: Path | str) -> None:
    """Raise ``UserError`` if ``path`` is a file of a run, whose checksum would become invalid."""
    path = Path(path)
    if path.exists() and (path.parent / MANIFEST).is_file() and path.name in _known(path.parent):
        raise UserError(f"{path}: is a file of the run in {path.parent}; choose another name")


def check_out(out: Path | str) -> None:
    """Raise ``UserError`` for a folder that cannot be created or written, without creating anything."""
    if not str(out).strip():
        raise ArgumentError("out", "give the name of a folder", value=repr(str(out)))
    folder = Path(out)
    existing = next(parent for parent in (folder, *folder.absolute().parents) if _exists(parent))
    if not existing.is_dir():
        raise UserError(f"{out}: cannot write into this folder ({existing} is a file); choose another one")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise UserError(f"{out}: cannot write into this folder (Permission denied); choose another one")


def _exists(path: Path) -> bool:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    # Raised for names that are too long or contain null bytes.
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise UserError(f"{path}: cannot be created ({reason}); choose another path") from error
    return True


def _occupied(out: Path | str, what: str) -> UserError:
    problem = f"{what}, which would be mixed with this one; choose another folder, or move it aside"
    return ArgumentError("out", problem, value=out, using="overwrite")


def _known(folder: Path) -> list[str]:
    """Return the files of the earlier run in ``folder`` according to its manifest, followed by the manifest itself."""
    if not (folder / MANIFEST).is_file() or _is_unfinished(folder):
        return []
    return [*_names_in(_manifest(folder)), MANIFEST]


def _is_unfinished(folder: Path) -> bool:
    """Return True if the run in ``folder`` was killed after it wrote its manifest and before it wrote any other file.
    Callers ignore such a run."""
    manifest = _manifest(folder)
    names = _names_in(manifest)
    unfinished = isinstance(manifest, dict) and manifest.get("finished") is False
    return unfinished and bool(names) and not any((folder / name).exists() for name in names)


def _manifest(folder: Path) -> Any:
    """Return the manifest; None if it is damaged."""
    try:
        return load_json(read_bytes(folder / MANIFEST, at_most=MAX_TEXT_BYTES))
    except ValueError:
        return None


def _names_in(manifest: Any) -> list[str]:
    """Return the files and folders that a manifest lists, without paths outside the folder of the run."""
    files = manifest.get("files") if isinstance(manifest, dict) else None
    names = files if isinstance(files, dict) else {}
    first = dict.fromkeys(part for name in names for part in PurePosixPath(name).parts[:1])
    return [name for name in first if Path(name).name == name and name not in ("..", MANIFEST)]


def _facts(path: Path) -> dict[str, Any]:
    with open(path, "rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
