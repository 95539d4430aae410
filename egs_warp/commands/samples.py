"""``egs-warp samples``: write a small built-in capture and scene to try the commands on."""

from __future__ import annotations

import argparse
import filecmp
import os
import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import Commands, add_out_flag
from egs_warp.errors import ArgumentError

if TYPE_CHECKING:
    from egs_warp.geometry.gaussians import GaussianCloud

_GAUSSIANS = 6000
"""Number of Gaussians of the object alone; ``animate`` takes about half as long as for the full pawn."""


EXAMPLES = ("", "--out out/samples")


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    samples = commands.add_parser("samples", help="write a small built-in capture and scene to try")
    add_out_flag(
        samples,
        "folder for the captures, created if it is missing (%(default)s)",
        metavar="FOLDER",
        default=Path("samples"),
    )
    samples.set_defaults(run=_samples)


def _samples(args: argparse.Namespace) -> int:
    from egs_warp.assets import pawn, scene
    from egs_warp.io import write_ply
    from egs_warp.io.atomic import writable_folder
    from egs_warp.io.run_folder import check_out
    from egs_warp.launching import use_device

    check_out(args.out)
    use_device("cpu")
    capture, whole = args.out / "pawn.ply", args.out / "pawn_on_its_board.ply"
    clouds = {capture: pawn(gaussian_count=_GAUSSIANS).cloud, whole: scene("pawn").whole()[0]}
    for path, cloud in clouds.items():
        _check_no_other_file(path, cloud)
    folder = writable_folder(args.out)
    for path, cloud in clouds.items():
        write_ply(path, cloud)
    print(f"wrote {capture}, an object alone, and {whole}, the object in a scene; z is up; next steps:")
    for flags in (
        [str(capture), "--up", "z", "--size", "256", "--out", str(folder / "jump")],
        [str(whole), "--up", "z", "--object", "0,0,0.5", "--size", "256", "--out", str(folder / "scene")],
    ):
        print(f"  egs-warp animate {shlex.join(flags)}")
    return 0


def _check_no_other_file(path: Path, cloud: GaussianCloud) -> None:
    """Raise ``ArgumentError`` if ``path`` exists and is not a file with ``cloud``, as an earlier call writes it."""
    from egs_warp.io import write_ply

    if not os.path.lexists(path):
        return
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / path.name
        write_ply(own, cloud)
        is_equal = path.is_file() and filecmp.cmp(own, path, shallow=False)
    if not is_equal:
        problem = f"it has another {path.name} already; choose another folder, or move the file aside"
        raise ArgumentError("out", problem, value=path.parent)
