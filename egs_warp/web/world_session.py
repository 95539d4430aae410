"""Live session of a world: a thread that simulates all bodies; each page steers one creature.

Each creature has its own queue of motions. Messages from a page go to the creature that the page has selected; pausing,
single steps and resets affect the whole world.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.rollout import support_report
from egs_warp.locomotion.stepper import StepReport, WarmStart
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.locomotion.world_rollout import world_steps
from egs_warp.motions.script import MAX_MOTIONS
from egs_warp.motions.sequence import Stance
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.world import PlacedBody, World
from egs_warp.short_repr import short_repr
from egs_warp.web.frame_encoding import encode_frame
from egs_warp.web.idle import StillnessDetector
from egs_warp.web.joint_header import PageBody, joint_positions
from egs_warp.web.mailbox import Mailbox
from egs_warp.web.messages import (
    STYLE_NAMES,
    Cancel,
    Change,
    GoTo,
    Message,
    Pause,
    PlayScript,
    Pull,
    PushOnce,
    Record,
    Release,
    RequestScript,
    Restyle,
    StandUp,
    Steer,
    Step,
)
from egs_warp.web.packets import Frame
from egs_warp.web.recordings import script_text
from egs_warp.web.steering import MotionScheduler
from egs_warp.web.user_forces import UserForces


@dataclass
class SteeredBody:
    """A body of the session and its state; a creature also has a queue of motions."""

    __repr__ = short_repr

    index: int
    """Index of the body in the world."""
    member: PlacedBody
    state: BodyState
    memory: WarmStart
    report: StepReport | None = None
    place: Stance | None = None
    """Stance at the start; None for a prop."""
    steering: MotionScheduler | None = None
    """Queue of motions; None for a prop."""
    forces: UserForces = field(default_factory=UserForces)
    puller: WorldPage | None = None
    """Page whose user pulls the body; None if no user does."""
    stillness: StillnessDetector = field(default_factory=StillnessDetector)

    @property
    def is_resting(self) -> bool:
        """True if the body is still and has no task, and its path, if any, has ended."""
        path = self.member.path
        if path is not None and (path.repeat or self.state.time < path.end):
            return False
        is_idle = self.steering is None or self.steering.idle
        return is_idle and not self.forces.has_input and self.stillness.is_still(self.state)

    def objectives(self, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the next step."""
        if self.steering is None:
            return ()
        report = None if self.report is None else support_report(self.member.body.stepper, self.index, self.report)
        return self.steering.objectives(self.state, report, dt)

    def release(self, page: WorldPage) -> None:
        """End the pull by ``page``, if this page pulls the body."""
        if self.puller is page:
            self.forces.release()
            self.puller = None

    def pushed(self, dt: float) -> BodyState:
        """Return the state with the velocities changed by the pull and the pushes of the user."""
        if self.place is None:
            return self.state
        return self.state.with_velocity_kick(self.forces.kick(self.place, self.state, dt))


class WorldPage:
    """A page of the session, with its mailbox and the creature that it steers."""

    def __init__(self, session: WorldSession, selected: int) -> None:
        self.session, self.selected = session, selected
        self.mailbox = Mailbox(session.changed)

    def put_request(self, message: Message) -> None:
        """Queue a message for the selected creature; it is handled before the next step."""
        self.mailbox.put_request(message)

    def select(self, name: str) -> None:
        """Steer the creature ``name`` from now on; a pull by this page ends. Raises ``ValueError`` if no
        creature has this name."""
        index = next((i for i, body in enumerate(self.session.bodies) if body.member.name == name), None)
        if index is None or self.session.bodies[index].steering is None:
            names = [body.member.name for body in self.session.bodies if body.steering is not None]
            raise ValueError(f"select: {name[:40]!r} is not a creature of this world; give {', '.join(names)}")
        self.session.select(self, index)


