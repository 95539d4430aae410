"""``egs-warp convert``: write a capture, or a folder of numbered captures, in another format."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import SPLAT_FILES, Commands, named_path, parse_numbers, parse_up
from egs_warp.commands.scene_flags import print_note
from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.pipelines.edit_capture import CaptureEdits

EXAMPLES = (
    "scan.ply scan.spz",
    "scan.ply flat.splat --degree 0",
    "scan.ply scan.spz --to spz4",
    "frames spz_frames --to spz",
    "chair.ply table.ply room.spz --up=-y --scale 0.5",
    "scan.ply small.ply --box=-1,-1,-1,1,1,1 --drop-floaters --count 200000",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    convert = commands.add_parser(
        "convert", help="write a capture in another format, turned, cropped or merged, and report what is lost"
    )
    convert.add_argument(
        "captures",
        metavar="in",
        nargs="+",
        type=named_path,
        help=".ply, compressed .ply, .spz, .splat, .sog, .glb, a SOG folder, or, with --to, a folder of numbered files;"
        " several are merged",
    )
    convert.add_argument(
        "out",
        type=named_path,
        help="output file, .ply, .compressed.ply, .spz (version 3), .sog, .splat or .glb; for numbered files, a folder",
    )
    convert.add_argument(
        "--to", choices=SPLAT_FILES, help="output format, required for numbered files; spz4 is .spz version 4"
    )
    convert.add_argument(
        "--degree", type=int, choices=(0, 1, 2, 3), help="highest degree of spherical harmonics to write (all)"
    )
    edits = convert.add_argument_group("changes, made in this order")
    edits.add_argument("--box", help="keep the Gaussians in the box x0,y0,z0,x1,y1,z1, in the input's units")
    edits.add_argument(
        "--drop-floaters", action="store_true", help="leave out small parts that are connected to nothing"
    )
    edits.add_argument("--up", help="axis of the input that points up: it is turned to +y, as --up=-y")
    edits.add_argument("--rotate", help="turn by x,y,z degrees, about the x axis first, then y, then z")
    edits.add_argument("--scale", type=float, default=1.0, help="multiply all lengths by this factor")
    edits.add_argument("--translate", help="move by x,y,z")
    edits.add_argument("--count", type=int, help="merge neighbours until this number of Gaussians is left")
    convert.set_defaults(run=_convert)


def _convert(args: argparse.Namespace) -> int:
    with ExitStack() as stack:
        return _convert_files(args, stack)


def _convert_files(args: argparse.Namespace, stack: ExitStack) -> int:
    """Convert the files. The context ``stack`` removes a newly created folder if nothing could be written into it."""
    from tqdm import tqdm

    from egs_warp.geometry.gaussians import with_degree
    from egs_warp.io import read_capture
    from egs_warp.io.atomic import result_folder
    from egs_warp.io.conversion_loss import conversion_loss
    from egs_warp.io.limits import missing_error
    from egs_warp.io.run_folder import check_no_file_of_a_run
    from egs_warp.io.sequence import numbered_captures
    from egs_warp.io.writing import WRITERS, capture_stem, is_capture_name, writer_of
    from egs_warp.launching import use_device
    from egs_warp.pipelines.edit_capture import edit_capture, merge_captures
    from egs_warp.pipelines.progress import conversion_bar

    edits = _edits(args)
    first = args.captures[0]
    if args.to is not None and not os.path.lexists(first):
        raise missing_error(first)
    if args.to is None or first.is_file() or len(args.captures) > 1:
        write = writer_of(args.out, kind=args.to)
        # Check this before reading a capture, which may take long.
        if not args.out.absolute().parent.is_dir():
            raise UserError(f"{args.out}: its folder does not exist; create {args.out.parent} first")
        if args.out.exists() and any(source.exists() and args.out.samefile(source) for source in args.captures):
            raise UserError(f"{args.out}: is the input file; give another name")
        check_no_file_of_a_run(args.out)
        jobs = [(args.captures, args.out)]
    else:
        write = WRITERS[args.to]
        sources = numbered_captures(first)
        if args.out.exists() and args.out.samefile(first):
            raise UserError(f"{args.out}: is the input folder; give another one")
        if is_capture_name(args.out) and not args.out.is_dir():
            raise UserError(f"{args.out}: several files are written; give the name of a folder")
        folder = stack.enter_context(result_folder(args.out))
        jobs = [([source], folder / f"{capture_stem(source)}{write.ending}") for source in sources]
    use_device("cpu")
    lines: list[str] = []
    sources_of: dict[str, list[Path]] = {}
    for sources, target in tqdm(jobs, desc="convert", unit="file", disable=len(jobs) == 1, file=sys.stderr):
        capture = merge_captures([read_capture(source) for source in sources])
        capture, changes = edit_capture(capture, edits)
        with conversion_bar(target.name, quiet=len(jobs) > 1) as begins:
            begins("write")
            order = write(target, with_degree(capture.cloud, args.degree), origin=capture.origin)
            for note in capture.notes:
                sources_of.setdefault(note, []).append(sources[0])
            if not lines:
                begins("compare")
                origin = write.stored_origin(capture.origin)
                lines = [*changes, *conversion_loss(capture, read_capture(target), order, origin=origin)]
    for note, noted in sources_of.items():
        # The notes of merged captures already name their files.
        name = "" if len(args.captures) > 1 else f"{noted[0]}: "
        others = f" (and {len(noted) - 1} more of the files)" if len(noted) > 1 else ""
        print_note(f"{name}{note}{others}")
    size = sum(_size(target) for _, target in jobs)
    input_size = sum(_size(source) for sources, _ in jobs for source in sources)
    names = str(jobs[0][1]) if len(jobs) == 1 else f"{jobs[0][1]} to {jobs[-1][1].name}"
    print(f"wrote {names} ({size / 1e6:.2f} MB from {input_size / 1e6:.2f} MB)")
    for line in lines:
        print(f"  {line}" if len(jobs) == 1 else f"  first file: {line}")
    return 0


def _edits(args: argparse.Namespace) -> CaptureEdits:
    from egs_warp.pipelines.edit_capture import CaptureEdits

    box = None if args.box is None else parse_numbers("box", args.box, 6).reshape(2, 3)
    return CaptureEdits(
        box=box,
        drop_floaters=args.drop_floaters,
        up=None if args.up is None else parse_up(args.up),
        rotation=None if args.rotate is None else parse_numbers("rotate", args.rotate, 3),
        scale=args.scale,
        translation=None if args.translate is None else parse_numbers("translate", args.translate, 3),
        count=args.count,
    )


def _size(path: Path) -> int:
    """Return the size of a file, or of all files of a folder, in bytes."""
    return (
        sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.is_dir() else path.stat().st_size
    )
