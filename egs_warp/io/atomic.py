"""Atomic writing of files, and file locks."""

from __future__ import annotations

import errno
import os
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from egs_warp.errors import UserError

try:
    import fcntl
except ImportError:
    # fcntl is missing on Windows: nothing is locked, and leftover files are not removed.
    fcntl = None

_TEMPORARY = re.compile(r"\.egs-[0-9a-f]{16}(\..*)?")
_SYSTEM_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES)
_MIN_AGE = 2.0
"""Minimum age of a leftover file, s. A younger file may not have been locked yet."""


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, with its suffix; move the file to ``path`` when the block ends without
    error.

    If the block fails, an existing file at ``path`` stays unchanged and the temporary file is removed. The temporary
    file of a killed process is removed by the next ``sweep``. Raises ``UserError`` if the folder is missing or the file
    cannot be written.
    """
    # Follow links, as open() does; os.replace would replace the link itself.
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise UserError(f"{path}: its folder does not exist; create {target.parent} first")
    if target.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file")
    temporary = _temporary_name(target.parent, target.suffix)
    descriptor = None
    try:
        # O_EXCL fails for an existing file and for a link that another process has placed.
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        if not _try_lock(descriptor):
            os.close(descriptor)
            descriptor = None
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({_reason(error)}); choose another path") from error
    finally:
        temporary.unlink(missing_ok=True)
        if descriptor is not None:
            os.close(descriptor)


def writable_folder(path: Path | str) -> Path:
    """Create folder ``path`` if it is missing, remove leftovers in it, and return it. Raises ``UserError`` if it is not
    writable."""
    folder = Path(path)
    probe = _temporary_name(folder, "")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise UserError(f"{path}: cannot write into this folder ({_reason(error)}); choose another one") from error
    # This error is raised if the path contains a null byte.
    except ValueError as error:
        raise UserError(f"{path}: cannot write into this folder ({error}); choose another one") from error
    sweep(folder)
    return folder


@contextmanager
def result_folder(path: Path | str) -> Iterator[Path]:
    """Create folder ``path``, like ``writable_folder``; if the block fails while the folder is empty, remove the
    folders that were created."""
    folder = Path(path)
    created = []
    try:
        created = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    # writable_folder reports the cause of a failure, such as a name that is too long.
    except (OSError, ValueError):
        pass
    try:
        yield writable_folder(folder)
    except BaseException:
        for empty in created:
            try:
                empty.rmdir()
            except OSError:
                break
        raise


def sweep(folder: Path) -> bool:
    """Remove files that ``atomic_write`` of killed processes left in ``folder``; files of running processes are locked
    and remain.

    Returns True if some files are so young that a running process may be about to lock them.
    """
    young = False
    if fcntl is None:
        return young
    for entry in os.scandir(folder):
        try:
            if not _TEMPORARY.fullmatch(entry.name) or not entry.is_file(follow_symlinks=False):
                continue
            if abs(time.time() - entry.stat(follow_symlinks=False).st_mtime) < _MIN_AGE:
                young = True
                continue
            descriptor = os.open(entry.path, os.O_RDWR)
            try:
                if _try_lock(descriptor):
                    os.unlink(entry.path)
            finally:
                os.close(descriptor)
        # Another process has removed the file, or the file belongs to another user.
        except OSError:
            continue
    return young


def sweep_all(folder: Path) -> None:
    """Call ``sweep`` until no file is too young to be removed, for a few seconds at most. A program that a killed
    process had started, such as ffmpeg, may have continued to write for a short time."""
    deadline = time.monotonic() + 2.0 * _MIN_AGE
    while sweep(folder) and time.monotonic() < deadline:
        time.sleep(0.05 * _MIN_AGE)


@contextmanager
def lock(path: Path) -> Iterator[bool]:
    """Lock the file ``path`` for the duration of the block, and remove it afterwards. Yield True if this process has
    the lock, and False if another process has it."""
    while True:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        if fcntl is not None and not _try_lock(descriptor):
            os.close(descriptor)
            yield False
            return
        try:
            same = os.path.samestat(os.fstat(descriptor), os.stat(path))
        except FileNotFoundError:
            same = False
        if same:
            break
        # The previous holder of the lock has removed the file in the meantime.
        os.close(descriptor)
    try:
        yield True
    finally:
        if fcntl is not None:
            path.unlink(missing_ok=True)
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    """Return True if the open file could be locked. The lock ends with the process."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _temporary_name(folder: Path, suffix: str) -> Path:
    return folder / f".egs-{uuid.uuid4().hex[:16]}{suffix}"


def system_error(message: str) -> OSError | None:
    """Return the error of the operating system, such as a full disk, that is named in the ``message`` of a program or
    library; None if the message names none."""
    number = next((number for number in _SYSTEM_ERRORS if os.strerror(number) in message), None)
    return None if number is None else OSError(number, os.strerror(number))


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__
