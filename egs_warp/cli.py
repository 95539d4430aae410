"""The command ``egs-warp``."""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from collections.abc import Mapping, Sequence
from typing import NoReturn

from egs_warp.commands import COMMANDS, GROUPS
from egs_warp.commands.config import with_config
from egs_warp.commands.exit_handling import HandledExit, one_line_errors
from egs_warp.version import __version__


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; whatever stops it prints one line (``commands.exit_handling``) and is told by the status."""
    # The matrices of a step are small: threads cost more than they bring, and tenfold beside other work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with one_line_errors("egs-warp"):
            given = _joined(sys.argv[1:] if arguments is None else arguments)
            parser, commands = _parsers()
            command = commands.get(given[0]) if given else None
            if command is not None and "--config" in command.format_usage():
                given = [given[0], *with_config(given[1:], command)]
            chosen = parser.parse_args(given)
            return chosen.run(chosen)
    except HandledExit as ended:
        assert isinstance(ended.code, int)
        return ended.code


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the flags."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


class _Overview(_Parser):
    """Lists the commands in their groups."""

    def format_help(self) -> str:
        """What ``egs-warp --help`` prints."""
        subparsers = next(action for action in self._actions if isinstance(action, argparse._SubParsersAction))
        helps = {action.dest: action.help for action in subparsers._get_subactions()}
        lines = [f"usage: {self.prog} [--version] COMMAND ...", "", str(self.description)]
        for group, names in GROUPS.items():
            lines += ["", f"{group}:", *(f"  {name:<10}{helps[name]}" for name in names)]
        lines += ["", f"{self.prog} COMMAND --help says more of each, with examples.", "", "try:"]
        lines += [f"  {self.prog} {example}" for example in _FIRST]
        return "\n".join([*lines, "", _STATUSES, ""])


_FIRST = ("doctor", "samples samples", "animate samples/pawn.ply --up z --out out/jump", "view out/jump")
_STATUSES = """exit status:
  0    done
  1    memory or disk gave out; of doctor: something is missing without which nothing works
  2    bad input, told in one line
  3    of animate, resume: written, but the body has fallen or a step could not be solved
  130  Ctrl-C; 143 SIGTERM: one line, no half-written file"""


def _joined(arguments: Sequence[str]) -> list[str]:
    """``--up -y`` as ``--up=-y``: a value that begins with a minus would be taken for a flag."""
    joined: list[str] = []
    for argument in arguments:
        flag = joined[-1] if joined else ""
        if flag.startswith("--") and "=" not in flag and re.fullmatch(r"-([\d.].*|[xyz])", argument, re.IGNORECASE):
            joined[-1] = f"{flag}={argument}"
        else:
            joined.append(argument)
    return joined


def _parsers() -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """The whole parser, and those of the commands by name."""
    parser = _Overview(prog="egs-warp", description="Still objects in 3DGS captures walk, jump and twist.")
    parser.add_argument("--version", action="version", version=f"egs-warp {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)
    for name in COMMANDS:
        module = importlib.import_module(f"egs_warp.commands.{name}")
        module.add_parser(subparsers)
        command = subparsers.choices[name]
        command.formatter_class = argparse.RawDescriptionHelpFormatter
        examples = "\n".join(f"  {command.prog} {example}".rstrip() for example in module.EXAMPLES)
        command.epilog = f"examples:\n{examples}\n\n{_STATUSES}"
    return parser, subparsers.choices


if __name__ == "__main__":
    sys.exit(main())
