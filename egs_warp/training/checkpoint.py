"""Training that was cut off goes on: all that lasts from one step to the next, in one file, now and then.

The file is an ``.npz`` without pickled objects: arrays by name, all else as JSON under ``facts``. Python writes a float
as the shortest text that reads back to the same bits.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.io.arrays import READ_ERRORS, read_npz
from egs_warp.io.atomic import atomic_write
from egs_warp.version import __version__

SECONDS = 30.0
"""Between two of them, at least."""
_SHARE = 0.05
"""Of the time that may go into writing them."""

State = dict[str, Any]
"""Arrays, and what JSON can tell."""


class Checkpoint:
    """The file of one training."""

    def __init__(self, path: Path, *, resume: bool = False) -> None:
        """With ``resume`` the training goes on from what ``path`` holds; else that is written over."""
        self.path = path
        self._resume = resume
        self._digest = ""
        self._last, self._pause = time.monotonic(), SECONDS

    def begin(self, digest: str) -> State | None:
        """What a training of this ``digest`` goes on from; None where it begins.

        Raises ``UserError`` where the file cannot be read, or is of a training of other input.
        """
        self._digest = digest
        if not self._resume:
            return None
        if not self.path.is_file():
            raise UserError(f"{self.path}: no training was cut off here; begin it")
        try:
            state: State = dict(read_npz(self.path))
            facts = json.loads(str(state.pop("facts")))
            if sorted(state) != facts["arrays"]:
                raise ValueError("other arrays than were written")
            state |= facts["state"]
        except (*READ_ERRORS, RecursionError) as error:
            raise UserError(f"{self.path}: is damaged; begin the training again") from error
        if facts.get("digest") != digest:
            raise UserError(
                f"{self.path}: is of other photos, other flags or another version of egs-warp; begin the training again"
            )
        return state

    def due(self) -> bool:
        """Whether it is time to write it again."""
        return time.monotonic() - self._last >= self._pause

    def write(self, state: State) -> None:
        """Keep ``state`` in place of what the file held."""
        began = time.monotonic()
        arrays = {name: value for name, value in state.items() if isinstance(value, np.ndarray)}
        others = {name: value for name, value in state.items() if name not in arrays}
        facts = json.dumps({"digest": self._digest, "arrays": sorted(arrays), "state": others})
        with atomic_write(self.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, facts=np.array(facts), **arrays)  # pyright: ignore[reportArgumentType]
        self._last = time.monotonic()
        self._pause = max(SECONDS, (self._last - began) / _SHARE)


def digest_of(arrays: Iterable[np.ndarray | None], cameras: Iterable[Camera], options: object) -> str:
    """What tells a training from another: its pictures and first cloud, its ``cameras``, its ``options``."""
    content = hashlib.sha256(f"{__version__} {options!r}".encode())
    for camera in cameras:
        for one in fields(camera):
            content.update(np.asarray(getattr(camera, one.name), np.float64).tobytes())
    for array in arrays:
        content.update(b"none" if array is None else f"{array.dtype}{array.shape}".encode())
        content.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return content.hexdigest()
