"""Flags shared by several commands: their parsing, and the library arguments that they set."""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from egs_warp.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from egs_warp.geometry.gaussians import GaussianCloud
    from egs_warp.geometry.plane import Plane
    from egs_warp.inpainting.inpainters import Inpainter

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
"""Subparsers, to which each command adds its parser."""

SPLAT_FILES = ("ply", "compressed-ply", "spz", "spz4", "sog", "splat", "glb")
"""Keys of ``egs_warp.io.writing.WRITERS``, repeated here because that module is slow to import."""
QP_SOLVERS = ("osqp", "admm", "daqp")
"""Values of ``egs_warp.locomotion.solvers.QpSolver``, repeated here because that module is slow to import."""
STRATEGIES = ("modes", "paper")
"""Values of ``egs_warp.locomotion.strategies.Strategy``, repeated here because that module is slow to import."""
NAMED_VALUE = re.compile(r"([A-Za-z0-9_-]+)=(.+)", re.DOTALL)
"""Pattern of an ``--object`` value that begins with the name of the object."""
_FLAGS = {"cage_file": "--cage", "muscles_file": "--muscles", "solids": "--terrain"}
"""Flag of each library argument whose flag has another name."""


def flag_of(argument: str) -> str:
    """Return the flag that sets ``argument`` of a library function, or the element ``[N]`` of an argument."""
    argument = argument.partition("[")[0]
    return _FLAGS.get(argument, f"--{argument.replace('_', '-')}")


def with_flags(text: str) -> str:
    """Return notes of the library, one on each line, with flags in place of the arguments that they advise to give."""
    for argument, described in (("front", "the front"), ("up", "the up direction")):
        text = re.sub(f"(?m)(?<=; if that is wrong, give ){described}$", flag_of(argument), text)
    return text


