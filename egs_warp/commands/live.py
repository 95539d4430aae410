"""``egs-warp live``: simulate a creature and control it in the browser with keys, clicks and sliders."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.animate_world import is_world
from egs_warp.commands.flags import (
    Commands,
    add_out_flag,
    add_planning_flags,
    capture_name,
    guessed_up,
    input_path,
    parse_direction,
    parse_up,
)
from egs_warp.commands.live_world import live_world, wait_for_end
from egs_warp.commands.scene_flags import add_object_flags, check_no_scene_flags, print_note, print_notes, start_device

if TYPE_CHECKING:
    import numpy as np

    from egs_warp.commands.scene_input import SceneInput
    from egs_warp.geometry.gaussians import GaussianCloud
    from egs_warp.geometry.height_field import HeightField
    from egs_warp.geometry.main_light import MainLight
    from egs_warp.geometry.plane import Plane
    from egs_warp.web.preview import PreviewFeed
    from egs_warp.web.session import Session

EXAMPLES = (
    "pawn.ply --up z",
    "scan.spz --nodes 150 --friction 0.5",
    "out/scene/object.ply --plane out/scene/plane.json --background out/scene/background.ply",
    "room.ply --object picked.json",
    "duel.yaml",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    live = commands.add_parser("live", help="simulate a creature and control it in the browser")
    live.add_argument(
        "capture",
        type=capture_name,
        help=".ply, compressed .ply, .spz, .splat, .sog, .glb, an unbundled SOG folder, or a world file (.yaml)",
    )
    add_out_flag(
        live, "folder for recorded takes: take-1, ... (%(default)s)", metavar="FOLDER", default=Path("out/live")
    )
    live.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    add_planning_flags(live)
    body = live.add_argument_group("body and ground")
    body.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, such as --up=-y (default: estimated)")
    body.add_argument(
        "--plane",
        help="ground plane n.x + d = 0 as nx,ny,nz,d in the capture's units, or a plane.json (default: estimated)",
    )
    body.add_argument(
        "--nodes",
        type=int,
        help="approximate number of cage nodes; fewer are faster; a cage that must be finer to enclose the body and "
        "its thin parts has up to about four times as many (default: 120 to 500, depending on the machine's speed)",
    )
    body.add_argument("--friction", type=float, default=0.8, help="initial Coulomb friction coefficient (0.8)")
    body.add_argument(
        "--metres-per-unit", type=float, help="scale of the capture (default: such that the body is 1 m tall)"
    )
    body.add_argument("--muscles", type=input_path, help="JSON file with muscle fibres (docs/motions/muscles.md)")
    body.add_argument(
        "--front",
        help="direction in which the body faces and moves: x,y,z or an axis, such as --front=-x (default: estimated)",
    )
    add_object_flags(live.add_argument_group("object in a scene"))
    page = live.add_argument_group("page")
    page.add_argument("--background", type=input_path, help="background capture, for example background.ply of a run")
    page.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 (default: any free port)")
    page.add_argument("--no-browser", action="store_true", help="print the address, but do not open the browser")
    live.set_defaults(run=_live, parser=live)


def _live(args: argparse.Namespace) -> int:
    import webbrowser

    from egs_warp.errors import UserError
    from egs_warp.io.run_folder import check_out
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.launching import reserve_core
    from egs_warp.meshing.cage import check_nodes
    from egs_warp.web.feed import LiveFeed
    from egs_warp.web.page import page_text
    from egs_warp.web.preview import PreviewFeed, preview_of
    from egs_warp.web.server import PageServer, check_port

    # Report the errors that can be detected before any long computation.
    page_text()
    check_port(args.port)
    if is_world(args.capture):
        return live_world(args)
    check_out(args.out)
    if args.nodes is not None:
        check_nodes(args.nodes)
    if args.muscles is not None:
        parse_json(read_text(args.muscles), args.muscles)
    if args.object is not None and args.background is not None:
        raise UserError("--background: with --object the rest of the scene is the background; leave one of them out")
    source = _read_scene(args) if args.object is not None else _read_capture(args)
    feed = PreviewFeed()
    server = PageServer([], port=args.port, feed=feed)
    with server.serve_in_background() as thread:
        print(f"open {server.address}\nend with Ctrl-C", flush=True)
        if not args.no_browser:
            webbrowser.open(server.address)
        try:
            upright = source.upright(feed.show_stage)
            feed.show_stage("preview")
            title = Path(args.capture).name
            preview = preview_of(upright.cloud, title=title, up=upright.up, plane=upright.plane, front=upright.front)
            feed.show_preview(preview)
            prepared = upright.prepared(feed.show_stage)
            session = _session(args, prepared, feed)
        except UserError as error:
            feed.show_error(str(error))
            raise
        scene = session.creature.placed(prepared.background) if prepared.background is not None else None
        with reserve_core():
            session.start()
            feed.start(LiveFeed(session, scene=scene))
            try:
                wait_for_end(thread)
            finally:
                # A step may take seconds; the page is to know at once.
                server.stop()
                session.stop()
    return 0


@dataclass(frozen=True)
class _Source:
    """A capture, its ground, and the object in it."""

    cloud: GaussianCloud
    """Gaussians of the object; before ``prepared``, those of the whole capture."""
    up: np.ndarray | None
    """(3,) up direction; None before ``upright`` if it has to be estimated, or if there is a plane."""
    plane: Plane | None
    front: np.ndarray | None
    ground: HeightField | None = None
    background: GaussianCloud | None = None
    scene: SceneInput | None = None
    """Scene that contains the object; None if the object is the whole capture."""
    light: MainLight | None = None
    """Main light in the axes of the capture; None if its estimate is uncertain."""

    def upright(self, begin_stage: Callable[[str], object]) -> _Source:
        """Return the source with an up direction or a plane, and print the notes that depend on it.

        Raises ``UserError`` if the front points up or down.
        """
        from egs_warp.commands.scene_hint import scene_notes
        from egs_warp.pipelines.placed_cage import check_front

        source = self
        if self.plane is None and self.up is None:
            begin_stage("up direction")
            up, note = guessed_up(self.cloud)
            print_note(note)
            source = replace(self, up=up)
        up = self.plane.normal if self.plane is not None else source.up
        if self.front is not None and up is not None:
            check_front(up, self.front)
        if self.scene is None:
            print_notes(scene_notes(self.cloud, up))
        return source

    def prepared(self, begin_stage: Callable[[str], object]) -> _Source:
        """Return the source with the object separated from its scene."""
        from egs_warp.pipelines.prepare_scene import SceneOptions

        if self.scene is None:
            return self
        if self.scene.object_alone is not None:
            return replace(self, cloud=self.scene.object_alone)
        scene = self.scene.prepared(SceneOptions(), begin_stage=begin_stage)
        print_notes(scene.notes)
        return _Source(scene.object, None, scene.plane, self.front, scene.ground, scene.background, light=scene.light)


def _read_capture(args: argparse.Namespace) -> _Source:
    """Read a capture that contains only the object."""
    from egs_warp.commands.scene_input import ground_of, light_of, plane_of
    from egs_warp.io import read_capture

    check_no_scene_flags(args)
    up = parse_up(args.up) if args.up is not None else None
    plane = plane_of(args.plane) if args.plane is not None else None
    start_device(args.device)
    background = read_capture(args.background, device=args.device) if args.background is not None else None
    capture = read_capture(args.capture, device=args.device)
    print_notes(capture.notes)
    front = parse_direction("front", args.front) if args.front is not None else None
    behind = background.cloud_aligned_with(capture) if background is not None else None
    ground, light = ground_of(args.plane, flat=False), light_of(args.plane)
    return _Source(capture, up, plane, front, ground, behind, light=light)


def _read_scene(args: argparse.Namespace) -> _Source:
    """Read a scene and the selection of its object."""
    from egs_warp.commands.scene_input import read_scene

    front = parse_direction("front", args.front) if args.front is not None else None
    scene = read_scene(args)
    print_notes(scene.notes)
    return _Source(scene.cloud, scene.up, scene.plane, front if front is not None else scene.front, scene=scene)


def _session(args: argparse.Namespace, source: _Source, feed: PreviewFeed) -> Session:
    """Build the creature of ``source`` and return a session that has not been started; ``feed`` shows the stages."""
    from egs_warp.locomotion.settings import LocomotionSettings
    from egs_warp.pipelines.creature import CreatureOptions, creature_in_cage, placed_body, placed_front
    from egs_warp.pipelines.placed_cage import node_count_note
    from egs_warp.pipelines.progress import preparation_bar
    from egs_warp.web.feed import live_render_data
    from egs_warp.web.node_choice import GPU_NODES, MachineSpeed, probe_seconds
    from egs_warp.web.presplit import presplit_gaussians
    from egs_warp.web.session import Session, SessionOptions

    machine = MachineSpeed(probe_seconds()) if args.device == "cpu" else None
    options = CreatureOptions(
        friction=args.friction,
        metres_per_unit=args.metres_per_unit,
        ground=source.ground,
        front=source.front,
        muscles_file=args.muscles,
        settings=LocomotionSettings(qp_solver=args.qp, strategy=args.strategy),
        nodes=args.nodes or (GPU_NODES if machine is None else machine.nodes),
    )
    with preparation_bar() as update_bar:

        def begins(stage: str) -> None:
            update_bar(stage)
            feed.show_stage(stage)

        begins("cage")
        standing, notes = placed_body(source.cloud, up=source.up, plane=source.plane, options=options)
        mesh = standing.cage.mesh
        size = next(iter(node_count_note(mesh, options.nodes)), f"the cage has {len(mesh.nodes)} nodes")
        size_note = size if machine is None else f"{size}; {machine.speed_note(len(mesh.nodes))}"
        if machine is not None:
            feed.show_note(machine.speed_note(len(mesh.nodes)))
        print_note(f"{size_note}; --nodes chooses another number")
        begins("front")
        front = placed_front(standing, options)
        feed.show_front(front.rotated(standing.frame.axes.T))
        creature = creature_in_cage(source.cloud, standing, options, front=front, notes=notes, progress=begins)
        begins("split")
        hides_ground = source.background is None and source.ground is None
        drawn_as = live_render_data(
            creature, presplit_gaussians(creature, hides_ground=hides_ground), light=source.light
        )
    print_notes(creature.notes)
    session_options = SessionOptions(source=Path(args.capture).name, takes=args.out, muscles_file=args.muscles)
    return Session(creature, drawn_as, session_options)
