"""Paths in untrusted files, which must not leave the folder of the data set."""

from __future__ import annotations

import os
from pathlib import Path, PurePath


def stays_inside(name: str) -> bool:
    """Return True if ``name`` is a relative path that does not leave its folder."""
    path = PurePath(name)
    return "\0" not in name and not path.is_absolute() and not path.drive and ".." not in path.parts


def path_inside(path: Path, folder: Path) -> Path | None:
    """Return ``path``, with ``..`` resolved, relative to ``folder``; None if it is not inside the folder."""
    resolved, base = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    return resolved.relative_to(base) if resolved.is_relative_to(base) else None