class WorldSession:
    """The bodies of a world, the thread that simulates them, and the pages that steer them."""

    def __init__(self, world: World, page_bodies: Sequence[PageBody]) -> None:
        """Create a session without starting its thread. Raises ``UserError`` for a world without a creature."""
        if not any(isinstance(member.body, Creature) for member in world.members):
            raise UserError("world: it has no creature to steer; remove prop: true from a body")
        self.world, self.page_bodies = world, tuple(page_bodies)
        self.changed = threading.Condition()
        """Condition that the mailboxes of all pages share."""
        self.pages: list[WorldPage] = []
        self._stepper = world.stepper()
        self._dt, _ = world_steps([member.body.body for member in world.members])
        memories = self._stepper.initial_memories()
        self.bodies = [
            SteeredBody(index, member, member.body.start, memory)
            for index, (member, memory) in enumerate(zip(world.members, memories, strict=True))
        ]
        for body in self.bodies:
            if isinstance(body.member.body, Creature):
                body.place = initial_stance(body.member.body, step=self._dt)
                body.steering = MotionScheduler(body.place, lambda line, body=body: self._send_line(body, line))
        self._paused, self._single_steps, self._index = False, 0, 0
        self._stopping = False
        self._thread = threading.Thread(target=self._run_loop, name="world session", daemon=True)
        self._due = time.perf_counter()

    # The following methods may be called from any thread.

    def start(self) -> None:
        """Start the thread; the simulation starts when a page subscribes."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        with self.changed:
            self._stopping = True
            self.changed.notify_all()
        for page in self.pages:
            page.mailbox.stop()
        if self._thread.is_alive():
            self._thread.join()

    def connect(self) -> WorldPage:
        """Add a page, which steers the first creature that no other page steers yet."""
        with self.changed:
            steered = {page.selected for page in self.pages}
            creatures = [index for index, body in enumerate(self.bodies) if body.steering is not None]
            selected = next((index for index in creatures if index not in steered), creatures[0])
            page = WorldPage(self, selected)
            self.pages.append(page)
        return page

    def disconnect(self, page: WorldPage) -> None:
        """Remove a page, and end its pull."""
        with self.changed:
            self.pages.remove(page)
            self.bodies[page.selected].release(page)

    def select(self, page: WorldPage, index: int) -> None:
        """Let a page steer the body ``index``."""
        with self.changed:
            self.bodies[page.selected].release(page)
            page.selected = index
            others = [other for other in self.pages if other is not page and other.selected == index]
            self.changed.notify_all()
        if others:
            page.mailbox.send_line(f"another page steers {self.bodies[index].member.name}, too")
        page.mailbox.send_state(self.state_message(page))

    # The following methods are called from the thread of the session.

    def _run_loop(self) -> None:
        while self._wait_for_work():
            self.process_requests()
            if not self._is_suspended:
                self.advance()
                self._wait_for_clock()
            for page in list(self.pages):
                page.mailbox.send_state(self.state_message(page))

    def _wait_for_work(self) -> bool:
        with self.changed:
            while not self._stopping and self._is_suspended and not any(p.mailbox.has_work for p in self.pages):
                self.changed.wait()
                self._due = time.perf_counter()
            return not self._stopping

    @property
    def _is_suspended(self) -> bool:
        """True if no step has to be computed: no page is open; or no single steps are requested, and the session is
        paused or all bodies are at rest."""
        if not any(page.mailbox.watched for page in self.pages):
            return True
        return self._single_steps == 0 and (self._paused or self.resting)

    @property
    def resting(self) -> bool:
        """True if all bodies are still and no creature has a task."""
        return all(body.is_resting for body in self.bodies)

    def _wait_for_clock(self) -> None:
        """Wait until the next step is due; a session that is late catches up by at most two steps."""
        self._due = max(self._due + self._dt, time.perf_counter() - 2.0 * self._dt)
        while (seconds := self._due - time.perf_counter()) > 0.0 and not self._stopping:
            with self.changed:
                if any(page.mailbox.has_requests for page in self.pages):
                    return
                self.changed.wait(seconds)

    def advance(self) -> None:
        """Compute one step of all bodies and send the resulting frame. If the step fails, put all bodies back to their
        start."""
        self._single_steps = max(self._single_steps - 1, 0)
        try:
            with one_blas_thread():
                objectives = [body.objectives(self._dt) for body in self.bodies]
            states = [body.pushed(self._dt) for body in self.bodies]
            done = self._stepper.advance(states, [body.memory for body in self.bodies], objectives, self._dt)
            if not all(np.isfinite(reports[-1].state.positions).all() for reports in done):
                raise FloatingPointError("positions are not finite")
        # An error in a step must not end the session.
        except Exception as error:
            print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
            self._send_line_to_all("the solver failed; all bodies are back at their start")
            self._reset()
            return
        for body, reports in zip(self.bodies, done, strict=True):
            body.report = reports[-1]
            body.state, body.memory = reports[-1].state, WarmStart.from_report(reports[-1])
            body.stillness.update(body.member.body.body, body.state)
        self._index += 1
        self._send_frame()

    def process_requests(self) -> None:
        """Handle the queued messages of all pages."""
        for page in list(self.pages):
            for message in page.mailbox.take_requests():
                try:
                    self._do(page, message)
                # An error in a message must not end the session.
                except Exception as error:
                    print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
                    page.mailbox.send_line(f"the command failed: {str(error)[:200]}")

    def _do(self, page: WorldPage, message: Message) -> None:
        body = self.bodies[page.selected]
        steering = body.steering
        assert steering is not None
        match message:
            case PlayScript(script):
                steering.perform(script)
            case GoTo(point):
                steering.go(np.array(point))
            case Steer(command):
                steering.drive(command)
            case Cancel():
                steering.cancel()
            case Pull(node, target):
                self._pull(page, node, target)
            case Release():
                body.release(page)
            case PushOnce():
                body.forces.push(message)
            case Restyle(style):
                steering.style = style
            case Pause(on):
                self._paused = on
                self._due = time.perf_counter()
            case Step():
                self._single_steps += 1 if self._paused else 0
            case StandUp():
                self._reset()
            case RequestScript():
                requests = steering.requests[-MAX_MOTIONS:]
                news = {"type": "script", "text": script_text(requests), "motions": len(requests)}
                page.mailbox.send(news)
            case Change():
                page.mailbox.send_line("friction and stiffness of a world are those of its file; change them there")
            case Record():
                page.mailbox.send_line("a world records no takes; egs-warp animate writes its run")

    def _pull(self, page: WorldPage, node: int, target: tuple[float, float, float]) -> None:
        """Pull the selected creature at a joint node; a node of another body has no effect."""
        first = sum(len(body.cage.nodes) for body in self.page_bodies[: page.selected])
        body = self.bodies[page.selected]
        if first <= node < first + len(self.page_bodies[page.selected].cage.nodes):
            body.forces.pull(body.member.body.body, Pull(node - first, target))
            body.puller = page

    def _reset(self) -> None:
        """Put all bodies back to their start, except those that follow a path and those that joints connect to them."""
        memories, carried = self._stepper.initial_memories(), self._stepper.carried
        for index, (body, memory) in enumerate(zip(self.bodies, memories, strict=True)):
            if index in carried:
                continue
            start = body.member.body.start
            body.state = BodyState(start.positions.copy(), np.zeros_like(start.positions), body.state.time)
            body.memory, body.report = memory, None
            body.forces.clear()
            body.stillness.reset()
            if body.steering is not None and body.place is not None:
                body.steering.stand(body.place)
        self._index += 1
        self._send_frame()

    # The following methods create frames and events for the pages.

    def frame(self) -> Frame:
        """Return the current frame of all bodies."""
        frames = [
            encode_frame(self._index, body.state, body.report, body.member.body, world_index=body.index)
            for body in self.bodies
        ]
        return Frame(
            self._index,
            self.bodies[0].state.time,
            joint_positions(self.page_bodies, [frame.positions for frame in frames]),
            np.concatenate([frame.activations for frame in frames]),
            np.concatenate([frame.contacts for frame in frames]),
            np.concatenate([frame.curves for frame in frames]),
        )

    def _send_frame(self) -> None:
        frame = self.frame()
        for page in list(self.pages):
            page.mailbox.send(frame)

    def _send_line_to_all(self, line: str) -> None:
        for page in list(self.pages):
            page.mailbox.send_line(line)

    def _send_line(self, body: SteeredBody, line: str) -> None:
        """Send a line about a creature to all pages that steer it."""
        for page in list(self.pages):
            if self.bodies[page.selected] is body:
                page.mailbox.send_line(line)

    def state_message(self, page: WorldPage) -> Mapping[str, Any]:
        """Return the event ``state`` for a page; docs/guide/live.md lists its fields."""
        body = self.bodies[page.selected]
        steering = body.steering
        assert steering is not None
        goal = steering.goal
        doing = {each.member.name: each.steering.doing if each.steering else "" for each in self.bodies}
        return {
            "type": "state",
            "body": body.member.name,
            "bodies": doing,
            "doing": steering.doing,
            "queued": steering.queued,
            "walks": steering.walks,
            "goal": None if goal is None else [round(float(x), 6) for x in goal],
            "facing": [round(float(x), 2) for x in steering.facing(body.state.positions)],
            "paused": self._paused,
            "resting": self.resting,
            "recording": False,
            "pulled": body.forces.is_pulling,
            "friction": body.member.body.geometry.friction,
            "sag": 0.05,
            "style": {name: getattr(steering.style, name) for name in STYLE_NAMES},
            "motions": len(steering.records),
            "pushes": body.forces.push_count,
            "dropped_pushes": body.forces.dropped_count,
            "step": self._dt,
        }
