"""Flags of the commands that start from a scene."""

from __future__ import annotations

import argparse
import sys

from egs_warp.commands.flags import named_path


def add_object_flags(parser: argparse._ActionsContainer) -> None:
    """Add the flags that say where the object is."""
    parser.add_argument(
        "--object",
        action="append",
        help="mask.png, folder of masks, point x,y,z, box x0,y0,z0,x1,y1,z1, pixel u,v of --view, or clicks, as many "
        "as needed: +u,v@photo goes along, -u,v@photo does not; salient is what stands out (egs-warp[salient])",
    )
    parser.add_argument(
        "--mask-model",
        type=named_path,
        help="ONNX file of a network that makes masks from the clicks, such as EfficientSAM's (docs/guide/scene.md)",
    )
    parser.add_argument(
        "--cameras", type=named_path, help="cameras.json, transforms.json or COLMAP model; else a ring is used"
    )
    parser.add_argument("--view", help="name or number of the camera that a mask or pixel belongs to")


def add_flat_flag(parser: argparse._ActionsContainer) -> None:
    """Add the flag that keeps to the plane."""
    parser.add_argument(
        "--flat", action="store_true", help="stand on the plane where the ground is not flat; else on it as captured"
    )


def add_overwrite_flag(parser: argparse._ActionsContainer, where: str) -> None:
    """Add the flag that lets an earlier run be moved aside; ``where`` tells of which place."""
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help=f"move an earlier run in {where} aside, into earlier-1, earlier-2, ...",
    )


def add_scene_flags(parser: argparse.ArgumentParser) -> None:
    """Add everything that the commands before the animation share."""
    parser.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog, .glb or an unbundled SOG folder")
    add_object_flags(parser)
    parser.add_argument("--out", required=True, type=named_path, help="folder for the result and its picture")
    add_overwrite_flag(parser, "--out")
    parser.add_argument(
        "--up", help="axis that points roughly up: x, y, z or with a minus, as --up=-y; else it is guessed"
    )
    parser.add_argument("--plane", help="plane.json of an earlier step, or nx,ny,nz,d; else it is found")
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")


def start_device(device: str) -> None:
    """Choose the device; says so where its kernels are still to be compiled, which takes a minute or two."""
    from egs_warp.launching import kernels_are_compiled, use_device

    use_device(device)
    if not kernels_are_compiled():
        print_note("the first run on this machine compiles its kernels on the way, once")


def print_note(text: str) -> None:
    """A line for the user, beside the command's output."""
    print(f"egs-warp: {text}", file=sys.stderr)
