"""Checkpoints of a training run: its complete state in one file, written periodically.

The file is an ``.npz`` without pickled objects: arrays by name, and all other values as JSON under ``facts``. JSON
preserves floats exactly, because Python writes a float as the shortest text that reads back to the same bits.
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
from egs_warp.io.text import load_json
from egs_warp.version import __version__

SECONDS = 30.0
"""Minimum time between two consecutive checkpoints, s."""
_SHARE = 0.05
"""Maximum fraction of the training time that is spent on writing checkpoints."""

State = dict[str, Any]
"""Arrays, and values that JSON can represent."""


class Checkpoint:
    """Checkpoint file of one training run."""

    def __init__(self, path: Path, *, resume: bool = False) -> None:
        """Create the checkpoint at ``path``. With ``resume``, the training continues from the file; otherwise the file
        is overwritten."""
        self.path = path
        self._resume = resume
        self._digest = ""
        self._last, self._pause = time.monotonic(), SECONDS

    def begin(self, digest: str) -> State | None:
        """Return the state from which the training run with this ``digest`` continues; None for a new run.

        Raises ``UserError`` if the file cannot be read or belongs to a training run with other input.
        """
        self._digest = digest
        if not self._resume:
            return None
        if not self.path.is_file():
            raise UserError(f"{self.path}: there is no checkpoint of an interrupted training; start without resuming")
        try:
            state: State = dict(read_npz(self.path))
            facts = load_json(str(state.pop("facts")))
            if sorted(state) != facts["arrays"]:
                raise ValueError(f"the arrays are {', '.join(sorted(state))}, expected {', '.join(facts['arrays'])}")
            state |= facts["state"]
        except READ_ERRORS as error:
            raise UserError(f"{self.path}: the checkpoint is damaged; start the training again") from error
        if facts.get("digest") != digest:
            raise UserError(
                f"{self.path}: it belongs to other photos, other settings or another version of egs-warp;"
                " start the training again"
            )
        return state

    def due(self) -> bool:
        """Return True if enough time has passed since the last checkpoint to write the next one."""
        return time.monotonic() - self._last >= self._pause

    def write(self, state: State) -> None:
        """Replace the content of the file with ``state``."""
        start = time.monotonic()
        arrays = {name: value for name, value in state.items() if isinstance(value, np.ndarray)}
        others = {name: value for name, value in state.items() if name not in arrays}
        facts = json.dumps({"digest": self._digest, "arrays": sorted(arrays), "state": others})
        with atomic_write(self.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, facts=np.array(facts), **arrays)  # pyright: ignore[reportArgumentType]
        self._last = time.monotonic()
        self._pause = max(SECONDS, (self._last - start) / _SHARE)


def digest_of(arrays: Iterable[np.ndarray | None], cameras: Iterable[Camera], options: object) -> str:
    """Return a digest of the input of a training run: the ``arrays`` of its pictures and of its initial cloud, its
    ``cameras``, and its ``options``."""
    content = hashlib.sha256(f"{__version__} {options!r}".encode())
    for camera in cameras:
        for one in fields(camera):
            content.update(np.asarray(getattr(camera, one.name), np.float64).tobytes())
    for array in arrays:
        content.update(b"none" if array is None else f"{array.dtype}{array.shape}".encode())
        content.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return content.hexdigest()
