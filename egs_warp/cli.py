"""The command ``egs-warp``."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from egs_warp.commands import COMMANDS
from egs_warp.errors import UserError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    try:
        return chosen.run(chosen)
    except UserError as error:
        print(f"egs-warp: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="egs-warp", description="Still objects in 3DGS captures walk, jump and twist."
    )
    subparsers = parser.add_subparsers(dest="command", required=True)
    for name in COMMANDS:
        importlib.import_module(f"egs_warp.commands.{name}").add_parser(subparsers)
    return parser


if __name__ == "__main__":
    sys.exit(main())
