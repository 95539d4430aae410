"""``egs-warp segment``: separate an object from the rest of a scene."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import Commands
from egs_warp.commands.scene_flags import add_flat_flag, add_scene_flags, print_notes
from egs_warp.notes import Problem

if TYPE_CHECKING:
    from egs_warp.segmentation.clearance import StraddlingPolicy

_WRITES = ("object.ply", "background.ply", "plane.json", "segment.png")
EXAMPLES = (
    "room.ply --object 0,0,0.5 --out out/segment",
    "room.ply --object masks --cameras cameras.json --out out/segment",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    segment = commands.add_parser("segment", help="separate an object from the rest of a scene")
    add_scene_flags(segment)
    add_straddling_flag(segment)
    add_flat_flag(segment)
    segment.set_defaults(run=_segment)


def add_straddling_flag(parser: argparse._ActionsContainer) -> None:
    """Add the flag that ``clearing_of`` reads."""
    parser.add_argument(
        "--straddling",
        choices=("finetune", "split", "remove", "none"),
        help="treatment of the object's Gaussians that cross the plane: finetune (default, needs PyTorch), split, "
        "remove, none",
    )


def clearing_of(args: argparse.Namespace) -> StraddlingPolicy | None:
    """Return the policy of ``--straddling``; None without that flag."""
    from egs_warp.segmentation.clearance import StraddlingPolicy

    return StraddlingPolicy(args.straddling) if args.straddling else None


def _segment(args: argparse.Namespace) -> int:
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.errors import UserError
    from egs_warp.io.planes import read_planes
    from egs_warp.io.run_folder import check_run_folder, run_folder
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.pictures import picture_cameras, segmentation_picture
    from egs_warp.pipelines.prepare_scene import SceneOptions
    from egs_warp.pipelines.segmentation_warnings import segmentation_warnings

    if not args.object:
        raise UserError("segment: give --object: a mask, a point, a box, a pixel or clicks")
    check_run_folder(args.out, overwrite=args.overwrite, writes=_WRITES)
    scene_input = read_scene(args)
    known = read_planes(args.plane) if args.plane and Path(args.plane).is_file() else []
    with run_folder(args.out, command="segment", overwrite=args.overwrite) as run:
        scene = scene_input.prepared(SceneOptions(clearing=clearing_of(args), flat=args.flat, inpaint=False))
        scene.write(run, known)
        cameras = picture_cameras(scene.plane, scene.located.centre, scene.located.size, scene_input.cameras)
        warnings = segmentation_warnings(scene_input.cloud, scene.located, scene.object, cameras)
        problems = (Problem(f"the object {warning}") for warning in warnings)
        print_notes((*scene_input.notes, *scene.notes, *problems), details=True)
        picture = segmentation_picture(scene_input.cloud, scene.object, scene.background, cameras, warnings)
        write_png(run.file("segment.png"), picture)
        run.finish()
    print(f"object: {scene.object.count} Gaussians, background: {scene.background.count}")
    print(f"wrote object.ply, background.ply, plane.json and segment.png to {args.out}")
    return 0
