"""A second process that requests a file while the first one writes it."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError


def error_of_second_process(enter: Callable[[Path], AbstractContextManager[Any]], path: Path) -> str | None:
    """Enter the context ``enter(path)`` in another process; return its error, or None if it succeeds."""
    context = multiprocessing.get_context("spawn")
    answers = context.Queue()
    other = context.Process(target=_try, args=(enter, path, answers))
    other.start()
    other.join(60)
    return answers.get(timeout=5)


def _try(enter: Callable[[Path], AbstractContextManager[Any]], path: Path, answers: multiprocessing.Queue) -> None:
    try:
        with enter(path):
            answers.put(None)
    except UserError as error:
        answers.put(str(error))
