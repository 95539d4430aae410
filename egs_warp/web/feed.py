"""What a socket is sent of a live session, and what it passes on."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import AsyncGenerator

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.motions.style import LEAST, MOST, PRESETS, Style
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.simulated_run import FILMED_FROM
from egs_warp.web.messages import MIN_SAG, MAX_FRICTION, MAX_SAG, read_message
from egs_warp.web.packets import Frame
from egs_warp.web.recording import CURVES, creature_header, curve_facts
from egs_warp.web.session import Session

_ROOM = 1.25
"""Half of what the camera sees at first, in body heights."""


class LiveFeed:
    """A session as packets (``FrameFeed``)."""

    def __init__(self, session: Session, *, scene: GaussianCloud | None = None) -> None:
        """``scene``: what is behind the creature, in its frame."""
        self.session = session
        self._scene = scene
        self._name = secrets.token_hex(8)
        self._header: bytes | None = None

    def header(self) -> bytes:
        """All that does not change: the same bytes at every call."""
        if self._header is None:
            self._header = self._made_header()
        return self._header

    def _made_header(self) -> bytes:
        session = self.session
        creature, made = session.creature, session.drawn_as
        body, mesh = creature.body, creature.cage.mesh
        facts = {
            "title": session.options.source,
            # A page that finds another one begins anew.
            "session": self._name,
            "rate": FRAME_RATE,
            "frames": 0,
            "height": body.height,
            "weight": body.weight,
            "friction": creature.geometry.friction,
            # What a momentum is missing is known only once a step is over; takes have it.
            "curves": curve_facts([curve for curve in CURVES if curve[0] != "residual"]),
            "audit": {},
            "motion": [],
            "notes": [],
            "limits": {"friction": [0.0, MAX_FRICTION], "sag": [MIN_SAG, MAX_SAG], "style": [LEAST, MOST]},
            "styles": {"usual": vars(Style()), **{name: dict(style) for name, style in PRESETS.items()}},
        }
        planes = np.array([[*plane.normal, plane.offset] for plane in creature.geometry.planes])
        deformer = Deformer(made.splats, embed_gaussians(made.splats, mesh))
        return creature_header(facts, made, mesh, body.node_mass, planes, deformer, self._scene)

    async def packets(self) -> AsyncGenerator[bytes | str]:
        """Frames and news as they come, until the session is left."""
        loop, some = asyncio.get_running_loop(), asyncio.Event()
        self.session.subscribe(lambda: loop.call_soon_threadsafe(some.set))
        try:
            while True:
                await some.wait()
                some.clear()
                for news in self.session.take_news():
                    yield news.packet() if isinstance(news, Frame) else json.dumps(news)
        finally:
            self.session.unsubscribe()

    def receive(self, message: dict[str, object]) -> None:
        """Pass on what the page asks. Raises ``ValueError`` for what makes no sense."""
        body = self.session.creature.body
        self.session.put_request(read_message(message, height=body.height, node_count=len(body.node_mass)))


def live_camera(creature: Creature, *, size: int = 512) -> Camera:
    """Looks at the standing creature as a film does, with room around it to move in."""
    nodes, height = creature.start.positions, creature.body.height
    middle = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))
    direction = np.array(FILMED_FROM) / np.linalg.norm(FILMED_FROM) @ initial_stance(creature).ground.axes
    fov = 30.0
    distance = _ROOM * height / np.tan(np.radians(0.5 * fov))
    return Camera.look_at(
        middle + distance * direction,
        middle,
        np.array([0.0, 0.0, 1.0]),
        width=size,
        height=size,
        vertical_fov_degrees=fov,
        near=0.01 * distance,
    )


def drawn_creature(creature: Creature, splats: GaussianCloud) -> RenderData:
    """``creature`` as the page draws it, of ``splats`` that were split at rest."""
    return RenderData.of(splats, live_camera(creature), creature.muscles, initial_stance(creature).feet())
