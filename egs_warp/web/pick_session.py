"""Session of the page of ``egs-warp pick``: a thread that applies the messages of the page to the picked objects.

All lengths are in the frame of the page, in which the capture has a height of about one. The file is written in the
frame of the capture.
"""

from __future__ import annotations

import base64
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.picked import PickedFile, PickedObject, write_picked
from egs_warp.io.planes import PlaneRecord
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.pipelines.info import BodyInfo, inspect_capture
from egs_warp.pipelines.pick import (
    Pick,
    PickHistory,
    PickState,
    ground_around,
    is_grounded,
    located,
    marked,
    on_table_top,
    photo_warnings,
    pick_warnings,
    proposed,
    regrounded,
    resegmented,
    stroke_at,
)
from egs_warp.segmentation.ground import REACH
from egs_warp.segmentation.interactive import ClickGraph
from egs_warp.web.photo_view import view_of_object
from egs_warp.web.pick_jobs import Job
from egs_warp.web.pick_messages import (
    MAX_OBJECTS,
    AddObject,
    Mark,
    MovePlane,
    PickMessage,
    RemoveObject,
    RenameObject,
    RunAnimate,
    RunLive,
    Save,
    SelectObject,
    TurnFront,
    Undo,
)

_MEASURE_DELAY = 0.8
"""Time without messages after which the active object is measured, s."""
_NO_BODY: dict[str, Any] = {"type": "body", "rows": [], "motions": [], "front": None}
"""Event for an object without measurements."""
_GRID_REACH, _GRID_STEP = 1.2, 2
"""Half of the side of the grid with which the page shows the ground, in sizes of the object; and spacing of the grid's
nodes, in node spacings of the measured ground."""
_MEASURE_NODES = 120
"""Approximate number of cage nodes for the measurements; feet and motions hardly depend on it."""


class PickCommands(Protocol):
    """Arguments of the commands that a session starts. ``value`` selects a picked object, in the syntax of
    ``--object``."""

    def animate(self, value: str, motion: str) -> tuple[list[str], Path]:
        """Return the arguments that make a film of ``motion``, and the folder of the film."""
        ...

    def live(self, value: str) -> list[str]:
        """Return the arguments of a live simulation."""
        ...

    def view(self, folder: Path) -> list[str]:
        """Return the arguments that show the film in ``folder``."""
        ...


@dataclass(frozen=True)
class PickSource:
    """The capture of a session, and the commands that work on it."""

    cloud: GaussianCloud
    """The capture, in its own frame."""
    placed: GaussianCloud
    """The same Gaussians in the frame of the page."""
    frame: BodyFrame
    """Frame of the page in the capture."""
    name: str
    path: Path
    """File to which the picked objects are written."""
    commands: PickCommands
    first: Callable[[], Sequence[PickedObject]] = tuple
    """Function that returns the initial objects, in the frame of the capture, from a file or from the command line."""
    cameras: Sequence[Camera] = ()
    """Cameras of the capture, in the capture's frame; empty if they are unknown."""
    film: str | None = None
    """Motion of the film that the owner of the session makes when the user requests it; None if the page starts
    ``commands`` itself."""


