"""Faults of the disk, and how a command must tell them."""

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
"""Modules that give files their final names."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """As on a full disk, no file grows beyond ``size`` bytes; programs that are started inherit it. No bytecode is
    kept: that of a library which is first imported meanwhile would be cut short, and stay so."""
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
    """The last line tells it; those before are of what was being done."""
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("egs-warp: ") and reason in said.splitlines()[-1], said


def fail_once(patch: pytest.MonkeyPatch, number: int, reason: int) -> list[Path]:
    """Of the openings of new files and the renamings in ``RENAMING`` the one with this number fails, which then is in
    the list.
    """
    failed: list[Path] = []
    calls = count()

    def failing(usual: Callable[..., object], path: Path, *given: int) -> object:
        # Locks are opened as well; they are not exclusive.
        if (usual is os.replace or (given and given[0] & os.O_EXCL)) and next(calls) == number:
            failed.append(path)
            raise OSError(reason, os.strerror(reason))
        return usual(path, *given)

    class System:
        """The ``os`` that the module sees."""

        def __getattr__(self, name: str) -> object:
            usual = getattr(os, name)
            return partial(failing, usual) if name in ("open", "replace") else usual

    for module in RENAMING:
        patch.setattr(f"{module}.os", System())
    return failed
