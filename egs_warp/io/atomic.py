"""Files appear whole or not at all."""

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
    # Windows: nothing is locked, and nothing swept.
    fcntl = None

_TEMPORARY = re.compile(r"\.egs-[0-9a-f]{16}(\..*)?")
_TOLD = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES)
_YOUNGEST = 2.0
"""Seconds: a file that is younger may not have been locked yet."""


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, with its suffix; move it onto ``path`` when the block ends without error.

    Whatever goes wrong inside the block, a file that was at ``path`` before stays as it was and the temporary one is
    removed; one that a killed process leaves is removed by the next ``sweep``. Raises ``UserError`` where the folder is
    missing or the file cannot be written.
    """
    # A link is written through, as with an ordinary open(); os.replace would put a file in the link's place.
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise UserError(f"{path}: its folder does not exist; create {target.parent} first")
    if target.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file")
    temporary = _temporary_name(target.parent, target.suffix)
    descriptor = None
    try:
        # Nobody else's file, and no link that somebody has put there.
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        if not _locked(descriptor):
            os.close(descriptor)
            descriptor = None
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({_reason(error)}); choose another place") from error
    finally:
        temporary.unlink(missing_ok=True)
        if descriptor is not None:
            os.close(descriptor)


def writable_folder(path: Path | str) -> Path:
    """Create folder ``path`` where it is missing and return it, swept. Raises ``UserError`` if files cannot be made."""
    folder = Path(path)
    probe = _temporary_name(folder, "")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise UserError(f"{path}: cannot write into this folder ({_reason(error)}); choose another one") from error
    # A path with a null byte.
    except ValueError as error:
        raise UserError(f"{path}: cannot write into this folder ({error}); choose another one") from error
    sweep(folder)
    return folder


def sweep(folder: Path) -> bool:
    """Remove what ``atomic_write`` of killed processes has left in ``folder``; those of living ones are locked. Returns
    whether there is any that is too young to be told from those.
    """
    young = False
    if fcntl is None:
        return young
    for entry in os.scandir(folder):
        try:
            if not _TEMPORARY.fullmatch(entry.name) or not entry.is_file(follow_symlinks=False):
                continue
            if abs(time.time() - entry.stat(follow_symlinks=False).st_mtime) < _YOUNGEST:
                young = True
                continue
            descriptor = os.open(entry.path, os.O_RDWR)
            try:
                if _locked(descriptor):
                    os.unlink(entry.path)
            finally:
                os.close(descriptor)
        # Another process was faster, or may do what we may not.
        except OSError:
            continue
    return young


def sweep_all(folder: Path) -> None:
    """``sweep``, waiting for what is too young, seconds at most: a program that a killed process had started, such as
    ffmpeg, may have written to the last.
    """
    give_up = time.monotonic() + 2.0 * _YOUNGEST
    while sweep(folder) and time.monotonic() < give_up:
        time.sleep(0.05 * _YOUNGEST)


@contextmanager
def lock(path: Path) -> Iterator[bool]:
    """Whether this process alone holds ``path``, a file made for the purpose, which goes when the block ends."""
    while True:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        if fcntl is not None and not _locked(descriptor):
            os.close(descriptor)
            yield False
            return
        try:
            same = os.path.samestat(os.fstat(descriptor), os.stat(path))
        except FileNotFoundError:
            same = False
        if same:
            break
        # Its last holder has removed it in between.
        os.close(descriptor)
    try:
        yield True
    finally:
        if fcntl is not None:
            path.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(descriptor: int) -> bool:
    """Whether the open file could be locked; the lock goes with the process, however that ends."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _temporary_name(folder: Path, suffix: str) -> Path:
    return folder / f".egs-{uuid.uuid4().hex[:16]}{suffix}"


def system_error(told: str) -> OSError | None:
    """What other programs and libraries tell of the system, such as a full disk, as the error that Python has for it;
    None where they tell of something else.
    """
    number = next((number for number in _TOLD if os.strerror(number) in told), None)
    return None if number is None else OSError(number, os.strerror(number))


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__
