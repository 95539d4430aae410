"""``egs-warp plane``: what the object rests on."""

from __future__ import annotations

import argparse

from egs_warp.commands.flags import Commands
from egs_warp.commands.scene_flags import add_scene_flags, print_note

EXAMPLES = ("room.ply --out out/plane",)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    plane = commands.add_parser("plane", help="find the plane that an object of a scene rests on")
    add_scene_flags(plane)
    plane.add_argument("--plane-mask", help="mask.png or folder: the plane is fitted to what these masks show")
    plane.add_argument(
        "--count", type=int, default=1, help="planes to list: that one, then the widest level with it (1)"
    )
    plane.set_defaults(run=_plane)


def _writes(chosen: argparse.Namespace) -> tuple[str, ...]:
    ring = () if chosen.cameras else ("images", "cameras.json")
    return ("plane.json", "plane.png", *ring)


def _plane(chosen: argparse.Namespace) -> int:
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.commands.scene_planes import planes_of_scene, write_ring
    from egs_warp.errors import UserError
    from egs_warp.io.run_folder import check_run_folder, run_folder
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.pictures import picture_cameras, plane_picture
    from egs_warp.pipelines.progress import scene_bar

    if not (chosen.object or chosen.plane_mask):
        raise UserError("plane: give --object, or --plane-mask with --cameras")
    if chosen.count < 1:
        raise UserError(f"--count {chosen.count}: give a whole number of at least 1")
    check_run_folder(chosen.out, overwrite=chosen.overwrite, writes=_writes(chosen))
    given = read_scene(chosen)
    with run_folder(chosen.out, command="plane", overwrite=chosen.overwrite) as run:
        with scene_bar({"plane": True}) as told:
            told("plane", 0.0)
            found = planes_of_scene(given, plane_mask=chosen.plane_mask, view=chosen.view, count=chosen.count)
        for note in (*given.notes, *found.notes):
            print_note(note)
        cameras = picture_cameras(found.planes[0], found.centre, found.size, given.cameras)
        picture = plane_picture(given.cloud, found.planes, cameras, centre=found.centre, size=found.size)
        found.write(run.file("plane.json"))
        write_png(run.file("plane.png"), picture)
        wrote = "plane.json, plane.png"
        if not given.posed:
            write_ring(run, given.cloud, found.planes[0], found.centre, found.size)
            wrote += ", cameras.json and images/ for a segmenter"
        run.finish()
    first = found.planes[0]
    print("plane: " + ",".join(f"{x:.6g}" for x in (*first.normal, first.offset)))
    print(f"wrote {wrote} into {chosen.out}")
    return 0
