"""``egs-warp muscles``: draw the muscle fibres of a body."""

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
from egs_warp.commands.scene_flags import print_note, print_notes, start_device

EXAMPLES = ("pawn.ply --plot muscles.png",)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    muscles = commands.add_parser("muscles", help="draw the muscles of a body, automatic ones or your own")
    add_capture(muscles)
    muscles.add_argument(
        "--plot",
        required=True,
        type=named_path,
        help="image (.png, .jpg, ...) that shows the body from the front, its left and above",
    )
    muscles.add_argument(
        "--muscles",
        type=input_path,
        help="JSON file with muscle fibres (docs/motions/muscles.md; default: placed automatically)",
    )
    muscles.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, as --up=-y (default: estimated)")
    muscles.add_argument(
        "--plane",
        help="ground plane n.x + d = 0 as nx,ny,nz,d in the capture's units, or a plane.json (default: estimated)",
    )
    muscles.add_argument(
        "--front", help="direction in which the body faces: x,y,z or an axis, as --front=-x (default: estimated)"
    )
    muscles.set_defaults(run=_muscles)


def _muscles(args: argparse.Namespace) -> int:
    from egs_warp.commands.scene_input import plane_of
    from egs_warp.fem.body import make_body
    from egs_warp.geometry.body_frame import GROUND
    from egs_warp.io import read_capture
    from egs_warp.muscles.plot import check_picture_name, plot_muscles
    from egs_warp.pipelines.balance import own_muscles_notes
    from egs_warp.pipelines.creature import body_muscles
    from egs_warp.pipelines.placed_cage import check_front, choose_front, place_cage
    from egs_warp.pipelines.progress import info_bar

    start_device("cpu")
    check_picture_name(args.plot)
    up = parse_up(args.up) if args.up else None
    plane = plane_of(args.plane) if args.plane else None
    front = parse_direction("front", args.front) if args.front is not None else None
    capture = read_capture(args.capture)
    print_notes(capture.notes)
    if plane is None and up is None:
        up, note = guessed_up(capture)
        print_note(note)
    normal = plane.normal if plane is not None else up
    if front is not None and normal is not None:
        check_front(normal, front)
    with info_bar(checks_balance=args.muscles is not None) as begins:
        begins("cage")
        standing = place_cage(capture.cloud, up=up, plane=plane)
        begins("front")
        facing = choose_front(standing, front)
        begins("muscles")
        body = make_body(standing.cage.mesh, GROUND)
        muscles = body_muscles(body, args.muscles, standing.frame)
        notes = ()
        if args.muscles is not None:
            begins("balance")
            notes = own_muscles_notes(capture.cloud, standing, facing, args.muscles)
    plot_muscles(body.mesh, muscles, args.plot, up=GROUND.normal, front=facing.direction)
    if front is None:
        print_note(facing.description(standing.frame))
    print_notes(notes)
    print(f"{muscles.fibre_count} fibres, {muscles.segment_count} segments; wrote {args.plot}")
    return 0
