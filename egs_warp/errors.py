"""Errors that report invalid input to the user."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable, Sequence

_MAX_MESSAGE_LENGTH = 2000
"""Maximum number of characters of a message; the middle of a longer one is cut out."""

_MIN_BEGINNING = 3
"""Minimum length, in characters, of an unknown name for it to be completed to a longer one."""
_LETTERS_PER_CHANGE = 3
"""Number of characters of a name for each change that counts as a misspelling. A less similar name means something
else."""


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return `` (did you mean 'walk'?)`` with the ``nearest_name``, or an empty text if there is none."""
    return suggestion(nearest_name(str(name), names))


def suggestion(near: str | None) -> str:
    """Return `` (did you mean 'walk'?)`` for the name ``near``; an empty text for None."""
    return "" if near is None else f" (did you mean {near!r}?)"


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """Return the first member of ``names`` that begins with the unknown ``name``, or else the one of which it is a
    misspelling (``misspelling``). Case is ignored.

    None is returned if there is no such member, or if ``name`` itself is a member: it is in the wrong position, not
    misspelt.
    """
    members = [str(known) for known in names]
    if name in members:
        return None
    if len(name) >= _MIN_BEGINNING:
        longer = next((known for known in members if known.lower().startswith(name.lower())), None)
        if longer is not None:
            return longer
    changes = {known: count for known in members if (count := misspelling(name, known)) is not None}
    return min(changes, key=lambda known: changes[known], default=None)


def misspelling(written: str, known: str) -> int | None:
    """Return the number of inserted, deleted, replaced and swapped letters between two words, without regard to case
    (the optimal string alignment distance); None if the word ``written`` is too short for as many changes."""
    first, second = written.lower(), known.lower()
    most = len(first) // _LETTERS_PER_CHANGE
    if abs(len(first) - len(second)) > most:
        return None
    rows = [list(range(len(second) + 1))]
    for i, letter in enumerate(first):
        row = [i + 1]
        for j, other in enumerate(second):
            row.append(min(row[j] + 1, rows[i][j + 1] + 1, rows[i][j] + (letter != other)))
            if i and j and letter == second[j - 1] and first[i - 1] == other:
                row[-1] = min(row[-1], rows[i - 1][j - 1] + 1)
        rows.append(row)
    return rows[-1][-1] if rows[-1][-1] <= most else None


class CaptureWarning(UserWarning):
    """Warning about a capture that may result in a poor body, or about a world with frictions that no body uses."""


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Issue a Python warning that names the line of the user's program that called the package."""
    frame, depth = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "egs_warp":
        frame, depth = frame.f_back, depth + 1
    warnings.warn(message, category, stacklevel=depth)


class UserError(ValueError):
    """Error that reports invalid input. Its message is one line: what is wrong, where, and what to do. Commands exit
    with status 2."""

    def __init__(self, message: str, *, check: Sequence[str] = (), using: str | None = None) -> None:
        """Store the message.

        Args:
            message: what is wrong and what to do.
            check: arguments that may be the cause; the message ends with their names.
            using: argument that does what ``message`` advises last; the message ends with its name.
        """
        self.message, self.check, self.using = message, tuple(check), using
        super().__init__(self.format_message())

    def format_message(self, name: Callable[[str], str] = str) -> str:
        """Return the message; ``name`` maps the name of an argument to the one to print, such as a command's flag."""
        advice = "" if self.using is None else f" with {name(self.using)}"
        if self.check:
            *first, last = map(name, self.check)
            advice += f"; check {', '.join(first)}{' and ' if first else ''}{last}"
        # Names and values come from the user's files: escape line breaks and unpaired surrogates.
        line = "".join(
            letter if letter.isprintable() else ascii(letter)[1:-1] for letter in self._argument_text(name) + advice
        )
        if len(line) > _MAX_MESSAGE_LENGTH:
            line = f"{line[: _MAX_MESSAGE_LENGTH // 2]} ... {line[-_MAX_MESSAGE_LENGTH // 2 :]}"
        return line

    def _argument_text(self, name: Callable[[str], str]) -> str:
        return self.message


class CallError(UserError, TypeError):
    """Error that reports a call with an unknown or missing argument, or with an argument of a wrong type or shape."""


class ArgumentError(UserError):
    """Error that reports an invalid value of an argument, such as ``friction 12: give a Coulomb coefficient from 0 to
    10``."""

    def __init__(
        self, argument: str, problem: str, *, value: object = None, check: Sequence[str] = (), using: str | None = None
    ) -> None:
        """Store the message.

        Args:
            argument: name of the argument.
            problem: what is wrong and what to do.
            value: the invalid value, if the message should contain it.
            check: other arguments that may be the cause.
            using: argument that does what ``problem`` advises last.
        """
        self.argument, self.value = argument, value
        super().__init__(problem, check=check, using=using)

    def _argument_text(self, name: Callable[[str], str]) -> str:
        value = "" if self.value is None else f" {self.value}"
        return f"{name(self.argument)}{value}: {self.message}"
