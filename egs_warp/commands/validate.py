"""``egs-warp validate``: check that a bundle conforms to its format."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from egs_warp.commands.flags import Commands, input_path

EXAMPLES = ("jump.egs",)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    validate = commands.add_parser("validate", help="check that a bundle keeps to its format")
    validate.add_argument("file", type=input_path, help="bundle (.egs) that export wrote")
    validate.set_defaults(run=_validate)


def _validate(args: argparse.Namespace) -> int:
    from egs_warp.io.bundle_file import findings, read_valid_file

    file: Path = args.file
    problems = findings(file)
    for problem in problems:
        print(f"{file}: {problem}", file=sys.stderr)
    if problems:
        return 2
    text = read_valid_file(file).text
    bodies = "; ".join(f"{body['name']}: {_description(body)}" for body in text["bodies"])
    size = file.stat().st_size / 1e6
    print(f"{file}: valid, version {text['version']}, {text['frames']} frames, {size:.1f} MB; {bodies}")
    return 0


def _description(body: dict[str, Any]) -> str:
    if "blocks" not in body:
        return f"{body['count']} Gaussians, static"
    nodes = body["arrays"]["rest_nodes"]["shape"][0]
    return f"{body['count']} Gaussians, {nodes} nodes with an error of at most {body['node_error']:.1g} m"
