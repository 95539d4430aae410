"""Disk faults, and the error messages that commands must print for them."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path

import pytest

RENAMING = ("egs_warp.io.atomic", "egs_warp.pipelines.pose_photos")
"""Modules that rename finished files to their final names."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Limit files to ``size`` bytes, as on a full disk. Programs that are started inherit the limit.

    Python writes no bytecode within the block, because a library that is imported for the first time would leave a
    truncated file behind.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        patch.setenv("PYTHONDONTWRITEBYTECODE", "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_one_line(said: str, reason: str) -> None:
    """Assert that the last line is the error message with the ``reason``; earlier lines may show progress."""
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("egs-warp: ") and reason in said.splitlines()[-1], said


def fail_once(patch: pytest.MonkeyPatch, number: int, reason: int) -> list[Path]:
    """Make one call that opens a new file, or that renames a file in a module of ``RENAMING``, fail with ``reason``.
    ``number`` is its number among these calls, counted from 0; ``reason`` is an errno.

    Returns:
        A list that receives the path of the failed call.
    """
    failed: list[Path] = []
    calls = count()

    def failing(function: Callable[..., object], path: Path, *arguments: int) -> object:
        # New files are opened with O_EXCL, but lock files are not.
        if (function is os.replace or (arguments and arguments[0] & os.O_EXCL)) and next(calls) == number:
            failed.append(path)
            raise OSError(reason, os.strerror(reason))
        return function(path, *arguments)

    class System:
        """Replacement for ``os`` in a module."""

        def __getattr__(self, name: str) -> object:
            function = getattr(os, name)
            return partial(failing, function) if name in ("open", "replace") else function

    for module in RENAMING:
        patch.setattr(f"{module}.os", System())
    return failed
