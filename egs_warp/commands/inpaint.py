"""``egs-warp inpaint``: new floor where the object stood."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import Commands, add_inpainter_flags, chosen_inpainter, named_path, parse_plane, seed
from egs_warp.commands.scene_flags import add_overwrite_flag, start_device
from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.geometry.gaussians import GaussianCloud
    from egs_warp.geometry.plane import Plane
    from egs_warp.inpainting.holes import Hole

EXAMPLES = (
    "background.ply --plane plane.json --out filled.ply",
    "background.ply --plane plane.json --hole 0,0,0,0.4 --out filled.ply",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    inpaint = commands.add_parser("inpaint", help="close the hole in the floor that an object leaves")
    inpaint.add_argument("background", help="capture without the object, as segment writes it; any format")
    inpaint.add_argument("--plane", required=True, help="plane.json, as plane writes it, or nx,ny,nz,d")
    inpaint.add_argument(
        "--object", help="capture of the object: the hole is under its foot, as segment's plane.json says"
    )
    inpaint.add_argument("--mask", help="PNG of the object, or a folder of them: the floor that none of them sees")
    inpaint.add_argument("--cameras", help="cameras of the masks: cameras.json, transforms.json, a COLMAP model")
    inpaint.add_argument("--view", help="name or number of the camera of a single mask")
    inpaint.add_argument("--hole", help="x,y,z,radius of a round hole, scene units")
    inpaint.add_argument("--out", required=True, type=named_path, help="filled capture to write, .ply")
    inpaint.add_argument("--picture", type=named_path, help="before, after and depth as PNG (--out with .png)")
    add_overwrite_flag(inpaint, "their place")
    add_inpainter_flags(inpaint, default="patch")
    inpaint.add_argument("--steps", type=int, help="of training against the inpainted picture (100); 0: no PyTorch")
    inpaint.add_argument("--margin", type=float, help="by how much the hole is made larger, of its side (0.01)")
    inpaint.add_argument("--seed", type=seed, default=0, help="of the patch search (0)")
    inpaint.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    inpaint.set_defaults(run=_inpaint)


def _inpaint(chosen: argparse.Namespace) -> int:
    from egs_warp.inpainting.inpaint import InpaintOptions, inpaint
    from egs_warp.inpainting.picture import before_and_after
    from egs_warp.io import read_capture, write_ply
    from egs_warp.io.named_files import check_named_files, named_files
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.progress import scene_bar

    given = {"steps": chosen.steps, "margin": chosen.margin, "seed": chosen.seed}
    options = InpaintOptions(**{name: value for name, value in given.items() if value is not None})
    if chosen.out.suffix.lower() != ".ply":
        raise UserError(f"--out {chosen.out}: give the name of a .ply file")
    picture = chosen.picture or chosen.out.with_suffix(".png")
    if picture.suffix.lower() != ".png":
        raise UserError(f"--picture {picture}: give the name of a .png file")
    for file in (chosen.out, picture):
        if not file.parent.is_dir():
            raise UserError(f"{file}: its folder does not exist; create {file.parent} first")
    check_named_files(chosen.out, picture, overwrite=chosen.overwrite)
    plane, recorded = _plane(chosen.plane)
    said = sum([chosen.object is not None, chosen.mask is not None, chosen.hole is not None])
    if said > 1 or (said == 0 and recorded is None):
        raise UserError(
            "inpaint: say where the hole is by one of --object, --mask with --cameras, or --hole,"
            " or give the plane.json that segment wrote by --plane"
        )
    start_device(chosen.device)
    inpainter = chosen_inpainter(chosen, seed=chosen.seed)
    background = read_capture(chosen.background, device=chosen.device)
    hole = _hole(chosen, plane, recorded, background.cloud)
    assert hole is not None, "one of them was given"
    with named_files(chosen.out, picture, overwrite=chosen.overwrite) as files:
        with scene_bar({"inpaint": options.steps > 0}) as told:
            painted = lambda done: told("inpaint", done)  # noqa: E731
            result = inpaint(background.cloud, hole, inpainter=inpainter, options=options, progress=painted)
        compared = before_and_after(result)
        files.begin()
        write_ply(chosen.out, result.cloud)
        write_png(picture, compared)
    for note in (*background.notes, *result.notes):
        print(f"note: {note}")
    print(f"wrote {chosen.out} and {picture} in {sum(result.seconds.values()):.1f} s")
    return 0


def _plane(text: str) -> tuple[Plane, Hole | None]:
    """The plane, and the hole that ``segment`` found in it, if it did."""
    if not text.lower().endswith(".json"):
        return parse_plane(text), None
    from egs_warp.inpainting.holes import Hole
    from egs_warp.io.planes import read_planes

    known = read_planes(text)[0]
    return known.plane, Hole.of_outline(known.plane, known.hole) if known.hole is not None else None


def _hole(chosen: argparse.Namespace, plane: Plane, recorded: Hole | None, background: GaussianCloud) -> Hole | None:
    import numpy as np

    from egs_warp.commands.object_flag import read_object
    from egs_warp.inpainting.holes import disc, footprint, unseen
    from egs_warp.io import read_cameras, read_capture

    if chosen.object is not None:
        thing = read_capture(chosen.object, device=chosen.device).cloud
        # The hole may be another object's.
        if recorded is None or not recorded.window.sample(recorded.mask, thing.means.numpy()).any():
            return footprint(thing, plane)
        return recorded
    if chosen.hole is not None:
        try:
            x, y, z, radius = (float(part) for part in chosen.hole.split(","))
        except ValueError as error:
            raise UserError(f"--hole {chosen.hole}: give four numbers x,y,z,radius") from error
        return disc(plane, np.array([x, y, z]), radius)
    if chosen.mask is None:
        return recorded
    if not Path(chosen.mask).exists():
        raise UserError(f"--mask {chosen.mask}: no such file or folder; give a PNG or a folder of them")
    if chosen.cameras is None:
        raise UserError("--mask: give the cameras that the masks were painted for by --cameras")
    spec = read_object(chosen.mask, background, read_cameras(chosen.cameras), view=chosen.view)
    return unseen(plane, spec.masks)
