"""The one error a user can cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence

_LONGEST = 2000
"""Characters of a message."""


class UserError(ValueError):
    """Bad input. The message is one line: what is wrong, where, and what to do. The command exits with status 2."""

    def __init__(self, message: str, *, check: Sequence[str] = ()) -> None:
        """``check``: arguments that may be the cause; the message ends with their names."""
        self.message, self.check = message, tuple(check)
        super().__init__(self.format_message())

    def format_message(self, name: Callable[[str], str] = str) -> str:
        """The message, in which each argument is called by its ``name``: a command's flag for it, say."""
        advice = f"; check {' and '.join(map(name, self.check))}" if self.check else ""
        # Names and values come from the user's files: line breaks and half characters are shown by their codes.
        line = "".join(
            letter if letter.isprintable() else ascii(letter)[1:-1] for letter in self._argument_text(name) + advice
        )
        if len(line) > _LONGEST:
            line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"
        return line

    def _argument_text(self, name: Callable[[str], str]) -> str:
        return self.message


class ArgumentError(UserError):
    """A value that an argument cannot have: ``friction 12: give a Coulomb coefficient from 0 to 10``."""

    def __init__(self, argument: str, problem: str, *, value: object = None, check: Sequence[str] = ()) -> None:
        """``problem``: what is wrong and what to do; ``value``: what was given, where that says more."""
        self.argument, self.value = argument, value
        super().__init__(problem, check=check)

    def _argument_text(self, name: Callable[[str], str]) -> str:
        given = "" if self.value is None else f" {self.value}"
        return f"{name(self.argument)}{given}: {self.message}"
