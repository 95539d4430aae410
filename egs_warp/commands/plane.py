"""``egs-warp plane``: find the plane that the object of a scene rests on."""

from __future__ import annotations

import argparse

from egs_warp.commands.flags import Commands
from egs_warp.commands.scene_flags import add_scene_flags, print_notes

EXAMPLES = (
    "room.ply --object 0,0,0.5 --out out/plane",
    "room.ply --plane-mask masks --cameras cameras.json --out out/plane",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    plane = commands.add_parser("plane", help="find the plane that an object of a scene rests on")
    add_scene_flags(plane)
    plane.add_argument(
        "--plane-mask",
        help="mask.png of the ground, or a folder of masks: fit the plane to these pixels; needs --cameras",
    )
    plane.add_argument(
        "--count",
        type=int,
        default=1,
        help="number of planes to list (1): the one under the object, then the widest parallel ones",
    )
    plane.set_defaults(run=_plane)


def _writes(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the names of the files that the command writes."""
    ring = () if args.cameras else ("images", "cameras.json")
    return ("plane.json", "plane.png", *ring)


def _plane(args: argparse.Namespace) -> int:
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.commands.scene_planes import planes_of_scene, write_ring
    from egs_warp.errors import UserError
    from egs_warp.io.run_folder import check_run_folder, run_folder
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.pictures import picture_cameras, plane_picture
    from egs_warp.pipelines.progress import scene_bar

    if not (args.object or args.plane_mask):
        raise UserError("plane: give --object, or --plane-mask with --cameras")
    if args.count < 1:
        raise UserError(f"--count {args.count}: give a whole number of at least 1")
    check_run_folder(args.out, overwrite=args.overwrite, writes=_writes(args))
    scene = read_scene(args)
    with run_folder(args.out, command="plane", overwrite=args.overwrite) as run:
        with scene_bar({"plane": 1.0}) as bar:
            bar.update("plane")
            result = planes_of_scene(scene, plane_mask=args.plane_mask, view=args.view, count=args.count)
        print_notes((*scene.notes, *result.notes), details=True)
        cameras = picture_cameras(result.planes[0], result.centre, result.size, scene.cameras)
        picture = plane_picture(scene.cloud, result.planes, cameras, centre=result.centre, size=result.size)
        result.write(run.file("plane.json"))
        write_png(run.file("plane.png"), picture)
        wrote = "plane.json and plane.png"
        if not scene.posed:
            write_ring(run, scene.cloud, result.planes[0], result.centre, result.size)
            wrote += ", with cameras.json and images/ for masks,"
        run.finish()
    first = result.planes[0]
    print("plane: " + ",".join(f"{x:.6g}" for x in (*first.normal, first.offset)))
    print(f"wrote {wrote} to {args.out}")
    return 0
