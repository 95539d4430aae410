"""``egs-warp export``: a run as files that other tools open."""

from __future__ import annotations

import argparse

from egs_warp.commands.flags import SPLAT_FILES, Commands, named_path
from egs_warp.errors import UserError

EXAMPLES = (
    "out/jump --to ply --out frames --every 2",
    "out/jump --to usd --out jump.usdc",
    "out/jump --to bundle --out jump.npz",
    "out/jump --to glb --out still --frame 40",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    export = commands.add_parser("export", help="write a run for other tools: splat files, glTF, USD")
    export.add_argument("folder", metavar="run", type=named_path, help="folder that animate wrote")
    export.add_argument(
        "--to",
        required=True,
        choices=(*SPLAT_FILES, "usd", "bundle"),
        help="numbered splat files, one USD stage, or one .npz",
    )
    export.add_argument(
        "--out", required=True, type=named_path, help="folder of numbered files; .usdc or .usda of usd, .npz of bundle"
    )
    export.add_argument("--every", type=int, default=1, help="so many frames at 60 Hz one is written (1)")
    export.add_argument("--frame", type=int, help="this one alone, from 0; -1 is the last; not of usd and bundle")
    export.add_argument("--degree", type=int, choices=(0, 1, 2, 3), help="bands of colour to keep (all)")
    export.set_defaults(run=_export)


def _export(chosen: argparse.Namespace) -> int:
    from egs_warp.launching import use_device
    from egs_warp.pipelines.bundle import export_bundle
    from egs_warp.pipelines.export import export_splats
    from egs_warp.pipelines.finished_run import FinishedRun
    from egs_warp.pipelines.usd import export_usd

    if chosen.to in ("usd", "bundle") and chosen.frame is not None:
        what = "USD stage" if chosen.to == "usd" else "bundle"
        raise UserError(f"--frame: a {what} holds all frames; leave it out, or give --every")
    use_device("cpu")
    run = FinishedRun.read(chosen.folder)
    if chosen.to == "usd":
        export_usd(run, chosen.out, every=chosen.every, degree=chosen.degree)
        paths = [chosen.out]
    elif chosen.to == "bundle":
        export_bundle(run, chosen.out, every=chosen.every, degree=chosen.degree)
        paths = [chosen.out]
    else:
        paths = export_splats(run, chosen.out, chosen.to, frame=chosen.frame, every=chosen.every, degree=chosen.degree)
    size = sum(path.stat().st_size for path in paths)
    named = str(paths[0]) if len(paths) == 1 else f"{paths[0]} to {paths[-1].name}"
    print(f"wrote {named} ({size / 1e6:.1f} MB)")
    return 0
