"""Feed of a live session of a world: each connected page has its own mailbox and steers one creature."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import AsyncGenerator

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera import Camera
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.motions.style import MAX_FACTOR, MIN_FACTOR
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.drawn_cage import DrawnCage, drawn_level_set
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.shot import framed
from egs_warp.pipelines.world import PlacedBody, World
from egs_warp.web.feed import PAGE_MOTIONS, STYLES, box_middle, motion_refusals
from egs_warp.web.joint_header import PageBody, joint_header
from egs_warp.web.messages import MAX_FRICTION, MAX_SAG, MIN_SAG, read_message
from egs_warp.web.packets import Frame
from egs_warp.web.presplit import presplit_gaussians
from egs_warp.web.recording import CURVES, curve_facts
from egs_warp.web.world_session import WorldPage, WorldSession

_FIELD_OF_VIEW = 30.0
"""Vertical field of view of the initial camera, degrees."""
_ELEVATION = 0.4
"""Ratio of the vertical to the horizontal component of the direction to the initial camera."""
_MARGIN = 1.5
"""Distance of the initial camera, relative to the distance at which it just shows all bodies."""


class WorldFeed:
    """Feeds of the pages of a live session of a world (``SharedFeed``)."""

    def __init__(self, session: WorldSession, *, title: str) -> None:
        """Create the feeds of ``session``; ``title`` is the name of its world file."""
        self.session = session
        self._title, self._name = title, secrets.token_hex(8)
        self._header: bytes | None = None

    def connect(self) -> WorldPageFeed:
        """Return the feed for a page that connects."""
        return WorldPageFeed(self, self.session.connect())

    def header(self) -> bytes:
        """Return the header; every call returns identical bytes."""
        if self._header is None:
            self._header = self._build_header()
        return self._header

    def _build_header(self) -> bytes:
        session = self.session
        bodies = [body.member.body for body in session.bodies]
        camera = session.page_bodies[0].render_data.camera
        forward = camera.rotation[2, :2]
        curves = [curve for curve in CURVES if curve[0] != "residual"]
        facts = {
            "title": self._title,
            "session": self._name,
            "rate": FRAME_RATE,
            "frames": 0,
            "height": max(body.body.height for body in bodies),
            "weight": max(body.body.weight for body in bodies),
            "friction": bodies[0].geometry.friction,
            "front": (-forward / max(float(np.linalg.norm(forward)), 1e-9)).tolist(),
            "start": box_middle(np.concatenate([body.start.positions for body in bodies])),
            "flat": not session.world.solids,
            "curves": [{**curve, "body": index} for index in range(len(bodies)) for curve in curve_facts(curves)],
            "audit": {},
            "motion": [],
            "notes": [],
            "limits": {"friction": [0.0, MAX_FRICTION], "sag": [MIN_SAG, MAX_SAG], "style": [MIN_FACTOR, MAX_FACTOR]},
            "styles": STYLES,
            "motions": PAGE_MOTIONS,
            "refusals": {
                body.member.name: motion_refusals(body.member.body)
                for body in session.bodies
                if isinstance(body.member.body, Creature)
            },
        }
        planes = np.array([[*plane.normal, plane.offset] for plane in bodies[0].geometry.planes])
        surroundings = session.world.surroundings
        scene = None if surroundings is None else surroundings.cloud
        return joint_header(facts, session.page_bodies, planes, scene=scene)


class WorldPageFeed:
    """``FrameFeed`` of one page of a live session of a world."""

    def __init__(self, feed: WorldFeed, page: WorldPage) -> None:
        self._feed, self.page = feed, page

    def header(self) -> bytes:
        """Return the header of the world."""
        return self._feed.header()

    async def packets(self) -> AsyncGenerator[bytes | str]:
        """Yield frames and events as they become available, until the consumer closes the generator."""
        loop, has_news = asyncio.get_running_loop(), asyncio.Event()
        mailbox = self.page.mailbox
        mailbox.subscribe(lambda: loop.call_soon_threadsafe(has_news.set), self.page.session.frame)
        try:
            while True:
                await has_news.wait()
                has_news.clear()
                for news in mailbox.take_news():
                    yield news.packet() if isinstance(news, Frame) else json.dumps(news)
        finally:
            mailbox.unsubscribe()

    def close(self) -> None:
        """Remove the page from the session."""
        self.page.session.disconnect(self.page)

    def receive(self, message: dict[str, object]) -> None:
        """Queue a message from the page, or select a creature. Raises ``ValueError`` for an invalid message."""
        if message.get("type") == "select":
            name = message.get("body")
            if not isinstance(name, str) or len(message) != 2:
                raise ValueError("select: give the name of a creature as body")
            self.page.select(name)
            return
        session = self.page.session
        height = session.bodies[self.page.selected].member.body.body.height
        node_count = sum(len(body.cage.nodes) for body in session.page_bodies)
        self.page.put_request(read_message(message, height=height, node_count=node_count))


def live_page_bodies(world: World) -> list[PageBody]:
    """Return the bodies of ``world`` for the page. The Gaussians of creatures are split for likely motions."""
    camera = world_view(world)
    hides_ground = world.ground is None and world.surroundings is None
    return [_page_body(member, camera, hides_ground=hides_ground) for member in world.members]


def _page_body(member: PlacedBody, camera: Camera, *, hides_ground: bool) -> PageBody:
    body = member.body
    if isinstance(body, Creature):
        splats, feet = presplit_gaussians(body, hides_ground=hides_ground), initial_stance(body).feet()
    else:
        splats, feet = body.cloud, ()
    shape = ContactShape.of(body.geometry, body.shape.level_set, body.mesh.nodes)
    return PageBody(
        member.name,
        RenderData.of(splats, camera, body.muscles, feet),
        DrawnCage.of(body.mesh, shape),
        drawn_level_set(shape),
        body.body.height,
        body.body.node_mass,
        Deformer(splats, embed_gaussians(splats, body.mesh)),
        {},
    )


def world_view(world: World, *, size: int = 512) -> Camera:
    """Return the initial camera of the page, which shows all bodies and some space around them."""
    points = np.concatenate([member.body.start.positions for member in world.members])
    faces = [member.body.front.direction[:2] for member in world.members if isinstance(member.body, Creature)]
    ahead = np.sum(faces, axis=0) if faces else np.array([1.0, 0.0])
    # View creatures that face each other from the side.
    if np.linalg.norm(ahead) < 0.5 * len(faces):
        ahead = np.array([faces[0][1], -faces[0][0]]) if faces else np.array([1.0, 0.0])
    ahead = ahead / np.linalg.norm(ahead)
    # A three-quarter view shows a face best.
    turn = np.radians(-35.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    level = rotation @ ahead
    direction = np.array([*level, _ELEVATION]) / np.hypot(1.0, _ELEVATION)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, distance = 0.5 * (low + high), 4.0 * float(np.linalg.norm(high - low))
    near = Camera.look_at(
        *(middle + distance * direction, middle, GROUND.normal),
        width=size,
        height=size,
        vertical_fov_degrees=_FIELD_OF_VIEW,
    )
    near = framed(near, points)
    distance = _MARGIN * float(np.linalg.norm(near.centre - middle))
    return Camera.look_at(
        *(middle + distance * direction, middle, GROUND.normal),
        width=size,
        height=size,
        vertical_fov_degrees=_FIELD_OF_VIEW,
        near=0.01 * distance,
    )
