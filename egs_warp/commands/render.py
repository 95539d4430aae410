"""``egs-warp render``: film a finished run again with another camera."""

from __future__ import annotations

import argparse
from pathlib import Path

from egs_warp.commands.camera_flags import add_camera_flags, shot_of
from egs_warp.commands.flags import Commands, add_out_flag, run_folder_path

EXAMPLES = (
    "out/jump --out close.mp4 --camera follow --size 1280x720",
    "out/jump --out cut_out.mov --background transparent",
    'out/jump --out turn.webm --turntable 40 --background "#204060"',
    "out/jump --out depth --show depth",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    render = commands.add_parser("render", help="film a finished run again: any camera and size, depth, alpha")
    render.add_argument("folder", metavar="run", type=run_folder_path, help="folder that animate wrote")
    add_out_flag(
        render,
        "output: .mp4, .mov (ProRes 4444), .webm (VP9), or a folder of PNGs; all but .mp4 can be transparent",
    )
    camera = render.add_argument_group("camera")
    add_camera_flags(camera, size="as in the run's video")
    camera.add_argument(
        "--turntable", type=int, metavar="FRAME", help="freeze this frame (60 Hz, -1 is the last) and orbit it once"
    )
    camera.add_argument(
        "--show",
        choices=("colour", "depth", "alpha"),
        default="colour",
        help="colour (default); depth, near is white, in PNGs as 16-bit millimetres; or alpha",
    )
    render.add_argument("--no-shadow", action="store_true", help="draw no shadow under the object")
    render.add_argument(
        "--no-light",
        action="store_true",
        help="keep the captured colours and draw a soft shadow straight below the object (docs/concepts/light.md)",
    )
    render.set_defaults(run=_render)


def _render(args: argparse.Namespace) -> int:
    from egs_warp.launching import use_device
    from egs_warp.pipelines.finished_world import read_finished
    from egs_warp.pipelines.render_run import Show, render_run

    shot, background = shot_of(args)
    use_device("cpu")
    run = read_finished(args.folder, background=Path(background) if background is not None else None)
    count = render_run(
        run,
        args.out,
        shot,
        show=Show(args.show),
        hold=args.turntable,
        shadow=not args.no_shadow,
        light=not args.no_light,
    )
    print(f"wrote {args.out} ({count} frames)")
    return 0
