"""The command ``egs-warp``."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from egs_warp.commands import COMMANDS
from egs_warp.commands.flags import flag_of
from egs_warp.errors import UserError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2."""
    parser = _parser()
    chosen = parser.parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    try:
        return chosen.run(chosen)
    except UserError as error:
        print(f"egs-warp: {error.told(flag_of)}", file=sys.stderr)
        return 2


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
    subparsers = parser.add_subparsers(dest="command", required=True)
    for name in COMMANDS:
        importlib.import_module(f"egs_warp.commands.{name}").add_parser(subparsers)
    return parser


if __name__ == "__main__":
    sys.exit(main())
