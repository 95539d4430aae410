"""A folder of results belongs to one run: locked while it is written, described by a manifest that comes last.

``manifest.json`` holds ``schema``, ``version``, ``command``, ``finished`` and ``files``: size and SHA-256 of each file
by its name, below a folder of the run too; null for the files and folders of a run that has not finished.
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
from egs_warp.io.atomic import atomic_write, lock, sweep, sweep_all, writable_folder
from egs_warp.io.limits import LARGEST_TEXT, read_bytes
from egs_warp.io.text import parse_json, read_text
from egs_warp.version import __version__

MANIFEST = "manifest.json"
ANIMATE = "animate"
"""The command whose runs ``resume`` goes on with."""
_LOCK = ".egs-run.lock"
_SCHEMA = 1


class RunFolder:
    """What one run writes; made by ``run_folder``."""

    def __init__(
        self, path: Path, *, command: str = ANIMATE, overwrite: bool = False, names: Sequence[str] = ()
    ) -> None:
        """``names``: files of a run that was cut off and goes on."""
        self.path = path
        self.resumed = bool(names)
        self._command = command
        self._overwrite = overwrite
        self._kept: set[str] = set()
        self._names = list(names)
        self._begin: Callable[[], object] | None = None

    def begin_with(self, begin: Callable[[], object]) -> None:
        """Have ``begin`` write its files before the first other one: an interrupted run has them, too. One that goes on
        has them already.
        """
        if not self.resumed:
            self._begin = begin

    def file(self, name: str) -> Path:
        """Where the run's file ``name`` goes. Before the first one, an earlier run is moved aside, if that was allowed.

        Raises ``UserError`` for a file of this name that is no run's, unless files may be overwritten.
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

    def folder(self, name: str) -> Path:
        """Where the run's folder ``name`` goes, all of whose files are results: as ``file``."""
        self._kept.add(name)
        return self.file(name)

    def finish(self) -> None:
        """Describe all files; the manifest says from now on that the run has finished. Folders of ``file``, which a run
        needs only to go on, are gone then; those of ``folder`` stay.
        """
        files = {name: self.path / name for name in self._names}
        for name in self._kept:
            files |= {path.relative_to(self.path).as_posix(): path for path in sorted(files[name].rglob("*"))}
        facts = {name: _facts(path) for name, path in files.items() if path.is_file()}
        self._write_manifest(facts, finished=True)
        for name in self._names:
            if name not in facts and name not in self._kept:
                shutil.rmtree(self.path / name, ignore_errors=True)
        # What the run that was cut off has left was too young when this one began, perhaps.
        sweep_all(self.path)

    def _write_manifest(self, files: dict[str, Any], *, finished: bool) -> None:
        about = {"schema": _SCHEMA, "version": __version__, "command": self._command, "finished": finished}
        content = {**about, "files": files}
        with atomic_write(self.path / MANIFEST) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n")


def back_up(folder: Path, names: Sequence[str]) -> None:
    """Into the first free of ``earlier-1``, ``earlier-2``, ... below ``folder`` go the files ``names`` that are there.

    Raises ``UserError`` where that cannot be done.
    """
    there = [name for name in names if (folder / name).exists()]
    if not there:
        return
    number = 1
    while (folder / f"earlier-{number}").exists():
        number += 1
    aside = folder / f"earlier-{number}"
    try:
        aside.mkdir()
        # The manifest goes last: until then it names what is still to be moved.
        for name in there:
            os.replace(folder / name, aside / name)
    except OSError as error:
        raise UserError(f"{folder}: the earlier run cannot be moved aside ({error.strerror})") from error


@contextmanager
def run_folder(
    out: Path | str | RunFolder, *, command: str = ANIMATE, overwrite: bool = False, resume: bool = False
) -> Iterator[RunFolder]:
    """The folder ``out``, made where it is missing and locked, for one run of ``command``; a ``RunFolder`` is handed on
    as it is.

    Raises ``UserError`` where another run is writing, or where an earlier run lies and may not be moved aside
    (``overwrite``); of a run that goes on (``resume``), where there is none, or none that was cut off.
    """
    if isinstance(out, RunFolder):
        yield out
        return
    _check(out, overwrite=overwrite, resume=resume)
    folder = writable_folder(out)
    with lock(folder / _LOCK) as free:
        if not free:
            raise UserError(f"{out}: another run is writing into this folder; wait for it, or choose another folder")
        # What came between the check and the lock.
        _check(out, overwrite=overwrite, resume=resume)
        sweep(folder)
        yield RunFolder(folder, command=command, overwrite=overwrite, names=_known(folder)[:-1] if resume else ())


