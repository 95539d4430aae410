"""Feed of a live page that shows the still capture while its creature is prepared."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import AsyncGenerator, Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from egs_warp.deformation.deformer import MAX_STRETCH
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import GROUND, BodyFrame, upright_frame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.motions.stance import GroundFrame
from egs_warp.pipelines.creature import usual_view
from egs_warp.pipelines.facing_direction import Front
from egs_warp.web.packets import Frame, header
from egs_warp.web.recording import splat_arrays
from egs_warp.web.server import FrameFeed

_OUTLIERS = 0.5
"""Percentage of the opaque Gaussians that are excluded from the bounds of the capture at either end of each axis."""
_OPAQUE = 0.3
"""Minimum opacity of the Gaussians that determine the bounds of the capture."""
FOV_DEGREES = 30.0
"""Vertical field of view of the initial camera, degrees."""
DISTANCE = 1.0 / np.tan(np.radians(0.5 * FOV_DEGREES))
"""Distance of the camera, body heights, at which half of the picture's height shows one body height."""
_WIDE = 0.6
"""Half of the height that the camera shows of a wide body, relative to the horizontal diagonal of its box."""
_X_AXIS = Front(np.array([1.0, 0.0, 0.0]), None)
"""Front of a body that faces along the x axis."""


@dataclass(frozen=True)
class StillRun:
    """Gaussians as a run of one frame."""

    header: bytes
    frame: bytes
    """Packet of the frame."""


@dataclass(frozen=True, kw_only=True)
class Preview(StillRun):
    """The still capture as a run of one frame, in a frame that is close to the frame of the body."""

    body_frame: BodyFrame
    """Frame of the run in the capture."""
    bounds: np.ndarray
    """(2, 3) lower and upper corner of the capture in this frame, without outliers."""

    def camera(self, front: Front) -> dict[str, Any]:
        """Return the camera (``camera_facts``) for a body with ``front``, in the capture's axes."""
        distance = DISTANCE * view_size(self.bounds)
        return camera_facts(self.bounds, distance=distance, front=front.rotated(self.body_frame.axes))


def preview_of(
    cloud: GaussianCloud,
    *,
    title: str = "capture",
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    front: np.ndarray | None = None,
) -> Preview:
    """Return the preview of a capture.

    Args:
        cloud: The capture.
        title: Title of the page.
        up: (3,) up direction in the capture's frame; it may be None if ``plane`` is given.
        plane: Ground plane in the capture's frame; None uses a plane below the capture.
        front: (3,) direction in which the body faces, in the capture's frame, not parallel to the up direction; None if
            it is not known yet.
    """
    frame, bounds = page_frame(cloud, up=up, plane=plane)
    seen = _X_AXIS if front is None else Front(frame.axes @ front, None)
    camera = camera_facts(bounds, distance=DISTANCE * view_size(bounds), front=seen)
    facts = {"title": title, "preparing": True, "camera": camera}
    still = still_run(to_body_frame(cloud, frame), bounds, facts)
    return Preview(still.header, still.frame, body_frame=frame, bounds=bounds)


def page_frame(
    cloud: GaussianCloud, *, up: np.ndarray | None = None, plane: Plane | None = None
) -> tuple[BodyFrame, np.ndarray]:
    """Return a frame in which the capture stands upright and has a height of one, and the bounds of the capture in this
    frame: the lower and the upper corner (2, 3) of its box without outliers.

    Args:
        cloud: The capture.
        up: (3,) up direction in the capture's frame; it may be None if ``plane`` is given.
        plane: Ground plane in the capture's frame; None uses a plane below the capture.
    """
    means, is_opaque = cloud.means.numpy().astype(np.float64), cloud.visible(_OPAQUE)
    opaque = means[is_opaque] if is_opaque.any() else means
    if plane is None:
        assert up is not None, "page_frame requires up or a plane"
        up = up / np.linalg.norm(up)
        plane = Plane(up, -float(np.percentile(opaque @ up, _OUTLIERS)))
    frame = upright_frame(opaque, np.ones(len(opaque)), plane)
    frame = frame.scaled(1.0 / max(float(np.percentile(frame.points(opaque)[:, 2], 100.0 - _OUTLIERS)), 1e-9))
    return frame, _bounds(frame, opaque)


def _bounds(frame: BodyFrame, points: np.ndarray) -> np.ndarray:
    """Return the bounds of ``points`` (n, 3) in ``frame``: the lower and the upper corner (2, 3) of their box without
    outliers."""
    return np.percentile(frame.points(points), [_OUTLIERS, 100.0 - _OUTLIERS], axis=0)


def view_size(bounds: np.ndarray) -> float:
    """Return half of the height, in units of ``bounds``, that the initial camera shows of a body in the box ``bounds``
    (2, 3): the height of the box or, if it is so wide that its sides would be cut off, more."""
    across, along, height = bounds[1] - bounds[0]
    return max(float(height), _WIDE * float(np.hypot(across, along)))


def camera_facts(bounds: np.ndarray, *, distance: float = DISTANCE, front: Front = _X_AXIS) -> dict[str, Any]:
    """Return the entry ``camera`` of a header: a camera at ``distance``, in units of ``bounds``, from the middle of
    ``bounds`` (2, 3). It views a body with ``front``, in the axes of ``bounds``, from the direction of the film's
    camera (``usual_view``)."""
    middle = bounds.mean(axis=0)
    ground = GroundFrame.on_plane(GROUND, front.direction, middle)
    direction = usual_view(front, ground) @ ground.axes
    position = middle + distance * direction
    return {"position": position.tolist(), "forward": (-direction).tolist(), "fov": FOV_DEGREES}


