"""The one error a user can cause."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

_LONGEST = 2000
"""Characters of a message."""


class UserError(ValueError):
    """Bad input. The message is one line: what is wrong, where, and what to do. The command exits with status 2."""

    def __init__(self, message: str) -> None:
        # Names and values come from the user's files: line breaks and half characters are shown by their codes.
        line = "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in message)
        if len(line) > _LONGEST:
            line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"
        super().__init__(line)


@contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Bad input within prints one line and ends the ``program`` with status 2."""
    try:
        yield
    except UserError as error:
        print(f"{program}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
