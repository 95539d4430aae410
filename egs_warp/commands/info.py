"""``egs-warp info``: what the program finds in a capture, as text and as a picture."""

from __future__ import annotations

import argparse

from egs_warp.commands.flags import Commands, guessed_up, named_path, parse_direction, parse_up
from egs_warp.commands.scene_flags import print_note, start_device

EXAMPLES = ("pawn.ply", "chair.ply --up=-y --plot info.png", "toy.spz --front 0,0,1 --muscles own.json --plot info.png")


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    info = commands.add_parser("info", help="tell up, front, feet, size, muscles of a capture, and what it can do")
    info.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog, .glb or an unbundled SOG folder")
    info.add_argument("--plot", type=named_path, help="picture (.png) of what was found")
    info.add_argument("--up", help="axis that points up: x, y, z or with a minus, as --up=-y; else it is guessed")
    info.add_argument(
        "--plane", help="nx,ny,nz,d of the ground n.x + d = 0 in the capture's units, or a plane.json; else it is found"
    )
    info.add_argument("--front", help="x,y,z or an axis: the way it faces and moves, as --front=-x; else it is guessed")
    info.add_argument("--metres-per-unit", type=float, help="true scale; else the body is 1 m tall")
    info.add_argument(
        "--muscles",
        type=named_path,
        help="JSON with fibres (docs/motions/muscles.md); else they are made automatically",
    )
    info.set_defaults(run=_info)


def _info(chosen: argparse.Namespace) -> int:
    from egs_warp.commands.scene_input import plane_of
    from egs_warp.errors import UserError
    from egs_warp.io import read_capture
    from egs_warp.pipelines.creature import CreatureOptions
    from egs_warp.pipelines.info import draw_info, inspect_capture
    from egs_warp.pipelines.progress import info_bar

    if chosen.plot is not None and chosen.plot.suffix.lower() != ".png":
        raise UserError(f"--plot {chosen.plot}: give the name of a .png")
    start_device("cpu")
    options = CreatureOptions(metres_per_unit=chosen.metres_per_unit)
    up = parse_up(chosen.up) if chosen.up is not None else None
    plane = plane_of(chosen.plane) if chosen.plane is not None else None
    front = parse_direction("front", chosen.front) if chosen.front is not None else None
    capture = read_capture(chosen.capture)
    notes = capture.notes
    if plane is None and up is None:
        up, note = guessed_up(capture)
        notes = (*notes, note)
    with info_bar() as begins:
        info = inspect_capture(
            capture.cloud,
            source=chosen.capture,
            up=up,
            plane=plane,
            front=front,
            metres_per_unit=options.metres_per_unit,
            muscles_file=chosen.muscles,
            notes=notes,
            progress=begins,
        )
    print("\n".join(info.lines()))
    if chosen.plot is not None:
        draw_info(chosen.plot, info)
        print_note(f"wrote {chosen.plot}")
    return 0
