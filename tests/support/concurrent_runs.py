"""What a second process is told that asks for what the first one writes to."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError


def told_elsewhere(enter: Callable[[Path], AbstractContextManager[Any]], path: Path) -> str | None:
    """Its error when another process enters ``path``; None if it can."""
    context = multiprocessing.get_context("spawn")
    said = context.Queue()
    other = context.Process(target=_try, args=(enter, path, said))
    other.start()
    other.join(60)
    return said.get(timeout=5)


def _try(enter: Callable[[Path], AbstractContextManager[Any]], path: Path, said: multiprocessing.Queue) -> None:
    try:
        with enter(path):
            said.put(None)
    except UserError as error:
        said.put(str(error))
