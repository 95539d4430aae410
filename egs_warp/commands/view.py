"""``egs-warp view``: show a run in the browser, or write it as one HTML file."""

from __future__ import annotations

import argparse
from pathlib import Path

from egs_warp.commands.flags import Commands, input_path, named_path, run_folder_path
from egs_warp.errors import UserError

EXAMPLES = (
    "out/jump",
    "out/jump out/hop",
    "out/jump --export page.html",
    "out/duel",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    view = commands.add_parser("view", help="show a run in the browser, from any side")
    view.add_argument(
        "runs",
        metavar="run",
        type=run_folder_path,
        nargs="+",
        help="folder that animate wrote; two are shown side by side",
    )
    view.add_argument(
        "--export", type=named_path, help="write one HTML file that needs no server, instead of opening the browser"
    )
    view.add_argument("--background", type=input_path, help="background capture (default: background.ply of the run)")
    view.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 (default: any free port)")
    view.add_argument("--no-browser", action="store_true", help="print the address, but do not open the browser")
    view.set_defaults(run=_view)


def _view(args: argparse.Namespace) -> int:
    from egs_warp.launching import use_device
    from egs_warp.web.page import export_page
    from egs_warp.web.world_recording import read_recording

    folders: list[Path] = args.runs
    if len(folders) > 2:
        raise UserError(f"{folders[2]}: only two runs can be shown side by side; leave this one out")
    use_device("cpu")
    recordings = [read_recording(folder, background=args.background) for folder in folders]
    if args.export is not None:
        size = export_page(args.export, recordings)
        print(f"wrote {args.export} ({size / 1e6:.1f} MB)")
        return 0
    import webbrowser

    from egs_warp.web.server import PageServer

    server = PageServer([recording.bytes for recording in recordings], port=args.port)
    print(f"open {server.address}\nend with Ctrl-C", flush=True)
    if not args.no_browser:
        webbrowser.open(server.address)
    server.serve()
    return 0
