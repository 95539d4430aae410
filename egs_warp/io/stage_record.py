"""Record of the stages that have written files into a folder: their options, inputs and outputs.

For each stage by its name, ``stages.json`` contains ``key``, the SHA-256 of its options and inputs; ``finished``; and
``files``, with the SHA-256 of each file that the stage has written.
"""

from __future__ import annotations

import enum
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.io.atomic import atomic_write
from egs_warp.io.text import parse_json, read_text

NAME = "stages.json"


class StageState(enum.Enum):
    """State of a stage, compared with given options and inputs."""

    MISSING = "missing"
    """The stage has never been started."""
    OTHER = "other"
    """The stage has been started or finished with other options or inputs, or its files have been changed."""
    INTERRUPTED = "interrupted"
    FINISHED = "finished"


class StageRecord:
    """Record of the stages in ``folder``."""

    def __init__(self, folder: Path) -> None:
        """Read the record of ``folder``, if there is one. Raises ``UserError`` if it is damaged."""
        self._folder = folder
        path = folder / NAME
        tree = parse_json(read_text(path), path) if path.is_file() else {}
        if not isinstance(tree, dict) or not all(
            isinstance(one, dict) and isinstance(one.get("files"), dict) for one in tree.values()
        ):
            raise UserError(f"{path}: not a record of stages; choose another folder, or move this file away")
        self._stages: dict[str, Any] = tree

    def state(self, stage: str, key: str) -> StageState:
        """Return the state of ``stage`` for the options and inputs with this ``key``."""
        entry = self._stages.get(stage)
        if entry is None:
            return StageState.MISSING
        if entry.get("key") != key:
            return StageState.OTHER
        if entry.get("finished") is not True:
            return StageState.INTERRUPTED
        files = {self._folder / name: digest for name, digest in entry["files"].items()}
        is_whole = all(path.is_file() and _digest(path) == digest for path, digest in files.items())
        return StageState.FINISHED if is_whole else StageState.OTHER

    def begin(self, stage: str, key: str) -> None:
        """Record that ``stage`` has been started."""
        self._write(stage, {"key": key, "finished": False, "files": {}})

    def finish(self, stage: str, key: str, files: Iterable[Path]) -> None:
        """Record that ``stage`` has written ``files``, which are below the folder."""
        digests = {path.relative_to(self._folder).as_posix(): _digest(path) for path in sorted(files)}
        self._write(stage, {"key": key, "finished": True, "files": digests})

    def _write(self, stage: str, entry: Mapping[str, Any]) -> None:
        self._stages[stage] = entry
        with atomic_write(self._folder / NAME) as temporary:
            temporary.write_text(json.dumps(self._stages, indent=1) + "\n", encoding="utf-8")


def stage_key(options: Mapping[str, Any], inputs: Iterable[Path]) -> str:
    """Return the SHA-256 of ``options``, which are JSON values, and of the contents of ``inputs``.

    An input is a file or a folder. For a folder, the key depends on the names and contents of all files that are not
    hidden.
    """
    whole = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
    for path in inputs:
        for file in [path] if path.is_file() else files_below(path):
            name = file.relative_to(path).as_posix()
            whole.update(f"{name}\0{_digest(file)}\n".encode())
    return whole.hexdigest()


def files_below(folder: Path) -> list[Path]:
    """Return the files below ``folder`` in a fixed order, without hidden files and files in hidden folders."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return sorted(path for path in found if not any(part.startswith(".") for part in path.relative_to(folder).parts))


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
