"""Flags of the commands that read a scene, and the device and notes of all commands."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from egs_warp.commands.flags import add_capture, add_out_flag, input_path, with_flags
from egs_warp.errors import UserError
from egs_warp.notes import Detail, Problem


def add_object_flags(parser: argparse._ActionsContainer, *, common: argparse._ActionsContainer | None = None) -> None:
    """Add the flags that select the object of a scene; ``--object`` is added to ``common`` instead, if that is
    given."""
    (common or parser).add_argument(
        "--object",
        action="append",
        help="select the object of a scene: picked.json of egs-warp pick, mask.png, folder of masks, point x,y,z, box "
        "x0,y0,z0,x1,y1,z1, pixel u,v of --view, salient (the salient object of each photo, needs the extra salient), "
        "or clicks, each with a flag of its own: +u,v@photo on the object, -u,v@photo next to it; animate also takes "
        "NAME= before the value, for several objects (docs/guide/worlds.md)",
    )
    parser.add_argument(
        "--mask-model",
        type=input_path,
        help="ONNX file of a network that turns clicks into masks, for example EfficientSAM (docs/guide/scene.md)",
    )
    parser.add_argument(
        "--cameras",
        type=input_path,
        help="cameras of the scene: cameras.json, transforms.json or a COLMAP model (default: a ring of cameras)",
    )
    parser.add_argument("--view", help="name or else number of the camera of a single mask or a pixel")


def check_no_scene_flags(args: argparse.Namespace) -> None:
    """Raise ``UserError`` for flags that require ``--object`` if it is missing."""
    for name in ("cameras", "view", "mask_model", "straddling", "inpainter", "trust", "no_inpaint"):
        if getattr(args, name, None) not in (None, False):
            raise UserError(f"--{name.replace('_', '-')}: needs --object, which selects the object of a scene")


def add_flat_flag(parser: argparse._ActionsContainer) -> None:
    """Add the flag that replaces uneven ground with its plane."""
    parser.add_argument(
        "--flat", action="store_true", help="use the plane as the ground, even if the captured ground is uneven"
    )


def add_overwrite_flag(parser: argparse._ActionsContainer, where: str) -> None:
    """Add the flag that allows moving the files of an earlier run aside; ``where`` names the output flag in the
    help."""
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help=f"move an earlier result at {where} into earlier-1, earlier-2, ...",
    )


def add_scene_flags(parser: argparse.ArgumentParser) -> None:
    """Add the capture and the flags that ``plane`` and ``segment`` share."""
    add_capture(parser)
    add_object_flags(parser)
    add_out_flag(parser, "folder for the result and its image", metavar="FOLDER")
    add_overwrite_flag(parser, "--out")
    parser.add_argument(
        "--up", help="axis that points roughly up: x, y, z, -x, -y or -z, such as --up=-y (default: estimated)"
    )
    parser.add_argument(
        "--plane", help="ground plane: plane.json of an earlier step, or nx,ny,nz,d (default: estimated)"
    )
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")


def start_device(device: str) -> None:
    """Select ``device``; print a note if its kernels still have to be compiled, which takes a minute or two."""
    from egs_warp.launching import kernels_are_compiled, use_device

    use_device(device)
    if not kernels_are_compiled():
        print_note("the first run on this machine compiles the kernels, which takes a minute or two")


def print_note(text: str, *, details: bool = False) -> None:
    """Print one line for the user on stderr, above a progress bar: a ``Problem`` after ``warning:``, and a ``Detail``
    only with ``details``."""
    if isinstance(text, Detail) and not details:
        return
    kind = "warning: " if isinstance(text, Problem) else ""
    print_above_bars(f"egs-warp: {kind}{text}", file=sys.stderr)


def print_notes(notes: Iterable[str], *, details: bool = False) -> None:
    """Print notes with ``print_note``, problems last. ``details`` is True for a command that writes no report."""
    for note in sorted(notes, key=lambda note: isinstance(note, Problem)):
        print_note(note, details=details)


def print_above_bars(text: str, *, file: TextIO | None = None) -> None:
    """Print lines on ``file`` (default stdout), above a progress bar. Their advice names flags (``with_flags``)."""
    from tqdm import tqdm

    with tqdm.external_write_mode(file=file):
        print(with_flags(text), file=file)


def print_film(run: Path, film: str, others: str) -> None:
    """Print the path of the video ``film`` in the folder ``run``, the names of the ``others`` beside it, and the
    command that shows the run."""
    print_above_bars(
        f"film: {run / film} ({others} are beside it); egs-warp view {shlex.quote(str(run))} shows the run in the"
        " browser"
    )