class PickSession:
    """Picked objects of a page, the thread that changes them, and the events for the page."""

    def __init__(self, source: PickSource) -> None:
        """Create a session without starting its threads."""
        self.source = source
        self._graph: ClickGraph | None = None
        up = np.array([0.0, 0.0, 1.0])
        empty = Pick("object 1", Plane(up, 0.0), np.zeros(source.cloud.count, bool))
        self._history = PickHistory(PickState((empty,)))
        self._changed = threading.Condition()
        self._inbox: deque[PickMessage] = deque(maxlen=200)
        self._events: dict[str, dict[str, Any]] = {}
        self._queued: list[dict[str, Any]] = []
        self._wake: Callable[[], object] = lambda: None
        self._is_stopping, self._unmeasured = False, threading.Event()
        self._busy = "preparing the capture"
        self._jobs: dict[str, Job] = {}
        self.has_film_request = threading.Event()
        """Event that is set when the file has been written and the film of ``PickSource.film`` is to be made."""
        self._thread = threading.Thread(target=self._run_loop, name="pick", daemon=True)
        self._measuring = threading.Thread(target=self._measure_loop, name="pick measurements", daemon=True)

    # The following methods may be called from any thread.

    @property
    def state(self) -> PickState:
        """The current objects."""
        return self._history.state

    def start(self) -> None:
        """Start the threads. The session first proposes an object."""
        self._thread.start()
        self._measuring.start()

    def stop(self) -> None:
        """End the threads, and the commands that were started."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()
        self._unmeasured.set()
        if self._thread.is_alive():
            self._thread.join()
        for job in self._jobs.values():
            job.stop()

    def put_request(self, message: PickMessage) -> None:
        """Queue a message of the page."""
        with self._changed:
            self._inbox.append(message)
            self._changed.notify_all()

    def subscribe(self, wake: Callable[[], object]) -> None:
        """Subscribe a page; ``wake`` is called when ``take_events`` has new entries."""
        with self._changed:
            self._wake = wake
            self._queued = list(self._events.values())
        wake()

    def unsubscribe(self) -> None:
        """Unsubscribe the page."""
        with self._changed:
            self._wake, self._queued = lambda: None, []

    def take_events(self) -> list[dict[str, Any]]:
        """Return and remove the queued events."""
        with self._changed:
            events, self._queued = self._queued, []
        return events

    def _send(self, event: dict[str, Any], *, lasting: bool = True) -> None:
        """Queue an event. A ``lasting`` event replaces the last one of its type, and it is sent again to pages that
        open later."""
        with self._changed:
            if lasting:
                self._events[event["type"]] = event
                self._queued = [one for one in self._queued if one["type"] != event["type"]]
            self._queued.append(event)
            wake = self._wake
        wake()

    def _send_line(self, text: str) -> None:
        self._send({"type": "told", "text": text}, lasting=False)

    # The following methods are called from the thread of the session.

    def _run_loop(self) -> None:
        self.prepare()
        while True:
            with self._changed:
                while not self._is_stopping and not self._inbox:
                    self._changed.wait()
                if self._is_stopping:
                    return
                message = self._inbox.popleft()
            try:
                self.apply(message)
            except UserError as error:
                self._send_line(str(error))
            self._set_busy("")

    def prepare(self) -> None:
        """Prepare the graph of the capture, and propose objects."""
        self._set_busy("preparing the capture")
        self._graph = ClickGraph.of(self.source.placed)
        self._set_busy("looking for the ground and the object")
        try:
            given = self.source.first()
        except UserError as error:
            self._send_line(str(error))
            given = ()
        cameras = [self.source.frame.camera(one) for one in self.source.cameras]
        if given:
            state = PickState(tuple(self._from_file(one) for one in given))
        else:
            state = PickState((proposed(self._graph, np.array([0.0, 0.0, 1.0]), cameras=cameras),))
        self._history = PickHistory(state)
        camera = view_of_object(self.source.placed, state.pick.mask, cameras)
        if camera is not None:
            self._send({"type": "view", "camera": camera})
        self._set_busy("")
        self._show()

    def apply(self, message: PickMessage) -> None:
        """Apply one message. Raises ``UserError`` if the message cannot be applied."""
        graph, state = self._graph, self.state
        assert graph is not None
        if isinstance(message, Mark):
            self._mark(graph, message)
        elif isinstance(message, MovePlane):
            self._set_busy("finding the object above the ground")
            moved = replace(state.pick, plane=message.plane, is_plane_given=True, is_guess=False)
            self._change(state.with_pick(resegmented(graph, moved)))
        elif isinstance(message, TurnFront):
            self._change(state.with_pick(replace(state.pick, front=message.direction)))
        elif isinstance(message, AddObject):
            if len(state.picks) >= MAX_OBJECTS:
                raise UserError(f"there are {MAX_OBJECTS} objects; remove one first")
            empty = np.zeros_like(state.pick.mask)
            plane, given = state.pick.scene_plane, state.pick.is_plane_given
            self._change(state.with_new(Pick(state.free_name(), plane, empty, is_plane_given=given)))
        elif isinstance(message, SelectObject):
            self._history.amend(state.selecting(message.index))
            self._show()
        elif isinstance(message, RemoveObject):
            self._change(state.without_active())
        elif isinstance(message, RenameObject):
            if any(one.name == message.name for k, one in enumerate(state.picks) if k != state.active):
                raise UserError(f"another object is named {message.name}; give another name")
            self._change(state.with_pick(replace(state.pick, name=message.name)))
        elif isinstance(message, Undo):
            if self._history.move(redo=message.redo):
                self._show()
        elif isinstance(message, Save):
            self.save()
        elif isinstance(message, RunAnimate):
            self._run("animate", message.motion)
        elif isinstance(message, RunLive):
            self._run("live", None)

    def _mark(self, graph: ClickGraph, message: Mark) -> None:
        self._set_busy("finding the object")
        pick = self.state.pick
        click = stroke_at(graph.cloud, message.camera, message.pixels, inside=message.inside)
        if click is None:
            raise UserError("nothing is there; click on the object")
        if not message.inside and not pick.mask.any():
            raise UserError("nothing is selected yet; click on the object first")
        is_first = not any(one.inside for one in pick.clicks)
        after = marked(graph, pick, click)
        self._change(self.state.with_pick(after))
        is_new = is_first and click.inside and after.proposal is None
        if after.is_plane_given if is_new else is_grounded(graph, after):
            return
        self._set_busy("looking for the surface under it")
        if is_new:
            # A stroke marks more than the object at one point, and photos show more than a point.
            is_point = len(message.pixels) == 1 and not self.source.cameras
            standing = located(graph, after) if is_point else after
            standing = on_table_top(graph, after) if standing is after else standing
        else:
            standing = regrounded(graph, after)
        if standing is not after:
            self._history.amend(self.state.with_pick(standing))
            self._show()

    def _change(self, state: PickState) -> None:
        self._history.push(state)
        self._show()

    def _show(self) -> None:
        """Send the current state to the page, and measure the active object later."""
        self._events.pop("body", None)
        self._events.pop("ground", None)
        self._unmeasured.set()
        labels = base64.b64encode(self.state.labels().tobytes()).decode()
        self._send({"type": "labels", "data": labels})
        self._send(self.pick_event())

    def pick_event(self) -> dict[str, Any]:
        """Return the event ``pick``: the objects, the ground and front of the active one, and whether changes can be
        undone or redone."""
        state, graph = self.state, self._graph
        pick = state.pick
        size = 0.0
        anchor = np.array([0.0, 0.0, 0.0])
        if graph is not None and pick.mask.any():
            low, anchor, high = np.quantile(graph.means[pick.mask], [0.05, 0.5, 0.95], axis=0)
            size = float(np.linalg.norm(high - low))
        warnings = [*(pick_warnings(graph, pick) if graph is not None else ()), *state.overlaps()]
        anchor = anchor - float(pick.plane.heights(anchor)) * pick.plane.normal
        return {
            "type": "pick",
            "objects": [{"name": one.name, "count": int(one.mask.sum())} for one in state.picks],
            "active": state.active,
            "plane": [*pick.plane.normal.tolist(), pick.plane.offset],
            "anchor": anchor.tolist(),
            "size": size or 1.0,
            "front": None if pick.front is None else pick.front.tolist(),
            "undo": self._history.can_undo,
            "redo": self._history.can_redo,
            "warnings": warnings,
            "proposal": pick.is_guess,
        }

    def _set_busy(self, text: str) -> None:
        if text != self._busy or "work" not in self._events:
            self._busy = text
            self._send({"type": "work", "text": text})

    # The following method runs in the thread of the measurements, which take longer than the time between clicks.

    def _measure_loop(self) -> None:
        while True:
            self._unmeasured.wait()
            # Wait until the user has paused.
            while self._unmeasured.is_set() and not self._is_stopping:
                self._unmeasured.clear()
                self._unmeasured.wait(_MEASURE_DELAY)
            if self._is_stopping:
                return
            pick = self.state.pick
            if pick.mask.any():
                self._send({**_NO_BODY, "measuring": True})
            event = self._body_event(pick)
            # Discard measurements of an earlier selection.
            if self.state.pick is pick:
                self._send(event)
                grid = self.ground_grid(pick)
                if self.state.pick is pick:
                    self._send({"type": "ground", "grid": grid})

    def _body_event(self, pick: Pick) -> dict[str, Any]:
        """Return the event ``body``: size, support, front and possible motions of an object."""
        if not pick.mask.any():
            return _NO_BODY
        placed = self.source.placed
        warnings = photo_warnings(self.source.cloud, pick.mask, self.source.cameras)
        above = pick.mask & (pick.plane.heights(placed.means.numpy()) > 0.0)
        if not above.any():
            return _NO_BODY
        try:
            info = inspect_capture(placed.subset(above), plane=pick.plane, front=pick.front, nodes=_MEASURE_NODES)
        except UserError as error:
            return {**_NO_BODY, "rows": [["problem", text] for text in (*warnings, str(error))]}
        height = info.body.height / info.standing.frame.scale / self.source.frame.scale
        return {
            **_NO_BODY,
            "rows": [
                *(["problem", text] for text in warnings),
                ["height", f"{height:.3g} units of the capture"],
                ["stands on", info.stands()],
            ],
            "motions": self._motions(info),
            "front": (info.standing.frame.axes.T @ info.front.direction).tolist(),
        }

    def ground_grid(self, pick: Pick) -> dict[str, Any] | None:
        """Return the uneven ground around an object in the frame of the page, with the heights of the grid's nodes row
        by row; None if the ground is flat or cannot be measured."""
        source, frame = self.source, self.source.frame
        ground = ground_around(source.cloud, pick.mask, plane_in_capture(pick.plane, frame), source.cameras)
        if ground is None:
            return None
        nodes = ground.nodes()
        middle = len(nodes) // 2
        reach = round(_GRID_REACH / REACH * middle)
        rows = np.arange(middle - reach, middle + reach + 1, _GRID_STEP)
        heights = ground.plane.heights(nodes[rows][:, rows]) * frame.scale
        first = ground.origin + ground.spacing * rows[0] * (ground.axes[0] + ground.axes[1])
        return {
            "origin": frame.points(first).tolist(),
            "first": (frame.axes @ ground.axes[0]).tolist(),
            "second": (frame.axes @ ground.axes[1]).tolist(),
            "spacing": _GRID_STEP * ground.spacing * frame.scale,
            "count": len(rows),
            "heights": np.round(heights, 5).ravel().tolist(),
        }

    def _motions(self, info: BodyInfo) -> list[dict[str, str | None]]:
        """Return the motions that the page offers; each motion that the object cannot perform has a reason."""
        if self.source.film is not None:
            return [{"name": self.source.film, "why": None}]
        return [{"name": n, "why": w} for n, w in info.motions().items() if MOTIONS[n].file is None]

    # The following methods are called from the thread of the session.

    def save(self) -> None:
        """Write the file. Raises ``UserError`` if no object has Gaussians."""
        state, frame = self.state, self.source.frame
        picks = [one for one in state.picks if one.mask.any()]
        if not picks:
            raise UserError("nothing is selected; click on the object first")
        selected = next((k for k, one in enumerate(picks) if one is state.pick), 0)
        objects = tuple(
            PickedObject(
                one.name,
                one.mask,
                PlaneRecord(plane_in_capture(one.plane, frame)),
                None if one.front is None else frame.axes.T @ one.front,
            )
            for one in picks
        )
        self.source.path.parent.mkdir(parents=True, exist_ok=True)
        write_picked(self.source.path, PickedFile(self.source.name, objects, selected), self.source.cloud)
        self._send_line(f"wrote {self.source.path}")

    def _from_file(self, one: PickedObject) -> Pick:
        plane = self.source.frame.plane(one.plane.plane)
        front = None if one.front is None else self.source.frame.axes @ one.front
        mask = one.gaussians
        return Pick(one.name, plane, mask, front=front, proposal=mask, is_plane_given=True)

    def _run(self, kind: str, motion: str | None) -> None:
        """Write the file and start ``animate`` or ``live`` with the active object."""
        pick = self.state.pick
        if not pick.mask.any():
            raise UserError("nothing is selected; click on the object first")
        if kind == "animate" and self.source.film is not None:
            self.save()
            text = "is made in the terminal; this page can be closed"
            self._send({"type": "animate", "text": text, "running": False, "failed": False})
            self.has_film_request.set()
            return
        running = self._jobs.get(kind)
        if running is not None and running.is_running:
            if kind == "animate":
                raise UserError("a film is being made; wait until it is done")
            running.stop()
        self.save()
        value, folder = f"{self.source.path}:{pick.name}", None
        if motion is None:
            arguments = self.source.commands.live(value)
        else:
            arguments, folder = self.source.commands.animate(value, motion)
        self._start(kind, arguments, folder)

    def _start(self, kind: str, arguments: Sequence[str], folder: Path | None) -> None:
        def send(text: str, *, is_running: bool, address: str | None = None, failed: bool = False) -> None:
            event = {"type": kind, "text": text, "running": is_running, "failed": failed}
            self._send(event if address is None else {**event, "address": address})

        def ended(status: int, last: str) -> None:
            # With exit status 3, the film has been written, but the motion differs from the request.
            if folder is None or status not in (0, 3):
                send(last, is_running=False, failed=status != 0)
                return
            viewing = Job(
                self.source.commands.view(folder),
                on_line=lambda line: None,
                on_address=lambda address: send(last, is_running=False, address=address),
                on_end=lambda *_: None,
            )
            self._jobs["view"] = viewing

        if kind == "animate" and "view" in self._jobs:
            self._jobs.pop("view").stop()
        send("starting", is_running=True)
        self._jobs[kind] = Job(
            arguments,
            on_line=lambda line: send(line, is_running=True),
            on_address=lambda address: send("", is_running=True, address=address),
            on_end=ended,
        )


def plane_in_capture(plane: Plane, frame: BodyFrame) -> Plane:
    """Transform ``plane`` from the frame of the page to the frame of the capture."""
    normal = frame.axes.T @ plane.normal
    return Plane(normal, plane.offset / frame.scale - float(normal @ frame.origin))
