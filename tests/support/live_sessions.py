"""Live session with a coarse creature, which is stepped by the test or in its own thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from egs_warp.assets.pawn import pawn
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.web.feed import live_render_data
from egs_warp.web.messages import read_message
from egs_warp.web.packets import Frame
from egs_warp.web.session import Session, SessionOptions


@cache
def coarse_pawn() -> Creature:
    """Return the built-in pawn in a cage of about a hundred nodes."""
    scene = pawn(gaussian_count=2000)
    return make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=50))


def session_of(creature: Creature, takes: Path) -> Session:
    """Return a session of ``creature`` that is not started and records to the folder ``takes``."""
    return Session(creature, live_render_data(creature, creature.cloud), SessionOptions(source="pawn", takes=takes))


class SteppedSession:
    """Session that the test steps in its own thread."""

    def __init__(self, creature: Creature, takes: Path) -> None:
        self.session = session_of(creature, takes)
        self.session.subscribe(lambda: None)
        self.frames: list[Frame] = []
        self.news: list[dict[str, Any]] = []

    def request(self, kind: str, **fields: Any) -> None:
        """Send a request to the session as the page does."""
        body = self.session.creature.body
        message = read_message({"type": kind, **fields}, height=body.height, node_count=len(body.node_mass))
        self.session.put_request(message)
        self.session.process_requests()
        self._hear()

    def step(self, count: int = 1) -> None:
        """Step ``count`` times."""
        for _ in range(count):
            self.session.advance()
            self._hear()

    def until(self, condition: Callable[[], bool], *, max_steps: int = 400) -> int:
        """Step until ``condition`` returns True; return the number of steps."""
        for count in range(max_steps):
            if condition():
                return count
            self.step()
        raise AssertionError(f"not within {max_steps} steps")

    def until_idle(self, *, max_steps: int = 400) -> int:
        """Step at least once, and until the creature stands and no motion is left."""
        self.step()
        return self.until(lambda: self.session.steering.idle, max_steps=max_steps)

    @property
    def messages(self) -> list[str]:
        """Messages that the session has sent to the user."""
        return [str(news["text"]) for news in self.news if news["type"] == "told"]

    def _hear(self) -> None:
        for news in self.session.take_news():
            if isinstance(news, Frame):
                self.frames.append(news)
            else:
                self.news.append(news)
