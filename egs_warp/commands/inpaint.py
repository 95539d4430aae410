"""``egs-warp inpaint``: fill the hole in the floor under a removed object."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import (
    Commands,
    add_inpainter_flags,
    add_out_flag,
    capture_name,
    chosen_inpainter,
    named_path,
    names_plane_file,
    parse_plane,
    seed,
)
from egs_warp.commands.scene_flags import add_overwrite_flag, start_device
from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.geometry.plane import Plane
    from egs_warp.inpainting.holes import Hole
    from egs_warp.io import Capture

EXAMPLES = (
    "background.ply --plane plane.json --out filled.ply",
    "background.ply --plane plane.json --hole 0,0,0,0.4 --out filled.ply",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    inpaint = commands.add_parser("inpaint", help="fill the hole in the floor under a removed object")
    inpaint.add_argument(
        "background", type=capture_name, help="capture without the object, as segment writes it, in any format"
    )
    inpaint.add_argument("--plane", required=True, help="floor plane: plane.json of plane or segment, or nx,ny,nz,d")
    inpaint.add_argument(
        "--object", help="capture of the object: the hole is its footprint, or that in segment's plane.json"
    )
    inpaint.add_argument(
        "--mask", help="mask.png of the object, or a folder of masks: the hole is the floor behind it in all photos"
    )
    inpaint.add_argument("--cameras", help="cameras of the masks: cameras.json, transforms.json or a COLMAP model")
    inpaint.add_argument("--view", help="name or else number of the camera of a single mask")
    inpaint.add_argument("--hole", help="round hole as x,y,z,radius in scene units")
    add_out_flag(inpaint, "output file for the filled capture, .ply", metavar="FILE")
    inpaint.add_argument(
        "--picture",
        type=named_path,
        help="image of the floor before and after, and of its depth, .png (default: --out with the ending .png)",
    )
    add_overwrite_flag(inpaint, "--out and --picture")
    add_inpainter_flags(inpaint, default="patch")
    inpaint.add_argument(
        "--steps", type=int, help="training steps against the inpainted image (100); 0 needs no PyTorch"
    )
    inpaint.add_argument("--margin", type=float, help="enlargement of the hole, as a fraction of its side (0.01)")
    inpaint.add_argument("--seed", type=seed, default=0, help="seed of the patch search (0)")
    inpaint.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    inpaint.set_defaults(run=_inpaint)


def _inpaint(args: argparse.Namespace) -> int:
    from egs_warp.inpainting.inpaint import InpaintOptions, inpaint
    from egs_warp.inpainting.picture import before_and_after
    from egs_warp.io import read_capture, write_ply
    from egs_warp.io.named_files import check_named_files, named_files
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.progress import scene_bar

    values = {"steps": args.steps, "margin": args.margin, "seed": args.seed}
    options = InpaintOptions(**{name: value for name, value in values.items() if value is not None})
    if args.out.suffix.lower() != ".ply":
        raise UserError(f"--out {args.out}: give the name of a .ply file")
    picture = args.picture or args.out.with_suffix(".png")
    if picture.suffix.lower() != ".png":
        raise UserError(f"--picture {picture}: give the name of a .png file")
    for file in (args.out, picture):
        if not file.parent.is_dir():
            raise UserError(f"{file}: its folder does not exist; create {file.parent} first")
    check_named_files(args.out, picture, overwrite=args.overwrite)
    plane, recorded = _plane(args.plane)
    hole_flags = sum([args.object is not None, args.mask is not None, args.hole is not None])
    if hole_flags > 1 or (hole_flags == 0 and recorded is None):
        raise UserError(
            "inpaint: the hole is not defined; give one of --object, --mask with --cameras, or --hole,"
            " or the plane.json of segment as --plane"
        )
    start_device(args.device)
    inpainter = chosen_inpainter(args, seed=args.seed)
    background = read_capture(args.background, device=args.device)
    hole = _hole(args, plane, recorded, background)
    assert hole is not None, "the flags define a hole"
    with named_files(args.out, picture, overwrite=args.overwrite) as files:
        with scene_bar({"inpaint": 1.0}) as bar:
            painted = lambda done: bar.update("inpaint", done)  # noqa: E731
            result = inpaint(background.cloud, hole, inpainter=inpainter, options=options, progress=painted)
        compared = before_and_after(result)
        files.begin()
        write_ply(args.out, result.cloud)
        write_png(picture, compared)
    for note in (*background.notes, *result.notes):
        print(f"note: {note}")
    print(f"wrote {args.out} and {picture} in {sum(result.seconds.values()):.1f} s")
    return 0


def _plane(text: str) -> tuple[Plane, Hole | None]:
    """Return the plane, and the hole that ``segment`` recorded in its plane.json, if any."""
    if not names_plane_file(text):
        return parse_plane(text), None
    from egs_warp.inpainting.holes import Hole
    from egs_warp.io.planes import read_planes

    known = read_planes(text)[0]
    return known.plane, Hole.of_outline(known.plane, known.hole) if known.hole is not None else None


def _hole(args: argparse.Namespace, plane: Plane, recorded: Hole | None, background: Capture) -> Hole | None:
    """Return the hole that the flags define, or else the ``recorded`` one."""
    import numpy as np

    from egs_warp.commands.scene_input import SELECTION_FLAGS
    from egs_warp.inpainting.holes import disc, footprint, unseen
    from egs_warp.io import read_capture
    from egs_warp.io.cameras import read_posed_images
    from egs_warp.pipelines.object_selection import read_object

    if args.object is not None:
        cloud = read_capture(args.object, device=args.device).cloud_aligned_with(background)
        # The recorded hole may be the hole of another object.
        if recorded is None or not recorded.window.sample(recorded.mask, cloud.means.numpy()).any():
            return footprint(cloud, plane)
        return recorded
    if args.hole is not None:
        try:
            x, y, z, radius = (float(part) for part in args.hole.split(","))
        except ValueError as error:
            raise UserError(f"--hole {args.hole}: give four numbers x,y,z,radius") from error
        return disc(plane, np.array([x, y, z]), radius)
    if args.mask is None:
        return recorded
    if not Path(args.mask).exists():
        raise UserError(f"--mask {args.mask}: no such file or folder; give a PNG file or a folder of PNG files")
    if args.cameras is None:
        raise UserError("--mask: a mask needs its camera; give --cameras")
    poses = read_posed_images(args.cameras).relative_to(background.origin)
    for message in poses.messages:
        print(f"note: {message}")
    spec = read_object(args.mask, background.cloud, poses.images, view=args.view, names=SELECTION_FLAGS)
    return unseen(plane, spec.masks)
