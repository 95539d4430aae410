"""Session that picks objects in a small scene."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.web.pick_feed import PickFeed
from egs_warp.web.pick_session import PickCommands, PickSession, PickSource
from egs_warp.web.preview import camera_facts, page_frame, still_run


class Commands:
    """Substitutes for the commands of the page, which end at once: the film is the existing run in ``folder``, and the
    live simulation finds no capture."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.values: list[tuple[str, str | None]] = []

    def animate(self, value: str, motion: str) -> tuple[list[str], Path]:
        """Return the arguments of a command that prints its help text."""
        self.values.append((value, motion))
        return ["animate", "--help"], self.folder

    def live(self, value: str) -> list[str]:
        """Return the arguments of a command that names a missing file."""
        self.values.append((value, None))
        return ["live", "missing.ply"]

    def view(self, folder: Path) -> list[str]:
        """Return the arguments of the command that shows the film."""
        return ["view", str(folder), "--no-browser"]


def picking(cloud: GaussianCloud, path: Path, commands: PickCommands | None = None) -> tuple[PickSession, PickFeed]:
    """Return a session that is not started, and its feed; ``commands`` are passed to ``PickSource``."""
    frame, bounds = page_frame(cloud, up=np.array([0.0, 0.0, 1.0]))
    placed = to_body_frame(cloud, frame)
    session = PickSession(PickSource(cloud, placed, frame, "scene.ply", path, commands or Commands(path.parent)))
    shown = still_run(placed, bounds, {"title": "scene.ply", "picking": True, "camera": camera_facts(bounds)})
    return session, PickFeed(session, shown)


def events_until(session: PickSession, done: Callable[[dict[str, dict[str, Any]]], bool]) -> dict[str, dict[str, Any]]:
    """Return the latest event of each type as soon as ``done`` is true for them."""
    latest: dict[str, dict[str, Any]] = {}
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        for event in session.take_events():
            latest[event["type"]] = event
        if done(latest):
            return latest
        time.sleep(0.01)
    raise AssertionError(latest)
