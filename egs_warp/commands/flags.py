"""Flags that several commands share: how they are read, and which argument of the library each one gives."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from egs_warp.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from egs_warp.geometry.plane import Plane
    from egs_warp.inpainting.inpainters import Inpainter
    from egs_warp.io.capture import Capture

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
"""What a command adds its parser to."""

SPLAT_FILES = ("ply", "compressed-ply", "spz", "spz4", "sog", "splat", "glb")
"""Names of ``egs_warp.io.writing.WRITERS``, which is slow to import."""
QP_SOLVERS = ("osqp", "admm", "daqp")
"""Names of ``egs_warp.locomotion.solvers.QpSolver``, which is slow to import."""
_AXES = {"x": 0, "y": 1, "z": 2}
_FLAGS = {"muscles_file": "--muscles", "solids": "--terrain"}
"""Of arguments whose flags are called otherwise."""


def flag_of(argument: str) -> str:
    """The flag that gives ``argument`` of a function of the library."""
    return _FLAGS.get(argument, f"--{argument.replace('_', '-')}")


def named_path(text: str) -> Path:
    """The path that a flag gives. An empty one, as of an unset variable, would be the working folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("nothing is given; give a name")
    return Path(text)


def seed(text: str) -> int:
    """The number that a flag gives, as generators of random numbers take it."""
    number = int(text)
    if not 0 <= number < 1 << 32:
        raise argparse.ArgumentTypeError(f"{text} is not from 0 to {(1 << 32) - 1}")
    return number


def add_qp_flag(parser: argparse._ActionsContainer) -> None:
    """Add the flag that names the ``qp_solver`` of ``LocomotionSettings``."""
    parser.add_argument(
        "--qp",
        choices=QP_SOLVERS,
        help="who solves the QPs of a step: osqp, on the host; admm, its iterations on --device; daqp, if installed"
        " (osqp on cpu, admm on cuda:0)",
    )


def add_inpainter_flags(parser: argparse._ActionsContainer, *, default: str | None) -> None:
    """Add the flags that ``chosen_inpainter`` reads."""
    parser.add_argument("--inpainter", default=default, help="patch (default), telea, ns, or LaMa's ONNX file")
    parser.add_argument(
        "--trust", action="store_true", help="let --inpainter be a TorchScript file, which may run any program"
    )


def chosen_inpainter(chosen: argparse.Namespace, *, seed: int = 0) -> Inpainter:
    """What ``--inpainter`` names. Raises ``UserError`` for a file that is no network, or that is not trusted."""
    from egs_warp.inpainting.inpainters import TorchScriptInpainter, inpainter_by_name

    inpainter = inpainter_by_name(chosen.inpainter or "patch", seed=seed, device=chosen.device, trust=chosen.trust)
    if isinstance(inpainter, TorchScriptInpainter):
        print(f"egs-warp: warning: {inpainter.path} is trusted to run any program that it carries", file=sys.stderr)
    return inpainter


def parse_up(text: str) -> np.ndarray:
    """(3,) unit vector of an axis name such as ``-y``. Raises ``UserError`` otherwise."""
    import numpy as np

    name = text.strip().lower().lstrip("+-")
    if name not in _AXES:
        raise UserError(f"--up {text}: give one of x, y, z, -x, -y, -z")
    up = np.zeros(3)
    up[_AXES[name]] = -1.0 if text.strip().startswith("-") else 1.0
    return up


def parse_direction(flag: str, text: str) -> np.ndarray:
    """(3,) unit vector from ``x,y,z``, or of an axis name such as ``-y``. Raises ``UserError`` otherwise."""
    import numpy as np

    if text.strip().lower().lstrip("+-") in _AXES:
        return parse_up(text)
    try:
        direction = np.array([float(part) for part in text.split(",")])
    except ValueError:
        direction = np.zeros(0)
    with np.errstate(over="ignore", invalid="ignore"):
        length = float(np.linalg.norm(direction))
    if len(direction) != 3 or not np.isfinite(length) or length == 0.0:
        raise UserError(f"--{flag} {text}: give three numbers x,y,z or an axis as -y")
    return direction / length


def parse_plane(text: str) -> Plane:
    """Plane from ``nx,ny,nz,d``. Raises ``UserError`` otherwise."""
    from egs_warp.geometry.plane import Plane
    from egs_warp.io.limits import FURTHEST

    try:
        nx, ny, nz, d = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--plane {text}: give four numbers nx,ny,nz,d") from error
    plane = Plane.from_coefficients(nx, ny, nz, d)
    if abs(plane.offset) > FURTHEST:
        raise UserError(f"--plane {text}: lies {abs(plane.offset):g} units from the origin; give at most {FURTHEST:g}")
    return plane


def guessed_up(capture: Capture) -> tuple[np.ndarray, str]:
    """(3,) up of a ``Capture`` whose file cannot tell, and what to say about it."""
    import numpy as np

    from egs_warp.segmentation.base_plane import guess_up

    up, reason = guess_up(capture.cloud, capture.up)
    axis = "xyz"[int(np.argmax(np.abs(up)))]
    return up, f"up is taken to be {'-' if up.sum() < 0 else '+'}{axis} ({reason}); if not, give --up"
