"""Feed of a live session: header, frames and events for the socket, and messages from it."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import AsyncGenerator
from dataclasses import replace

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.main_light import MainLight
from egs_warp.lighting.remaining_shadow import without_shadow
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.motions.script import refusal
from egs_warp.motions.style import MAX_FACTOR, MIN_FACTOR, PRESETS, Style
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.render_data import RenderData
from egs_warp.web.messages import MAX_FRICTION, MAX_SAG, MIN_SAG, STYLE_NAMES, read_message
from egs_warp.web.packets import Frame
from egs_warp.web.preview import DISTANCE, FOV_DEGREES, view_size
from egs_warp.web.recording import CURVES, cage_arrays, creature_header, curve_facts
from egs_warp.web.session import Session

STYLES = {name: {key: style[key] for key in STYLE_NAMES} for name, style in {"usual": vars(Style()), **PRESETS}.items()}
"""Named styles of jumps, for the page."""
PAGE_MOTIONS = [name for name, kind in MOTIONS.items() if kind.file is None and name not in ("stand", "walk to")]
"""Names of the motions that the page offers; a click on the ground replaces ``walk to``."""


class LiveFeed:
    """``FrameFeed`` of a live session."""

    def __init__(self, session: Session, *, scene: GaussianCloud | None = None) -> None:
        """Create the feed of ``session``; ``scene`` is the background in the frame of the body, or None."""
        self.session = session
        light = session.drawn_as.light
        if scene is not None and light is not None:
            creature = session.creature
            scene = without_shadow(scene, creature.cloud, creature.geometry.field or GROUND, light)
        self._scene = scene
        self._name = secrets.token_hex(8)
        self._header: bytes | None = None

    def header(self) -> bytes:
        """Return the header; every call returns identical bytes."""
        if self._header is None:
            self._header = self._build_header()
        return self._header

    def _build_header(self) -> bytes:
        session = self.session
        creature, render_data = session.creature, session.drawn_as
        body, mesh = creature.body, creature.cage.mesh
        facts = {
            "title": session.options.source,
            # Name by which a page that reconnects detects another session; it then reloads itself.
            "session": self._name,
            "rate": FRAME_RATE,
            "frames": 0,
            "height": body.height,
            "weight": body.weight,
            "friction": creature.geometry.friction,
            "front": creature.front.direction[:2].tolist(),
            "start": box_middle(creature.start.positions),
            "flat": len(creature.geometry.planes) == 1 and creature.geometry.field is None,
            # The momentum residual can only be computed after a step, so only recorded takes contain its curve.
            "curves": curve_facts([curve for curve in CURVES if curve[0] != "residual"]),
            "audit": {},
            "motion": [],
            "notes": [],
            "limits": {"friction": [0.0, MAX_FRICTION], "sag": [MIN_SAG, MAX_SAG], "style": [MIN_FACTOR, MAX_FACTOR]},
            "styles": STYLES,
            "motions": PAGE_MOTIONS,
            "refusals": {"": motion_refusals(creature)},
        }
        planes = np.array([[*plane.normal, plane.offset] for plane in creature.geometry.planes])
        deformer = Deformer(render_data.splats, embed_gaussians(render_data.splats, mesh))
        return creature_header(
            facts | {"max_stretch": deformer.max_stretch},
            render_data,
            cage=cage_arrays(mesh, deformer),
            node_mass=body.node_mass,
            planes=planes,
            scene=self._scene,
        )

    async def packets(self) -> AsyncGenerator[bytes | str]:
        """Yield frames and events as they become available, until the consumer closes the generator."""
        loop, has_news = asyncio.get_running_loop(), asyncio.Event()
        self.session.subscribe(lambda: loop.call_soon_threadsafe(has_news.set))
        try:
            while True:
                await has_news.wait()
                has_news.clear()
                for news in self.session.take_news():
                    yield news.packet() if isinstance(news, Frame) else json.dumps(news)
        finally:
            self.session.unsubscribe()

    def receive(self, message: dict[str, object]) -> None:
        """Queue a message from the page for the session. Raises ``ValueError`` for an invalid message."""
        body = self.session.creature.body
        self.session.put_request(read_message(message, height=body.height, node_count=len(body.node_mass)))


def box_middle(positions: np.ndarray) -> list[float]:
    """Return the middle of the box around ``positions`` (N, 3), for the header of a live session."""
    return (0.5 * (positions.min(axis=0) + positions.max(axis=0))).tolist()


def motion_refusals(creature: Creature) -> dict[str, str]:
    """Return the reason for each of ``PAGE_MOTIONS`` that the creature cannot perform."""
    # What the surroundings prevent at the start may be possible elsewhere.
    place = replace(initial_stance(creature), solids=())
    reasons = {name: refusal(name, place) for name in PAGE_MOTIONS}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def live_camera(creature: Creature, *, size: int = 512) -> Camera:
    """Return the initial camera of the page. It views the creature from the direction of the film's camera and leaves
    space around it."""
    nodes = creature.start.positions
    bounds = np.array([nodes.min(axis=0), nodes.max(axis=0)])
    middle = bounds.mean(axis=0)
    place = initial_stance(creature)
    direction = place.view() @ place.ground.axes
    distance = DISTANCE * view_size(bounds)
    return Camera.look_at(
        middle + distance * direction,
        middle,
        np.array([0.0, 0.0, 1.0]),
        width=size,
        height=size,
        vertical_fov_degrees=FOV_DEGREES,
        near=0.01 * distance,
    )


def live_render_data(creature: Creature, splats: GaussianCloud, *, light: MainLight | None = None) -> RenderData:
    """Return the data from which the page draws ``creature``. ``splats`` are the creature's Gaussians at rest, after
    splitting; ``light`` is the main light in the axes of the capture."""
    placed = None if light is None else light.rotated(creature.frame.axes)
    feet = initial_stance(creature).feet()
    return RenderData.of(splats, live_camera(creature), creature.muscles, feet, light=placed)
