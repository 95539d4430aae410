"""``egs-warp live WORLD.yaml``: simulate the bodies of a world file; each browser steers one creature."""

from __future__ import annotations

import argparse
import threading
from contextlib import suppress
from pathlib import Path

from egs_warp.commands.animate_world import check_flags
from egs_warp.commands.scene_flags import print_note, print_notes, start_device

_FLAGS = ("capture", "device", "port", "no_browser")
"""Flags that also apply to a world."""


def live_world(args: argparse.Namespace) -> int:
    """Run ``egs-warp live`` for a world file. The caller has checked the port and the page."""
    import webbrowser

    from egs_warp.launching import reserve_core
    from egs_warp.pipelines.world_file import read_world
    from egs_warp.web.server import PageServer
    from egs_warp.web.world_feed import WorldFeed, live_page_bodies
    from egs_warp.web.world_session import WorldSession

    check_flags(args, _FLAGS)
    start_device(args.device)
    scripted = read_world(args.capture, device=args.device, progress=lambda name: print_note(f"preparing {name}"))
    print_notes(scripted.notes)
    session = WorldSession(scripted.world, live_page_bodies(scripted.world))
    server = PageServer([], port=args.port, feed=WorldFeed(session, title=Path(args.capture).name))
    with server.serve_in_background() as thread, reserve_core():
        print(
            f"open {server.address}\neach browser that opens it steers one creature; end with Ctrl-C",
            flush=True,
        )
        if not args.no_browser:
            webbrowser.open(server.address)
        session.start()
        try:
            wait_for_end(thread)
        finally:
            # A step may take seconds; the pages are to know at once.
            server.stop()
            session.stop()
    return 0


def wait_for_end(thread: threading.Thread) -> None:
    """Wait until ``thread`` ends or Ctrl-C."""
    with suppress(KeyboardInterrupt):
        while thread.is_alive():
            # On Windows, a wait without a timeout cannot be interrupted.
            thread.join(timeout=0.5)
