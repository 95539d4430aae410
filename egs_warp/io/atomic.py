"""Files appear whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from egs_warp.errors import UserError


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, with its suffix; move it onto ``path`` when the block ends without error.

    Whatever goes wrong inside the block, a file that was at ``path`` before stays as it was and the temporary one is
    removed. Raises ``UserError`` where the folder is missing or the file cannot be written.
    """
    # A link is written through, as with an ordinary open(); os.replace would put a file in the link's place.
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise UserError(f"{path}: its folder does not exist; create {target.parent} first")
    if target.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file")
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({_reason(error)}); choose another place") from error
    finally:
        temporary.unlink(missing_ok=True)


def writable_folder(path: Path | str) -> Path:
    """Create folder ``path`` where it is missing and return it. Raises ``UserError`` if files cannot be made in it."""
    folder = Path(path)
    probe = folder / f".{uuid.uuid4().hex[:12]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise UserError(f"{path}: cannot write into this folder ({_reason(error)}); choose another one") from error
    return folder


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__