def clean_up(out: Path | str, scratch: str) -> None:
    """Remove what a run that was killed as it ended has left in the folder ``out`` beside its files: its folder
    ``scratch``, its lock, half-written files. Of one that still runs it removes nothing.
    """
    folder = Path(out)
    try:
        with lock(folder / _LOCK) as free:
            if free:
                shutil.rmtree(folder / scratch, ignore_errors=True)
                sweep(folder)
    # Where one may not write nothing is removed.
    except OSError:
        pass


def _check(out: Path | str, *, overwrite: bool, resume: bool) -> None:
    if not resume:
        check_run_folder(out, overwrite=overwrite)
    elif has_finished(out):
        raise UserError(f"{out}: this run has finished; there is nothing to go on with")


def has_finished(out: Path | str) -> bool:
    """Whether the run in the folder ``out`` has written all of its files. Raises ``UserError`` where there is none that
    could go on, or one of another version.
    """
    check_out(out)
    path = Path(out) / MANIFEST
    if not path.is_file() or _is_unfinished(Path(out)):
        raise UserError(f"{out}: no run has begun to write here; begin it")
    manifest = parse_json(read_text(path), path)
    if not isinstance(manifest, dict) or not _names_in(manifest):
        raise UserError(f"{path}: is no manifest of a run; begin the run again")
    command = manifest.get("command", ANIMATE)
    if command != ANIMATE:
        raise UserError(f"{out}: egs-warp {command} wrote here, which cannot go on; begin it again")
    if manifest.get("finished") is True:
        return True
    if manifest.get("version") != __version__:
        raise UserError(
            f"{path}: the run was begun by egs-warp {manifest.get('version')}, this is {__version__}, whose steps are"
            " others; begin the run again"
        )
    return False


def check_run_folder(out: Path | str, *, overwrite: bool = False, writes: Sequence[str] = ()) -> None:
    """Raise the ``UserError`` of ``run_folder``, and of the files that the run ``writes``, as far as it can be known,
    and make nothing: before any long work.
    """
    check_out(out)
    if overwrite:
        return
    if (Path(out) / MANIFEST).is_file() and not _is_unfinished(Path(out)):
        raise _occupied(out, "it has an earlier run")
    for name in writes:
        if (Path(out) / name).exists():
            raise _occupied(out, f"it has {name}")


def check_no_file_of_a_run(path: Path | str) -> None:
    """Raise ``UserError`` where ``path`` is a file that a run has written: its checksum would be another's."""
    path = Path(path)
    if path.exists() and (path.parent / MANIFEST).is_file() and path.name in _known(path.parent):
        raise UserError(f"{path}: is a file of the run in {path.parent}; choose another name")


def check_out(out: Path | str) -> None:
    """Raise ``UserError`` for a folder that cannot be made or written, and make nothing."""
    if not str(out).strip():
        raise ArgumentError("out", "give the name of a folder", value=repr(str(out)))
    folder = Path(out)
    there = next(parent for parent in (folder, *folder.absolute().parents) if _exists(parent))
    if not there.is_dir():
        raise UserError(f"{out}: cannot write into this folder ({there} is a file); choose another one")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UserError(f"{out}: cannot write into this folder (Permission denied); choose another one")


def _exists(path: Path) -> bool:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    # Names too long, or with null bytes.
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise UserError(f"{path}: cannot be made ({reason}); choose another place") from error
    return True


def _occupied(out: Path | str, what: str) -> UserError:
    problem = f"{what}, which would be mixed with this one; choose another folder, or have it moved aside"
    return ArgumentError("out", problem, value=out, check=("overwrite",))


def _known(folder: Path) -> list[str]:
    """Files of the earlier run in ``folder`` by its manifest, which comes last."""
    if not (folder / MANIFEST).is_file() or _is_unfinished(folder):
        return []
    return [*_names_in(_manifest(folder)), MANIFEST]


def _is_unfinished(folder: Path) -> bool:
    """Whether the manifest in ``folder`` is of a run that was killed between it and its first file: of no run."""
    manifest = _manifest(folder)
    names = _names_in(manifest)
    begun = isinstance(manifest, dict) and manifest.get("finished") is False
    return begun and bool(names) and not any((folder / name).exists() for name in names)


def _manifest(folder: Path) -> Any:
    """None of one that is damaged."""
    try:
        return json.loads(read_bytes(folder / MANIFEST, at_most=LARGEST_TEXT))
    except (ValueError, RecursionError):
        return None


def _names_in(manifest: Any) -> list[str]:
    """Files and folders that a manifest tells of; not those of other folders."""
    files = manifest.get("files") if isinstance(manifest, dict) else None
    names = files if isinstance(files, dict) else {}
    first = dict.fromkeys(part for name in names for part in PurePosixPath(name).parts[:1])
    return [name for name in first if Path(name).name == name and name not in ("..", MANIFEST)]


def _facts(path: Path) -> dict[str, Any]:
    with open(path, "rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
