"""The command ``egs-warp``."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from egs_warp.commands import COMMANDS
from egs_warp.commands.endings import Ended, one_line_errors
from egs_warp.version import __version__


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; whatever stops it prints one line (``commands.endings``) and is told by the status."""
    try:
        with one_line_errors("egs-warp"):
            given = sys.argv[1:] if arguments is None else arguments
            chosen = _parser().parse_args(_joined(given))
            return chosen.run(chosen)
    except Ended as ended:
        assert isinstance(ended.code, int)
        return ended.code


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the flags."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


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


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="egs-warp", description="Still objects in 3DGS captures walk, jump and twist.")
    parser.add_argument("--version", action="version", version=f"egs-warp {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True)
    for name in COMMANDS:
        importlib.import_module(f"egs_warp.commands.{name}").add_parser(subparsers)
    return parser


if __name__ == "__main__":
    sys.exit(main())
