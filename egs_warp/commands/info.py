"""``egs-warp info``: report what the program detects in a capture, as text and as an image."""

from __future__ import annotations

import argparse

from egs_warp.commands.flags import (
    Commands,
    add_capture,
    guessed_up,
    input_path,
    named_path,
    parse_direction,
    parse_up,
)
from egs_warp.commands.scene_flags import add_object_flags, check_no_scene_flags, print_note, start_device

EXAMPLES = (
    "pawn.ply",
    "chair.ply --up=-y --plot info.png",
    "toy.spz --front 0,0,1 --muscles own.json --plot info.png",
    "room.ply --object picked.json",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    info = commands.add_parser(
        "info", help="report the up direction, front, feet, size, muscles and possible motions of a capture"
    )
    add_capture(info)
    info.add_argument("--plot", type=named_path, help="image (.png) of the detected frame, feet and muscles")
    info.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, such as --up=-y (default: estimated)")
    info.add_argument(
        "--plane",
        help="ground plane n.x + d = 0 as nx,ny,nz,d in the capture's units, or a plane.json (default: estimated)",
    )
    info.add_argument(
        "--front",
        help="direction in which the body faces and moves: x,y,z or an axis, such as --front=-x (default: estimated)",
    )
    add_object_flags(info)
    info.add_argument(
        "--metres-per-unit", type=float, help="scale of the capture (default: such that the body is 1 m tall)"
    )
    info.add_argument(
        "--muscles",
        type=input_path,
        help="JSON file with muscle fibres (docs/motions/muscles.md; default: placed automatically)",
    )
    info.set_defaults(run=_info, device="cpu")


def _info(args: argparse.Namespace) -> int:
    from egs_warp.commands.scene_hint import scene_notes
    from egs_warp.commands.scene_input import SceneInput, plane_of, read_scene
    from egs_warp.errors import UserError
    from egs_warp.io import read_capture
    from egs_warp.pipelines.creature import CreatureOptions
    from egs_warp.pipelines.info import CaptureExtent, draw_info, inspect_capture
    from egs_warp.pipelines.locate_plane import locate_plane
    from egs_warp.pipelines.progress import info_bar

    if args.plot is not None and args.plot.suffix.lower() != ".png":
        raise UserError(f"--plot {args.plot}: give a file name that ends in .png")
    start_device("cpu")
    options = CreatureOptions(metres_per_unit=args.metres_per_unit)
    front = parse_direction("front", args.front) if args.front is not None else None
    if args.object is None:
        check_no_scene_flags(args)
    up = parse_up(args.up) if args.up is not None else None
    plane = plane_of(args.plane) if args.plane is not None else None
    source = read_capture(args.capture) if args.object is None else read_scene(args)
    cloud, notes = source.cloud, source.notes
    capture = CaptureExtent.of(cloud, args.capture)
    try:
        if isinstance(source, SceneInput):
            located = locate_plane(cloud, source.object, cameras=source.cameras, up=source.up, plane=source.plane)
            cloud, up, plane = cloud.subset(located.segmentation.object_mask), None, located.plane
            front = front if front is not None else source.front
            notes = (*notes, *located.notes)
        else:
            if plane is None and up is None:
                up, note = guessed_up(source)
                notes = (*notes, note)
            notes = (*notes, *scene_notes(cloud, plane.normal if plane is not None else up))
        with info_bar(checks_balance=args.muscles is not None) as begins:
            info = inspect_capture(
                cloud,
                capture=capture,
                up=up,
                plane=plane,
                front=front,
                metres_per_unit=options.metres_per_unit,
                muscles_file=args.muscles,
                notes=notes,
                progress=begins,
            )
    except UserError:
        # The extent helps to find a point on an object of a capture that is refused as a body.
        print("\n".join(capture.lines()), flush=True)
        raise
    print("\n".join(info.lines()))
    if args.plot is not None:
        draw_info(args.plot, info)
        print_note(f"wrote {args.plot}")
    return 0
