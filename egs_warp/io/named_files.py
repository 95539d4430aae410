"""Files that a user names one by one belong to one run: locked while it goes on, those of an earlier one kept aside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.atomic import lock, sweep_all, writable_folder
from egs_warp.io.run_folder import back_up, check_out


class NamedFiles:
    """Files that one run writes; made by ``named_files``."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def begin(self) -> None:
        """Move what is there aside: all files are about to be written."""
        for folder in dict.fromkeys(path.parent for path in self._paths):
            back_up(folder, [path.name for path in self._paths if path.parent == folder])


@contextmanager
def named_files(*paths: Path, overwrite: bool = False) -> Iterator[NamedFiles]:
    """The files ``paths``, the first of which a user has named, for one run; folders are made where they are missing.

    Raises ``UserError`` where another run is writing the first, or where one of them is there and may not be moved
    aside (``overwrite``).
    """
    check_named_files(*paths, overwrite=overwrite)
    folders = [writable_folder(folder) for folder in dict.fromkeys(path.parent for path in paths)]
    with lock(paths[0].parent / f".egs-{paths[0].name}.lock") as free:
        if not free:
            raise UserError(f"{paths[0]}: another run is writing this file; wait for it, or choose another name")
        # What came between the check and the lock.
        check_named_files(*paths, overwrite=overwrite)
        yield NamedFiles(paths)
        # What a killed run had left so lately that it might have been a living one's.
        for folder in folders:
            sweep_all(folder)


def check_named_files(*paths: Path, overwrite: bool = False) -> None:
    """Raise the ``UserError`` of ``named_files`` as far as it can be known, and make nothing: before any long work."""
    for path in paths:
        check_out(path.parent)
        if path.is_dir():
            raise UserError(f"{path}: is a folder; give the name of a file")
        if path.exists() and not overwrite:
            what = "it is there" if path == paths[0] else f"{path.name} is there"
            advice = f"{what} already; choose another name, or have it moved aside"
            raise ArgumentError("out", advice, value=paths[0], check=("overwrite",))
