"""``egs-warp export``: write a run as files for other tools."""

from __future__ import annotations

import argparse

from egs_warp.commands.flags import SPLAT_FILES, Commands, add_out_flag, named_path, run_folder_path
from egs_warp.commands.scene_flags import print_note
from egs_warp.errors import UserError

EXAMPLES = (
    "out/jump --to ply --out frames --every 2",
    "out/jump --to usd --out jump.usdc",
    "out/jump --to bundle --out jump.egs",
    "out/jump --to skin --out jump.glb",
    "out/jump --to glb --out still.glb --frame 40",
    "out/duel --to bundle --out duel.egs",
)
_WITHOUT_ANTIALIASING = ("splat", "usd")
"""Formats that cannot record that a capture was trained with antialiasing."""


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    export = commands.add_parser("export", help="write a run for other tools: splat files, glTF, USD")
    export.add_argument("folder", metavar="run", type=run_folder_path, help="folder that animate wrote")
    export.add_argument(
        "--to",
        required=True,
        choices=(*SPLAT_FILES, "usd", "bundle", "skin"),
        help="output format: numbered splat files, one USD stage (usd), one .egs file (bundle), or a mesh in glTF that "
        "the cage moves (skin)",
    )
    add_out_flag(
        export,
        "folder for numbered files, or a file for a single --frame; a .usdc or .usda file for usd; an .egs file "
        "for bundle; a .glb file for skin",
    )
    export.add_argument("--every", type=int, default=1, metavar="N", help="write every N-th frame of the 60 Hz run (1)")
    export.add_argument(
        "--frame", type=int, help="write only this frame, counted from 0, -1 is the last; not for usd, bundle and skin"
    )
    export.add_argument(
        "--degree", type=int, choices=(0, 1, 2, 3), help="highest degree of spherical harmonics to write (all)"
    )
    export.add_argument("--licence", default="", metavar="TEXT", help="licence of the capture, which a bundle states")
    export.add_argument(
        "--mesh",
        type=named_path,
        help="triangles to move in a skin, in the capture's frame and units (the cage's surface)",
    )
    export.set_defaults(run=_export)


def _export(args: argparse.Namespace) -> int:
    from egs_warp.launching import use_device
    from egs_warp.pipelines.bundle import export_bundle
    from egs_warp.pipelines.export import export_splats
    from egs_warp.pipelines.finished_world import FinishedWorld, read_finished
    from egs_warp.pipelines.skin import export_skin
    from egs_warp.pipelines.usd import export_usd

    if args.to in ("usd", "bundle", "skin") and args.frame is not None:
        format_name = "USD stage" if args.to == "usd" else args.to
        raise UserError(f"--frame: a {format_name} contains all frames; leave --frame out, or give --every")
    if args.licence and args.to != "bundle":
        raise UserError("--licence: only a bundle states a licence; leave --licence out")
    if args.mesh is not None and args.to != "skin":
        raise UserError("--mesh: only a skin moves a mesh; leave --mesh out, or give --to skin")
    if args.to == "glb" and args.frame is None and args.out.suffix.lower() in (".glb", ".gltf"):
        raise UserError(
            f"--out {args.out}: --to glb writes the splats of each frame to a file of its own; give a folder, or one"
            " frame with --frame; --to skin writes the whole motion as one .glb, in which a mesh moves"
        )
    use_device("cpu")
    run = read_finished(args.folder)
    if args.to == "usd":
        export_usd(run, args.out, every=args.every, degree=args.degree, announce=_announce)
        paths = [args.out]
    elif args.to == "bundle":
        export_bundle(run, args.out, every=args.every, degree=args.degree, licence=args.licence)
        paths = [args.out]
    elif args.to == "skin":
        if isinstance(run, FinishedWorld):
            body = args.folder / next(iter(run.bodies))
            raise UserError(f"--to skin: a skin has one body; export the folder of a body, such as {body}")
        export_skin(run, args.out, every=args.every, mesh=args.mesh)
        paths = [args.out]
    else:
        paths = export_splats(
            run, args.out, args.to, frame=args.frame, every=args.every, degree=args.degree, announce=_announce
        )
    if run.antialiased and args.to in _WITHOUT_ANTIALIASING:
        print_note(
            f"the capture was trained with antialiasing, which {args.to} files cannot record; turn it on in the viewer"
        )
    size = sum(path.stat().st_size for path in paths)
    named = str(paths[0]) if len(paths) == 1 else f"{paths[0]} to {paths[-1].name}"
    print(f"wrote {named} ({size / 1e6:.1f} MB)")
    return 0


def _announce(size: int) -> None:
    print_note(f"the frames take about {size / 1e6:.0f} MB; --every and --degree reduce the size")
