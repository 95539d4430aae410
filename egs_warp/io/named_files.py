"""Output files of a run that have individual names: they are locked during the run, and earlier files of these names
are backed up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.atomic import lock, result_folder, sweep_all
from egs_warp.io.run_folder import back_up, check_out


class NamedFiles:
    """Output files of one run, created by ``named_files``."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def begin(self) -> None:
        """Back up existing files. Call this immediately before the files are written."""
        for folder in dict.fromkeys(path.parent for path in self._paths):
            back_up(folder, [path.name for path in self._paths if path.parent == folder])


@contextmanager
def named_files(*paths: Path, overwrite: bool = False) -> Iterator[NamedFiles]:
    """Lock the files ``paths`` for one run; the user has chosen the name of the first one. Create missing folders.

    Raises ``UserError`` if another run is writing the first file, or if a file exists and may not be backed up
    (``overwrite``).
    """
    check_named_files(*paths, overwrite=overwrite)
    with ExitStack() as stack:
        folders = [
            stack.enter_context(result_folder(folder)) for folder in dict.fromkeys(path.parent for path in paths)
        ]
        acquired = stack.enter_context(lock(paths[0].parent / f".egs-{paths[0].name}.lock"))
        if not acquired:
            raise UserError(f"{paths[0]}: another run is writing this file; wait for it, or choose another name")
        # Check again: files may have been created between the first check and the lock.
        check_named_files(*paths, overwrite=overwrite)
        yield NamedFiles(paths)
        # Remove leftovers of a killed run that were kept before, because they were so recent that they could have
        # belonged to an active run.
        for folder in folders:
            sweep_all(folder)


def check_named_files(*paths: Path, overwrite: bool = False) -> None:
    """Raise the predictable errors of ``named_files``, before any long computation and without creating anything."""
    for path in paths:
        check_out(path.parent)
        if path.is_dir():
            raise UserError(f"{path}: is a folder; give the name of a file")
        if path.exists() and not overwrite:
            what = "it exists" if path == paths[0] else f"{path.name} exists"
            advice = f"{what} already; choose another name, or move it aside"
            raise ArgumentError("out", advice, value=paths[0], using="overwrite")
