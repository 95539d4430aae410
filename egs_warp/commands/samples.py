"""``egs-warp samples``: write a small built-in capture and scene to try the commands on."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from egs_warp.commands.flags import Commands, add_out_flag

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
    folder = writable_folder(args.out)
    capture, whole = folder / "pawn.ply", folder / "pawn_on_its_board.ply"
    pawn_scene = scene("pawn")
    write_ply(capture, pawn(gaussian_count=_GAUSSIANS).cloud)
    write_ply(whole, pawn_scene.whole()[0])
    print(f"wrote {capture}, an object alone, and {whole}, the object in a scene; z is up; next steps:")
    for flags in (
        [str(capture), "--up", "z", "--size", "256", "--out", str(folder / "jump")],
        [str(whole), "--up", "z", "--object", "0,0,0.5", "--size", "256", "--out", str(folder / "scene")],
    ):
        print(f"  egs-warp animate {shlex.join(flags)}")
    return 0