def named_path(text: str) -> Path:
    """Return ``text`` as a path.

    Raises ``ArgumentTypeError`` for an empty text, which would otherwise name the working folder.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty; give a name")
    return Path(text)


def input_path(text: str) -> Path:
    """Return ``text`` as the path of a file or folder that a command reads; ``check_inputs`` tests that it exists."""
    return named_path(text)


def capture_name(text: str) -> str:
    """Return ``text`` unchanged, as the name of a file or folder that a command reads (``check_inputs``)."""
    return text


def run_folder_path(text: str) -> Path:
    """Return ``text`` as the path of the folder of a run, which ``check_inputs`` tests."""
    return named_path(text)


def check_inputs(args: argparse.Namespace, command: argparse.ArgumentParser) -> None:
    """Raise ``UserError`` for the first file or folder among the arguments of ``command`` that does not exist, and for
    a folder without a finished run where one is needed, before the command imports its slow modules."""
    for action in command._actions:
        if action.type not in (input_path, capture_name, run_folder_path):
            continue
        given = getattr(args, action.dest, None)
        for path in given if isinstance(given, list) else [] if given is None else [given]:
            if action.type is run_folder_path:
                from egs_warp.io.run_folder import check_finished

                check_finished(path)
            else:
                _check_exists(path)


def _check_exists(path: Path | str) -> None:
    try:
        os.stat(path)
    except FileNotFoundError:
        from egs_warp.io.limits import missing_error

        raise missing_error(path) from None
    except (OSError, ValueError):
        pass  # The reader of the file reports these.


def add_capture(parser: argparse._ActionsContainer) -> None:
    """Add the argument of the commands that read one capture."""
    parser.add_argument(
        "capture",
        type=capture_name,
        help=".ply, compressed .ply, .spz, .splat, .sog, .glb or an unbundled SOG folder",
    )


def check_texts(args: argparse.Namespace) -> None:
    """Check directions, the plane, the size of the video and the device among the flags of a command, before it imports
    its slow modules. Raises ``UserError`` for the first invalid one."""
    from egs_warp.commands.camera_flags import parse_size

    for name in ("front", "gravity_up", "view_from"):
        if isinstance(text := getattr(args, name, None), str):
            parse_direction(name.replace("_", "-"), text)
    for name, parse in (("up", parse_up), ("size", parse_size)):
        if isinstance(text := getattr(args, name, None), str):
            parse(text)
    plane = getattr(args, "plane", None)
    if isinstance(plane, str) and not names_plane_file(plane):
        parse_plane(plane)
    if getattr(args, "device", "cpu") != "cpu":
        from egs_warp.launching import use_device

        use_device(args.device)


def names_plane_file(text: str) -> bool:
    """Return True if ``text`` of ``--plane`` names a plane.json, and False if it should be ``nx,ny,nz,d``."""
    return text.lower().endswith(".json") or Path(text).is_file()


def add_out_flag(
    parser: argparse._ActionsContainer, what: str, *, metavar: str = "OUT", default: Path | None = None
) -> None:
    """Add the flag for what a command writes, which every command names ``--out``; without ``default`` it is
    required."""
    parser.add_argument(
        "--out", "-o", required=default is None, default=default, type=named_path, metavar=metavar, help=what
    )


def seed(text: str) -> int:
    """Return ``text`` as a seed of random numbers. Raises ``ArgumentTypeError`` outside the range 0 to 2^32 - 1."""
    number = int(text) if text.isdecimal() else -1
    if not 0 <= number < 1 << 32:
        raise argparse.ArgumentTypeError(f"give a whole number from 0 to {(1 << 32) - 1}")
    return number


def add_planning_flags(parser: argparse._ActionsContainer) -> None:
    """Add the flags for ``LocomotionSettings.strategy`` and ``LocomotionSettings.qp_solver``."""
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        default="modes",
        help="search for the contact modes of a step: modes, with the exact friction cone (default); paper, as in"
        " EnliveningGS, with a friction pyramid",
    )
    parser.add_argument(
        "--qp",
        choices=QP_SOLVERS,
        help="QP solver of a step: osqp on the host; admm, the whole search on --device; daqp, if installed"
        " (default: osqp on cpu, admm on cuda:0)",
    )


def add_inpainter_flags(parser: argparse._ActionsContainer, *, default: str | None) -> None:
    """Add the flags that ``chosen_inpainter`` reads."""
    parser.add_argument(
        "--inpainter",
        default=default,
        help="method that fills the floor: patch (default), telea, ns, or the ONNX file of LaMa",
    )
    parser.add_argument(
        "--trust", action="store_true", help="allow a TorchScript file for --inpainter; such a file can run any program"
    )


def chosen_inpainter(args: argparse.Namespace, *, seed: int = 0) -> Inpainter:
    """Return the inpainter of ``--inpainter``, with ``seed`` for its patch search.

    Raises ``UserError`` for a file that is not a network, and for a TorchScript file without ``--trust``.
    """
    from egs_warp.inpainting.inpainters import TorchScriptInpainter, inpainter_by_name

    inpainter = inpainter_by_name(args.inpainter or "patch", seed=seed, device=args.device, trust=args.trust)
    if isinstance(inpainter, TorchScriptInpainter):
        print(f"egs-warp: warning: {inpainter.path} is a TorchScript file and can run any program", file=sys.stderr)
    return inpainter


def parse_up(text: str) -> np.ndarray:
    """Return the (3,) unit vector of an axis name such as ``-y``. Raises ``UserError`` for other texts."""
    from egs_warp.geometry.frames import AXES, axis_named

    up = axis_named(text)
    if up is None:
        raise UserError(f"--up {text}: give one of {AXES}")
    return up


def parse_direction(flag: str, text: str) -> np.ndarray:
    """Return the (3,) unit vector of ``x,y,z`` or of an axis name such as ``-y``.

    Raises ``UserError``, which names ``flag``, for any other text.
    """
    import numpy as np

    from egs_warp.geometry.frames import axis_named

    axis = axis_named(text)
    if axis is not None:
        return axis
    try:
        direction = np.array([float(part) for part in text.split(",")])
    except ValueError:
        direction = np.zeros(0)
    with np.errstate(over="ignore", invalid="ignore"):
        length = float(np.linalg.norm(direction))
    if len(direction) == 3 and length == 0.0:
        raise UserError(
            f"--{flag} {text}: this direction has no length; give one such as 0,-1,0.5, or an axis such as -y"
        )
    if len(direction) != 3 or not np.isfinite(length):
        raise UserError(f"--{flag} {text}: give three numbers x,y,z or an axis such as -y")
    return direction / length


def parse_numbers(flag: str, text: str, count: int) -> np.ndarray:
    """Return the (count,) finite numbers of a text such as ``1,2,3``. Raises ``UserError``, which names ``flag``."""
    import numpy as np

    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise UserError(f"--{flag} {text}: give {count} numbers, separated by commas")
    return numbers


def parse_plane(text: str) -> Plane:
    """Return the plane n.x + d = 0 of ``nx,ny,nz,d``. Raises ``UserError`` for other texts."""
    from egs_warp.geometry.plane import Plane
    from egs_warp.io.limits import MAX_COORDINATE

    try:
        nx, ny, nz, d = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--plane {text}: give four numbers nx,ny,nz,d") from error
    plane = Plane.from_coefficients(nx, ny, nz, d)
    if abs(plane.offset) > MAX_COORDINATE:
        raise UserError(
            f"--plane {text}: the plane lies {abs(plane.offset):g} units from the origin; give one at most"
            f" {MAX_COORDINATE:g} units away"
        )
    return plane


def guessed_up(capture: GaussianCloud) -> tuple[np.ndarray, str]:
    """Estimate the up direction of a capture; return the (3,) unit vector and a note about it for the user."""
    from egs_warp.pipelines.placed_cage import estimated_up

    return estimated_up(capture, advice="give --up")
