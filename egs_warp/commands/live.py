"""``egs-warp live``: simulate a creature and control it in the browser by keys, clicks and sliders."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import Commands, add_qp_flag, guessed_up, named_path, parse_direction, parse_up
from egs_warp.commands.scene_flags import print_note, start_device

if TYPE_CHECKING:
    from egs_warp.web.server import PageServer
    from egs_warp.web.session import Session

EXAMPLES = (
    "pawn.ply --up z",
    "scan.spz --nodes 150 --friction 0.5",
    "out/scene/object.ply --plane out/scene/plane.json --background out/scene/background.ply",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    live = commands.add_parser("live", help="simulate a creature and control it in the browser")
    live.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog, .glb or an unbundled SOG folder")
    live.add_argument(
        "--out", type=named_path, default=Path("out/live"), help="folder for recorded takes: take-1, ... (out/live)"
    )
    live.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    add_qp_flag(live)
    body = live.add_argument_group("body and ground")
    body.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, as --up=-y (default: estimated)")
    body.add_argument(
        "--plane",
        help="ground plane n.x + d = 0 as nx,ny,nz,d in the capture's units, or a plane.json (default: estimated)",
    )
    body.add_argument(
        "--nodes",
        type=int,
        default=250,
        help="approximate number of cage nodes (250); fewer are faster; animate uses 500",
    )
    body.add_argument("--friction", type=float, default=0.8, help="initial Coulomb friction coefficient (0.8)")
    body.add_argument(
        "--metres-per-unit", type=float, help="scale of the capture (default: such that the body is 1 m tall)"
    )
    body.add_argument("--muscles", type=named_path, help="JSON file with muscle fibres (docs/motions/muscles.md)")
    body.add_argument(
        "--front",
        help="direction in which the body faces and moves: x,y,z or an axis, as --front=-x (default: estimated)",
    )
    page = live.add_argument_group("page")
    page.add_argument("--background", type=named_path, help="background capture, for example background.ply of a run")
    page.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 (default: any free port)")
    page.add_argument("--no-browser", action="store_true", help="print the address, but do not open the browser")
    live.set_defaults(run=_live)


def _live(args: argparse.Namespace) -> int:
    from egs_warp.io import read_capture
    from egs_warp.launching import reserve_core
    from egs_warp.web.feed import LiveFeed
    from egs_warp.web.page import page_text
    from egs_warp.web.server import PageServer, check_port

    # Errors that can be detected before any long work.
    page_text()
    check_port(args.port)
    start_device(args.device)
    background = read_capture(args.background, device=args.device).cloud if args.background is not None else None
    session = _session(args)
    scene = session.creature.placed(background) if background is not None else None
    server = PageServer([], port=args.port, feed=LiveFeed(session, scene=scene))
    with reserve_core():
        _serve(session, server, open_browser=not args.no_browser)
    return 0


def _serve(session: Session, server: PageServer, *, open_browser: bool) -> None:
    """Run the session and its page until Ctrl-C."""
    import webbrowser

    session.start()
    print(f"open {server.address}\nend with Ctrl-C", flush=True)
    if open_browser:
        webbrowser.open(server.address)
    try:
        server.serve()
    finally:
        session.stop()


def _session(args: argparse.Namespace) -> Session:
    """Read the capture, build its creature and return a session that is not started."""
    from egs_warp.commands.scene_input import ground_of, plane_of
    from egs_warp.io import read_capture
    from egs_warp.io.run_folder import check_out
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.locomotion.settings import LocomotionSettings
    from egs_warp.meshing.cage import check_nodes
    from egs_warp.pipelines.creature import CreatureOptions, make_creature
    from egs_warp.pipelines.progress import preparation_bar
    from egs_warp.web.feed import live_render_data
    from egs_warp.web.presplit import presplit_gaussians
    from egs_warp.web.session import Session, SessionOptions

    check_out(args.out)
    check_nodes(args.nodes)
    if args.muscles is not None:
        parse_json(read_text(args.muscles), args.muscles)
    options = CreatureOptions(friction=args.friction, metres_per_unit=args.metres_per_unit)
    up = parse_up(args.up) if args.up is not None else None
    plane = plane_of(args.plane) if args.plane is not None else None
    front = parse_direction("front", args.front) if args.front is not None else None
    capture = read_capture(args.capture, device=args.device)
    if plane is None and up is None:
        up, note = guessed_up(capture)
        print_note(note)
    with preparation_bar() as begins:
        creature = make_creature(
            capture.cloud,
            up=up,
            plane=plane,
            options=replace(
                options,
                ground=ground_of(args.plane, flat=False),
                front=front,
                muscles_file=args.muscles,
                settings=LocomotionSettings(qp_solver=args.qp),
                nodes=args.nodes,
            ),
            progress=begins,
        )
        begins("split")
        drawn_as = live_render_data(creature, presplit_gaussians(creature))
    if front is None:
        print_note(creature.front.description(creature.frame))
    session_options = SessionOptions(source=Path(args.capture).name, takes=args.out, muscles_file=args.muscles)
    return Session(creature, drawn_as, session_options)
