"""``egs-warp live``: a creature in the browser that does what keys, clicks and sliders ask while it lives."""

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
    live = commands.add_parser("live", help="steer a creature in the browser while it lives")
    live.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog, .glb or an unbundled SOG folder")
    live.add_argument(
        "--out", type=named_path, default=Path("out/live"), help="folder for what is recorded: take-1, ... (out/live)"
    )
    live.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    add_qp_flag(live)
    body = live.add_argument_group("body and ground")
    body.add_argument("--up", help="axis that points up: x, y, z or with a minus, as --up=-y; else it is guessed")
    body.add_argument(
        "--plane", help="nx,ny,nz,d of the ground n.x + d = 0 in the capture's units, or a plane.json; else it is found"
    )
    body.add_argument(
        "--nodes", type=int, default=250, help="of the cage, about; fewer are faster, 500 are what animate takes (250)"
    )
    body.add_argument("--friction", type=float, default=0.8, help="Coulomb coefficient to begin with (0.8)")
    body.add_argument("--metres-per-unit", type=float, help="true scale; else the body is 1 m tall")
    body.add_argument("--muscles", type=named_path, help="JSON with fibres (docs/motions/muscles.md)")
    body.add_argument("--front", help="x,y,z or an axis: the way it faces and moves, as --front=-x; else it is guessed")
    page = live.add_argument_group("page")
    page.add_argument("--background", type=named_path, help="capture behind the creature, as background.ply of a run")
    page.add_argument("--port", type=int, default=0, help="of this machine's own address (any that is free)")
    page.add_argument("--no-browser", action="store_true", help="only print the address")
    live.set_defaults(run=_live)


def _live(chosen: argparse.Namespace) -> int:
    from egs_warp.io import read_capture
    from egs_warp.launching import reserve_core
    from egs_warp.web.feed import LiveFeed
    from egs_warp.web.page import page_text
    from egs_warp.web.server import PageServer, check_port

    # What can be told at once, before any long work.
    page_text()
    check_port(chosen.port)
    start_device(chosen.device)
    behind = read_capture(chosen.background, device=chosen.device).cloud if chosen.background is not None else None
    session = _session(chosen)
    scene = session.creature.placed(behind) if behind is not None else None
    server = PageServer([], port=chosen.port, feed=LiveFeed(session, scene=scene))
    with reserve_core():
        _serve(session, server, opens=not chosen.no_browser)
    return 0


def _serve(session: Session, server: PageServer, *, opens: bool) -> None:
    import webbrowser

    session.start()
    print(f"open {server.address}\nend with Ctrl-C", flush=True)
    if opens:
        webbrowser.open(server.address)
    try:
        server.serve()
    finally:
        session.stop()


def _session(chosen: argparse.Namespace) -> Session:
    from egs_warp.commands.scene_input import ground_of, plane_of
    from egs_warp.io import read_capture
    from egs_warp.io.run_folder import check_out
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.locomotion.settings import LocomotionSettings
    from egs_warp.meshing.cage import check_nodes
    from egs_warp.pipelines.creature import CreatureOptions, make_creature
    from egs_warp.pipelines.progress import preparation_bar
    from egs_warp.web.feed import drawn_creature
    from egs_warp.web.presplit import presplit_gaussians
    from egs_warp.web.session import Session, SessionOptions

    check_out(chosen.out)
    check_nodes(chosen.nodes)
    if chosen.muscles is not None:
        parse_json(read_text(chosen.muscles), chosen.muscles)
    options = CreatureOptions(friction=chosen.friction, metres_per_unit=chosen.metres_per_unit)
    up = parse_up(chosen.up) if chosen.up is not None else None
    plane = plane_of(chosen.plane) if chosen.plane is not None else None
    front = parse_direction("front", chosen.front) if chosen.front is not None else None
    capture = read_capture(chosen.capture, device=chosen.device)
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
                ground=ground_of(chosen.plane, flat=False),
                front=front,
                muscles_file=chosen.muscles,
                settings=LocomotionSettings(qp_solver=chosen.qp),
                nodes=chosen.nodes,
            ),
            progress=begins,
        )
        begins("split")
        drawn_as = drawn_creature(creature, presplit_gaussians(creature))
    if front is None:
        print_note(creature.front.told(creature.frame))
    made = SessionOptions(source=Path(chosen.capture).name, takes=chosen.out, muscles_file=chosen.muscles)
    return Session(creature, drawn_as, made)
