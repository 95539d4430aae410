"""``egs-warp demo``: the film of the README, from a built-in scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from egs_warp.commands.animate import EXIT_NOT_AS_REQUESTED
from egs_warp.commands.flags import Commands, add_out_flag
from egs_warp.commands.scene_flags import add_overwrite_flag, print_film, print_note, start_device

EXAMPLES = ("", "--out out/demo --size 256", "--device cuda:0")
_MOTION = "hop x3"


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    demo = commands.add_parser("demo", help="let the built-in pawn hop across its board, and film it")
    add_out_flag(
        demo,
        "folder for the video, contact sheet, report and trajectory (%(default)s)",
        metavar="FOLDER",
        default=Path("egs-warp-demo"),
    )
    demo.add_argument("--size", type=int, default=512, help="width and height of the film, pixels (%(default)s)")
    demo.add_argument("--frames", type=int, help="frames at 60 per second (default: until the pawn is at rest)")
    demo.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    add_overwrite_flag(demo, "--out")
    demo.set_defaults(run=_demo)


def _demo(args: argparse.Namespace) -> int:
    import numpy as np

    from egs_warp.assets import scene
    from egs_warp.io.run_folder import check_run_folder
    from egs_warp.pipelines.animate import AnimateOptions, animate
    from egs_warp.pipelines.creature import CreatureOptions

    check_run_folder(args.out, overwrite=args.overwrite)
    front = CreatureOptions(front=np.array([1.0, 0.0, 0.0]))
    options = AnimateOptions(frames=args.frames, size=args.size, source="pawn", creature=front)
    start_device(args.device)
    made = scene("pawn", device=args.device)
    report = animate(
        made.object,
        args.out,
        motion=_MOTION,
        plane=made.plane,
        background=made.background,
        options=options,
        overwrite=args.overwrite,
        show_note=print_note,
    )
    print(report.summary())
    print_film(args.out, str(report.film), "sheet.png, plots.png and report.json")
    print("egs-warp animate CAPTURE.ply --out out/own brings your own capture to life")
    return EXIT_NOT_AS_REQUESTED if report.state.is_failure else 0
