"""``egs-warp segment``: an object and the rest of a scene, apart."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import Commands
from egs_warp.commands.scene_flags import add_flat_flag, add_scene_flags, print_note

if TYPE_CHECKING:
    from egs_warp.segmentation.clearance import StraddlingPolicy

_WRITES = ("object.ply", "background.ply", "plane.json", "segment.png")
EXAMPLES = (
    "room.ply --object 0,0,0.5 --out out/segment",
    "room.ply --object masks --cameras cameras.json --out out/segment",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    segment = commands.add_parser("segment", help="take an object out of a scene")
    add_scene_flags(segment)
    add_straddling_flag(segment)
    add_flat_flag(segment)
    segment.set_defaults(run=_segment)


def add_straddling_flag(parser: argparse._ActionsContainer) -> None:
    """Add the flag that ``clearing_of`` reads."""
    parser.add_argument(
        "--straddling",
        choices=("finetune", "split", "remove", "none"),
        help="Gaussians across the plane: finetune them clear of it (default, needs PyTorch), split, remove, none",
    )


def clearing_of(chosen: argparse.Namespace) -> StraddlingPolicy | None:
    """What ``--straddling`` asks for; None without it."""
    from egs_warp.segmentation.clearance import StraddlingPolicy

    return StraddlingPolicy(chosen.straddling) if chosen.straddling else None


def _segment(chosen: argparse.Namespace) -> int:
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.errors import UserError
    from egs_warp.io.planes import read_planes
    from egs_warp.io.run_folder import check_run_folder, run_folder
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.pictures import picture_cameras, segmentation_picture
    from egs_warp.pipelines.prepare_scene import SceneOptions
    from egs_warp.pipelines.segmentation_warnings import segmentation_warnings

    if not chosen.object:
        raise UserError("segment: give --object: a mask, a point, a box or a pixel")
    check_run_folder(chosen.out, overwrite=chosen.overwrite, writes=_WRITES)
    given = read_scene(chosen)
    known = read_planes(chosen.plane) if chosen.plane and Path(chosen.plane).is_file() else []
    with run_folder(chosen.out, command="segment", overwrite=chosen.overwrite) as run:
        scene = given.prepared(SceneOptions(clearing=clearing_of(chosen), flat=chosen.flat, inpaint=False))
        for note in (*given.notes, *scene.notes):
            print_note(note)
        scene.write(run, known)
        cameras = picture_cameras(scene.plane, scene.located.centre, scene.located.size, given.cameras)
        words = segmentation_warnings(given.cloud, scene.located, scene.object, cameras)
        for line in words:
            print_note(f"the object {line}")
        picture = segmentation_picture(given.cloud, scene.object, scene.background, cameras, words)
        write_png(run.file("segment.png"), picture)
        run.finish()
    print(f"object: {scene.object.count} Gaussians, background: {scene.background.count}")
    print(f"wrote object.ply, background.ply, plane.json, segment.png into {chosen.out}")
    return 0
