"""``egs-warp pick``: choose objects of a capture, their ground and their front on a page in the browser."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.flags import Commands, add_capture, add_out_flag
from egs_warp.commands.live import wait_for_end
from egs_warp.commands.scene_flags import add_object_flags, print_above_bars, print_notes
from egs_warp.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from egs_warp.commands.scene_input import SceneInput
    from egs_warp.io.picked import PickedObject

EXAMPLES = (
    "room.ply",
    "room.ply --cameras POSED --out out/toy/picked.json",
    "room.ply --object 0,0,0.5",
)
_LAST_LINE = 1.0
"""Time for which the server continues, so that the page receives its last line, s."""
_DISTANCE = 1.25
"""Ratio of the distance of the initial camera to the distance for a preview; above 1, it leaves space for the
arrows."""


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    pick = commands.add_parser("pick", help="choose objects, their ground and their front in the browser")
    add_capture(pick)
    add_out_flag(
        pick,
        "file to write (%(default)s); if it exists, its objects are shown first; films are written next to it",
        metavar="FILE",
        default=Path("out/pick/picked.json"),
    )
    add_object_flags(pick)
    pick.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, such as --up=-y (default: estimated)")
    pick.add_argument("--plane", help="ground plane: plane.json, or nx,ny,nz,d (default: estimated)")
    pick.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    pick.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 (default: any free port)")
    pick.add_argument("--no-browser", action="store_true", help="print the address, but do not open the browser")
    pick.set_defaults(run=_pick)


def _pick(args: argparse.Namespace) -> int:
    pick_on_page(args)
    return 0


def pick_on_page(args: argparse.Namespace, *, film: str | None = None) -> bool:
    """Open the page and wait until it ends.

    Args:
        args: the flags of ``egs-warp pick``.
        film: motion of the film that the caller renders after the page has ended; None if the page itself starts
            commands, until Ctrl-C.

    Returns:
        True if the user has requested the film, for which ``args.out`` has been written; False if the server has ended.
    """
    import webbrowser

    from egs_warp.commands.scene_input import read_scene
    from egs_warp.deformation.rigid import to_body_frame
    from egs_warp.io.picked import read_picked
    from egs_warp.web.page import page_text
    from egs_warp.web.photo_view import view_of_photo
    from egs_warp.web.pick_feed import PickFeed
    from egs_warp.web.pick_session import PickSession, PickSource
    from egs_warp.web.preview import DISTANCE, camera_facts, page_frame, still_run
    from egs_warp.web.server import PageServer, check_port

    # Report the errors that can be detected before any long computation.
    page_text()
    check_port(args.port)
    if args.out.suffix.lower() != ".json":
        raise UserError(f"--out {args.out}: give a file name that ends in .json")
    scene = read_scene(args)
    print_notes(scene.notes)
    cloud = scene.cloud
    up = scene.up if scene.plane is not None else _up_of(scene)
    kept = read_picked(args.out, cloud).objects if args.out.exists() else ()

    def first() -> Sequence[PickedObject]:
        return (*kept, _given_object(scene)) if scene.spec is not None else kept

    frame, bounds = page_frame(cloud, up=up, plane=scene.plane)
    placed = to_body_frame(cloud, frame)
    source = PickSource(
        cloud,
        placed,
        frame,
        Path(args.capture).name,
        args.out,
        _Commands(args),
        first,
        cameras=scene.cameras,
        film=film,
    )
    # A capture of a room, seen from outside, is fog; the photos were taken where it is clear.
    camera = view_of_photo([frame.camera(one) for one in scene.cameras])
    if camera is None:
        camera = camera_facts(bounds, distance=_DISTANCE * DISTANCE)
    shown = still_run(placed, bounds, {"title": Path(args.capture).name, "picking": True, "camera": camera})
    session = PickSession(source)
    server = PageServer([], port=args.port, feed=PickFeed(session, shown))
    with server.serve_in_background() as thread:
        how = "end with Ctrl-C" if film is None else f"pick the object, then press Animate; the motion is {film}"
        print_above_bars(f"open {server.address}\n{how}")
        sys.stdout.flush()
        if not args.no_browser:
            webbrowser.open(server.address)
        session.start()
        try:
            if film is None:
                wait_for_end(thread)
            else:
                while thread.is_alive() and not session.has_film_request.wait(timeout=0.5):
                    pass
                time.sleep(_LAST_LINE)
        finally:
            session.stop()
    return session.has_film_request.is_set()


def pick_automatically(args: argparse.Namespace) -> None:
    """Write ``args.out`` with the object of ``--object``, or with the object that the page would propose first.

    Raises ``UserError`` if no object is found, or if the proposal is doubtful.
    """
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.io.picked import PickedFile, PickedObject, write_picked
    from egs_warp.io.planes import PlaneRecord
    from egs_warp.pipelines.pick import photo_warnings, pick_warnings, proposed
    from egs_warp.segmentation.interactive import ClickGraph

    scene = read_scene(args)
    print_notes(scene.notes)
    if scene.spec is not None:
        one = _given_object(scene)
    else:
        up = _up_of(scene)
        graph = ClickGraph.of(scene.cloud)
        pick = proposed(graph, up, cameras=scene.cameras)
        if not pick.mask.any():
            raise UserError(
                f"{args.capture}: no object was found in the middle of the capture; leave out --yes and pick it on the"
                " page, or give --object"
            )
        doubts = (*pick_warnings(graph, pick), *photo_warnings(scene.cloud, pick.mask, scene.cameras))
        if doubts:
            raise UserError(
                f"{args.capture}: the object that was found is doubtful: {doubts[0]}. Leave out --yes to correct it on"
                " the page, or give --object"
            )
        one = PickedObject(pick.name, pick.mask, PlaneRecord(pick.plane), pick.front)
    write_picked(args.out, PickedFile(Path(args.capture).name, (one,)), scene.cloud)


def _up_of(scene: SceneInput) -> np.ndarray:
    """Return the up direction (3,) of ``--up``, or else of the scene, with a note if it is uncertain."""
    from egs_warp.pipelines.locate_plane import up_of_scene

    if scene.up is not None:
        return scene.up
    # A capture of one object, which the page proposes as a whole, may be tilted.
    up, notes, _ = up_of_scene(scene.cloud, scene.cameras, tilted=True)
    print_notes(notes)
    return up


def _given_object(scene: SceneInput) -> PickedObject:
    """Return the object of ``--object`` and the plane under it, found as in the other commands."""
    from egs_warp.io.picked import PickedObject
    from egs_warp.pipelines.locate_plane import locate_plane

    located = locate_plane(scene.cloud, scene.object, cameras=scene.cameras, up=scene.up, plane=scene.plane)
    return PickedObject("object 1", located.segmentation.object_mask, located.known(), scene.front)


@dataclass(frozen=True)
class _Commands:
    """Implementation of ``PickCommands`` with the capture, cameras and device of ``args``."""

    args: argparse.Namespace

    def _shared(self, value: str) -> list[str]:
        shared = [self.args.capture, f"--object={value}", f"--device={self.args.device}"]
        return shared if self.args.cameras is None else [*shared, f"--cameras={self.args.cameras}"]

    def animate(self, value: str, motion: str) -> tuple[list[str], Path]:
        number = 1
        while (folder := self.args.out.parent / f"film-{number}").exists():
            number += 1
        return ["animate", *self._shared(value), f"--motion={motion}", f"--out={folder}"], folder

    def live(self, value: str) -> list[str]:
        return ["live", *self._shared(value), "--no-browser", f"--out={self.args.out.parent / 'takes'}"]

    def view(self, folder: Path) -> list[str]:
        return ["view", str(folder), "--no-browser"]