def still_run(splats: GaussianCloud, bounds: np.ndarray, facts: Mapping[str, Any]) -> StillRun:
    """Return the Gaussians as a run of one frame. Its cage is one tetrahedron at a corner of the box ``bounds`` (2, 3).
    ``facts`` are entries of the header, which must include title and camera."""
    low, high = bounds
    nodes = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    facts = {
        "session": secrets.token_hex(8),
        "rate": FRAME_RATE,
        "frames": 1,
        "height": 1.0,
        "weight": 1.0,
        "friction": 0.0,
        "front": [1.0, 0.0],
        "flat": True,
        "curves": [],
        "audit": {},
        "motion": [],
        "notes": [],
        "fibres": [],
        "antialiased": splats.antialiased,
        "degree": {"splats": splats.sh_degree, "scene": 0},
        "max_stretch": MAX_STRETCH,
        **facts,
    }
    no_indices = np.zeros(0, np.int32)
    arrays = {
        "rest": nodes.astype(np.float32),
        "tets": np.array([[0, 1, 2, 4]], np.int32),
        "node_mass": np.ones(len(nodes), np.float32),
        "planes": np.array([[0.0, 0.0, 1.0, 0.0]], np.float32),
        "surface": no_indices.reshape(0, 3),
        "edges": no_indices.reshape(0, 2),
        "muscle_end_starts": np.zeros(1, np.int32),
        "muscle_end_nodes": no_indices,
        "muscle_end_weights": np.zeros(0, np.float32),
        "muscle_segments": no_indices.reshape(0, 2),
        "fibre_from_segment": no_indices,
        "foot_from_node": np.full(len(nodes), -1, np.int32),
        "mean_tets": np.zeros(splats.count, np.int32),
        "arms": np.zeros((0, 15), np.float32),
        **splat_arrays("splats", splats),
    }
    frame = Frame(0, 0.0, nodes, np.zeros(0), np.zeros((0, 9)), np.zeros(0))
    return StillRun(header(facts, arrays), frame.packet())


class PreviewFeed:
    """``PreparedFeed`` that first sends the stages of the preparation, then a preview with the further stages, and then
    the frames of a session."""

    def __init__(self) -> None:
        self._preview: Preview | None = None
        self._session: FrameFeed | None = None
        self._event: dict[str, Any] = {"type": "preparing", "stage": ""}
        self._facts: dict[str, Any] = {}
        self._wake: Callable[[], object] = lambda: None

    # The thread that prepares the creature calls the following methods.

    def show_stage(self, stage: str) -> None:
        """Show that ``stage`` of the preparation has started."""
        self._send({"type": "preparing", "stage": stage, **self._facts})

    def show_front(self, front: Front) -> None:
        """Turn the camera of the preview to a body with ``front``, in the capture's axes."""
        assert self._preview is not None, "show_front follows show_preview"
        self._add_facts(camera=self._preview.camera(front))

    def show_note(self, note: str) -> None:
        """Show one line about the body, such as its expected speed, until the session starts."""
        self._add_facts(note=note)

    def show_error(self, text: str) -> None:
        """Show the reason why no creature will be available."""
        self._send({"type": "failed", "text": text})

    def show_preview(self, preview: Preview) -> None:
        """Show the still capture from now on."""
        self._preview = preview
        self._wake()

    def start(self, session: FrameFeed) -> None:
        """Send the frames of ``session`` from now on; pages that still show the preview reload themselves."""
        self._session = session
        self._send({"type": "ready"})

    def _add_facts(self, **facts: Any) -> None:
        """Add ``facts`` to the event of this stage and of all later ones, because a page that connects later receives
        only the latest event."""
        self._facts |= facts
        if self._event["type"] == "preparing":
            self._send(self._event | facts)

    def _send(self, event: dict[str, Any]) -> None:
        self._event = event
        self._wake()

    # The server calls the following methods.

    async def events_before_header(self) -> AsyncGenerator[str]:
        """Yield the events until there is a preview or a session."""
        async for event in self._events(lambda: self._preview is not None or self._session is not None):
            yield json.dumps(event)

    def header(self) -> bytes:
        """Return the header of the session if there is one, otherwise the header of the preview."""
        if self._session is not None:
            return self._session.header()
        assert self._preview is not None, "events_before_header ends when there is a preview"
        return self._preview.header

    async def packets(self) -> AsyncGenerator[bytes | str]:
        """Yield the packets of the session if there is one, otherwise the frame of the preview and the events."""
        if self._session is not None:
            async for packet in self._session.packets():
                yield packet
            return
        assert self._preview is not None
        yield self._preview.frame
        async for event in self._events(lambda: False):
            yield json.dumps(event)
            if event["type"] == "ready":
                return

    async def _events(self, is_over: Callable[[], bool]) -> AsyncGenerator[dict[str, Any]]:
        """Yield the latest event, and each later one, until ``is_over`` returns True."""
        loop, has_news = asyncio.get_running_loop(), asyncio.Event()
        self._wake = lambda: loop.call_soon_threadsafe(has_news.set)
        event: dict[str, Any] | None = None
        try:
            while not is_over():
                if event is not self._event:
                    event = self._event
                    yield event
                    continue
                await has_news.wait()
                has_news.clear()
        finally:
            self._wake = lambda: None

    def receive(self, message: dict[str, object]) -> None:
        """Pass a message from the page to the session.

        Raises ``ValueError`` if there is no session yet or the message is invalid.
        """
        if self._session is None:
            raise ValueError("the creature is being prepared")
        self._session.receive(message)
