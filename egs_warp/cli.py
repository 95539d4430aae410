"""Entry point of the command ``egs-warp``: builds the parsers and runs the sub-command."""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

from egs_warp.commands import COMMANDS, GROUPS
from egs_warp.commands.config import with_config
from egs_warp.commands.exit_handling import HandledExit, one_line_errors
from egs_warp.commands.flag_hints import check_flags, check_surplus
from egs_warp.commands.flags import check_inputs, check_texts
from egs_warp.errors import CaptureWarning, UserError, did_you_mean
from egs_warp.version import __version__


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with ``arguments`` (default: ``sys.argv[1:]``) and return its exit status.

    Errors and signals print one line (``commands.exit_handling``).
    """
    # The matrices of a step are small: BLAS threads cost more time than they save, tenfold on a loaded machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.stderr is None or not sys.stderr.isatty():
        # In a log file, each update of a progress bar is a line of its own.
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    # Commands print these as notes.
    warnings.simplefilter("ignore", CaptureWarning)
    try:
        with one_line_errors("egs-warp"):
            words = _attach_negative_values(sys.argv[1:] if arguments is None else arguments)
            parser, commands = _parsers()
            if not words:
                parser.print_help()
                return 0
            command = commands.get(words[0])
            check_flags(words[:1], parser, commands)
            if command is not None:
                check_flags(words[1:], command, commands)
            if command is not None and "--config" in command._option_string_actions:
                words = [words[0], *with_config(words[1:], command)]
            args, surplus = parser.parse_known_args(words)
            check_surplus(surplus, words[1:], command or parser)
            check_texts(args)
            if command is not None:
                check_inputs(args, command)
            return args.run(args)
    except HandledExit as end:
        assert isinstance(end.code, int)
        return end.code


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports an error in one line, without the usage, and suggests the nearest name."""

    complete_help: Callable[[argparse.ArgumentParser], None] | None = None
    """Function that completes those help texts that depend on a registry, which is slow to import; None if there are
    none."""

    def format_help(self) -> str:
        """Return the text of ``--help``."""
        if self.complete_help is not None:
            self.complete_help(self)
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        about_one = re.fullmatch(r"argument (\S+?)(?:/-\S+)?: (.*)", message)
        if about_one is not None:
            name, problem = about_one.groups()
            message = f"{name}: {next((own for start, own in _ADVICE.items() if problem.startswith(start)), problem)}"
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            return super()._get_value(action, arg_string)
        except argparse.ArgumentError as error:
            # Its message is that of an ArgumentTypeError, or else names the Python type.
            advice = _ACCEPTED.get(action.type) or error.message
            raise UserError(f"{_flag_name(action)} {_quoted(arg_string)}: {advice}") from None

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        names = [str(choice) for choice in action.choices]
        if action.dest == "command":
            raise UserError(f"{value!r} is unknown{_meant_command(value, names)}; give one of {', '.join(names)}")
        near = did_you_mean(value, names)
        raise UserError(f"{_flag_name(action)} {_quoted(str(value))}: unknown{near}; give one of {', '.join(names)}")


_ACCEPTED: Mapping[Any, str] = {int: "give a whole number", float: "give a number"}
"""Advice for a value that a built-in type does not accept."""
_ADVICE = {
    "expected one argument": "its value is missing; give one",
    "expected at least one argument": "its value is missing; give at least one",
    "ignored explicit argument": "it takes no value; leave the value out",
}
"""Texts that replace those of argparse that begin in this way."""


def _flag_name(action: argparse.Action) -> str:
    """Return the long name of a flag, or the name of a positional argument as in the help."""
    long = [name for name in action.option_strings if name.startswith("--")]
    return (long or action.option_strings or [str(action.metavar or action.dest)])[0]


def _quoted(text: str) -> str:
    return text if text.split() == [text] else repr(text)


def _meant_command(word: str, names: Sequence[str]) -> str:
    """Return a suggestion in brackets for ``word``, which is not one of the commands ``names``."""
    from egs_warp.motions.names import NAMES

    if word in NAMES:
        return f" (did you mean animate CAPTURE --motion {word} --out FOLDER?)"
    if os.path.isfile(word):  # Unlike Path.is_file, this returns False for a name that is too long.
        return f" (did you mean animate {word} --out FOLDER?)"
    return did_you_mean(word, names)


class _Overview(_Parser):
    """Top-level parser whose help lists the commands by group."""

    def format_help(self) -> str:
        """Return the text of ``egs-warp --help``."""
        subparsers = next(action for action in self._actions if isinstance(action, argparse._SubParsersAction))
        helps = {action.dest: action.help for action in subparsers._get_subactions()}
        lines = [f"usage: {self.prog} [--version] COMMAND ...", "", str(self.description)]
        for group, names in GROUPS.items():
            lines += ["", f"{group}:", *(f"  {name:<13}{helps[name]}" for name in names)]
        lines += [
            "",
            f"{self.prog} COMMAND --help describes the flags of a command, with examples.",
            "",
            "first steps:",
        ]
        lines += [f"  {self.prog} {example}" for example in _FIRST_EXAMPLES]
        return "\n".join([*lines, "", _EXIT_STATUSES, ""])


_FIRST_EXAMPLES = (
    *("doctor", "demo", "samples"),
    *("animate samples/pawn.ply --up z --out out/jump", "view out/jump"),
)
_EXIT_STATUSES = """exit status:
  0    done
  1    out of memory or disk space, or a disk error; doctor: a required component is missing
  2    invalid input; the message says what to change
  3    demo, animate, resume, from-photos: the files are written, but the body fell or missed its
       target, or a step could not be solved
  130  stopped by Ctrl-C; no half-written file is left
  143  stopped by SIGTERM; no half-written file is left"""


def _attach_negative_values(arguments: Sequence[str]) -> list[str]:
    """Rewrite ``--up -y`` as ``--up=-y``: argparse would read a value that begins with a minus as a flag."""
    result: list[str] = []
    for argument in arguments:
        flag = result[-1] if result else ""
        if flag.startswith("--") and "=" not in flag and re.fullmatch(r"-([\d.].*|[xyz])", argument, re.IGNORECASE):
            result[-1] = f"{flag}={argument}"
        else:
            result.append(argument)
    return result


def _parsers() -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """Return the top-level parser, and the parsers of the commands by name."""
    parser = _Overview(
        prog="egs-warp", description="Make still objects in 3D Gaussian Splatting captures walk, jump and twist."
    )
    parser.add_argument("--version", action="version", version=f"egs-warp {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)
    for name in COMMANDS:
        module = importlib.import_module(f"egs_warp.commands.{name.replace('-', '_')}")
        module.add_parser(subparsers)
        command = subparsers.choices[name]
        command.complete_help = getattr(module, "complete_help", None)
        command.formatter_class = argparse.RawDescriptionHelpFormatter
        examples = "\n".join(f"  {command.prog} {example}".rstrip() for example in module.EXAMPLES)
        command.epilog = f"examples:\n{examples}\n\n{_EXIT_STATUSES}"
    return parser, subparsers.choices


if __name__ == "__main__":
    sys.exit(main())
