"""``egs-warp convert``: write a capture, or a folder of numbered captures, in another format."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from pathlib import Path

from egs_warp.commands.flags import SPLAT_FILES, Commands, named_path
from egs_warp.commands.scene_flags import print_note
from egs_warp.errors import UserError

EXAMPLES = (
    "scan.ply scan.spz",
    "scan.ply flat.splat --degree 0",
    "scan.ply scan.spz --to spz4",
    "frames spz_frames --to spz",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    convert = commands.add_parser("convert", help="write a capture in another format, and report what is lost")
    convert.add_argument(
        "capture",
        metavar="in",
        type=named_path,
        help=".ply, compressed .ply, .spz, .splat, .sog, .glb, a SOG folder, or, with --to, a folder of numbered files",
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
    convert.set_defaults(run=_convert)


def _convert(args: argparse.Namespace) -> int:
    with ExitStack() as stack:
        return _convert_files(args, stack)


def _convert_files(args: argparse.Namespace, stack: ExitStack) -> int:
    """Convert the files; ``stack`` removes a new folder in which nothing could be written."""
    from tqdm import tqdm

    from egs_warp.geometry.gaussians import with_degree
    from egs_warp.io import read_capture
    from egs_warp.io.atomic import result_folder
    from egs_warp.io.conversion_loss import conversion_loss
    from egs_warp.io.limits import missing_error
    from egs_warp.io.run_folder import check_no_file_of_a_run
    from egs_warp.io.sequence import numbered_captures
    from egs_warp.io.writing import WRITERS, is_capture_name, writer_of
    from egs_warp.launching import use_device
    from egs_warp.pipelines.progress import conversion_bar

    if args.to is not None and not os.path.lexists(args.capture):
        raise missing_error(args.capture)
    if args.to is None or args.capture.is_file():
        write = writer_of(args.out, kind=args.to)
        # Checked before a capture is read, which may take long.
        if not args.out.absolute().parent.is_dir():
            raise UserError(f"{args.out}: its folder does not exist; create {args.out.parent} first")
        if args.out.exists() and args.capture.exists() and args.out.samefile(args.capture):
            raise UserError(f"{args.out}: is the input file; give another name")
        check_no_file_of_a_run(args.out)
        pairs = [(args.capture, args.out)]
    else:
        ending, write = WRITERS[args.to]
        sources = numbered_captures(args.capture)
        if args.out.exists() and args.out.samefile(args.capture):
            raise UserError(f"{args.out}: is the input folder; give another one")
        if is_capture_name(args.out) and not args.out.is_dir():
            raise UserError(f"{args.out}: several files are written; give the name of a folder")
        folder = stack.enter_context(result_folder(args.out))
        pairs = [(source, folder / f"{source.name.split('.')[0]}{ending}") for source in sources]
    use_device("cpu")
    losses: list[str] = []
    notes: list[str] = []
    for source, target in tqdm(pairs, desc="convert", unit="file", disable=len(pairs) == 1, file=sys.stderr):
        before = read_capture(source)
        with conversion_bar(target.name, quiet=len(pairs) > 1) as begins:
            begins("write")
            write(target, with_degree(before.cloud, args.degree))
            if not losses:
                notes = [f"{source}: {note}" for note in before.notes]
                begins("compare")
                losses = conversion_loss(before, read_capture(target))
    for note in notes:
        print_note(note)
    size, input_size = (sum(_size(pair[k]) for pair in pairs) for k in (1, 0))
    names = str(pairs[0][1]) if len(pairs) == 1 else f"{pairs[0][1]} to {pairs[-1][1].name}"
    print(f"wrote {names} ({size / 1e6:.2f} MB from {input_size / 1e6:.2f} MB)")
    for line in losses:
        print(f"  {line}" if len(pairs) == 1 else f"  first file: {line}")
    return 0


def _size(path: Path) -> int:
    """Return the size of a file, or of all files of a folder, in bytes."""
    return (
        sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.is_dir() else path.stat().st_size
    )
