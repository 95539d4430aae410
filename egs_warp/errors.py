"""Errors that report invalid input to the user."""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence

_MAX_MESSAGE_LENGTH = 2000
"""Maximum number of characters of a message; the middle of a longer one is cut out."""

_MIN_BEGINNING = 3
"""Minimum length, in characters, of an unknown name for it to be completed to a longer one."""


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return `` (did you mean 'walk'?)`` with the ``nearest_name``, or an empty text if there is none."""
    near = nearest_name(str(name), names)
    return "" if near is None else f" (did you mean {near!r}?)"


def nearest_name(name: str, names: Iterable[str], *, similarity: float = 0.6) -> str | None:
    """Return the member of ``names`` that begins with the unknown ``name``, or else the most similar one, or None.

    Case is ignored, but a beginning in the same case is preferred; among names that differ only in case, the first is
    returned. None is returned if ``name`` itself is a member: it is in the wrong position, not misspelt.

    Args:
        name: unknown name.
        names: known names.
        similarity: smallest ratio of ``difflib.SequenceMatcher`` of a similar name.
    """
    by_lower = {str(known).lower(): str(known) for known in reversed(list(names))}
    if name in by_lower.values():
        return None
    written = name.lower()
    longer = [known for known in by_lower if len(written) >= _MIN_BEGINNING and known.startswith(written)]
    same_case = [known for known in longer if by_lower[known].startswith(name)]
    near = same_case[-1:] or longer[-1:] or difflib.get_close_matches(written, by_lower, n=1, cutoff=similarity)
    return by_lower[near[0]] if near else None


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
