"""A creature that lives while it is watched: its solver steps in a thread and does what messages ask.

A step takes the time that it takes; where that is less than the time that it covers, the thread waits for the clock.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.motions.push import kick_of
from egs_warp.motions.script import MOST_MOTIONS
from egs_warp.pipelines.creature import Creature, changed_creature, first_place
from egs_warp.pipelines.drawn import DrawnCreature
from egs_warp.web.messages import (
    Cancel,
    Change,
    Go,
    Hit,
    Message,
    Pause,
    Perform,
    Pull,
    Record,
    Release,
    Restyle,
    StandUp,
    Steer,
    Step,
    TellScript,
)
from egs_warp.web.moments import frame_of
from egs_warp.web.packets import Frame
from egs_warp.web.spring import Spring
from egs_warp.web.standing import tilt_degrees
from egs_warp.web.steering import FALLEN, Steering
from egs_warp.web.takes import LONGEST_TAKE, Take, script_text

_MOST_WAITING = 240
"""Frames for a page that is slow to take them; older ones are dropped."""
_MOST_ASKED = 1000
"""Messages that wait for a step to end."""
_STILL = 2e-3
"""sqrt(g H): a body whose nodes move no faster, root mean square, and that has nothing to do, is left at rest, without
steps."""
_STILL_TIME = 0.3
"""Seconds for which that holds first."""


@dataclass(frozen=True)
class SessionOptions:
    """What does not change while it lives."""

    source: str = "capture"
    """Name of the capture, for reports."""
    takes: Path = Path("out/live")
    """Folder for what is recorded."""
    muscles_file: Path | None = None
    sag: float = DEFAULT_SAG
    """With which ``creature`` was made."""


class Session:
    """One creature, its thread, and what is to be sent of it."""

    def __init__(self, creature: Creature, drawn_as: DrawnCreature, options: SessionOptions | None = None) -> None:
        self.options = options or SessionOptions()
        self.creature, self.drawn_as = creature, drawn_as
        self.sag, self.friction = self.options.sag, creature.geometry.friction
        self.state, self.report = creature.start, None
        self._memory = creature.stepper.initial_memory()
        self._dt, _ = solver_steps(creature.body)
        self._place = first_place(creature)
        self.steering = Steering(self._place, self._tell)
        self._spring: Spring | None = None
        self._hits: list[Hit] = []
        """Of the next step."""
        self._take: Take | None = None
        self._paused, self._single_steps = False, 0
        self._still_since: float | None = None
        self._watched = False
        self._index = 0
        self._inbox: deque[Message] = deque(maxlen=_MOST_ASKED)
        self._outbox: deque[Frame | dict[str, Any]] = deque()
        self._changed = threading.Condition()
        self._wake: Callable[[], object] = lambda: None
        self._told_state: dict[str, Any] = {}
        self._stopping = False
        self._thread = threading.Thread(target=self._live, name="session", daemon=True)
        self._due = time.perf_counter()

    # Of any thread.

    def start(self) -> None:
        """Begin to live; nothing moves until it is watched."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and write the take that was going on."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def ask(self, message: Message) -> None:
        """Leave a message; it is obeyed before the next step."""
        with self._changed:
            self._inbox.append(message)
            self._changed.notify_all()

    def watch(self, wake: Callable[[], object]) -> None:
        """Live on; ``wake`` is called, from the session's thread, when ``waiting`` has something. It begins with how
        things stand."""
        with self._changed:
            self._watched, self._wake = True, wake
            self._outbox.clear()
            self._told_state = {}
            self._outbox.append(self._frame())
            self._changed.notify_all()
        wake()

    def unwatch(self) -> None:
        """Nobody watches: hold still, and let go of what is pulled."""
        with self._changed:
            self._watched, self._wake = False, lambda: None
            self._inbox.append(Release())

    def waiting(self) -> list[Frame | dict[str, Any]]:
        """Frames and news since the last call."""
        with self._changed:
            taken = list(self._outbox)
            self._outbox.clear()
        return taken

    # Of the session's own thread.

    def _live(self) -> None:
        while self._await_turn():
            self.obey()
            if not self._held:
                self.advance()
                self._keep_time()
            self._tell_state()
        if self._take is not None:
            self._end_take()

    @property
    def _held(self) -> bool:
        if not self._watched:
            return True
        return self._single_steps == 0 and (self._paused or self.resting)

    @property
    def resting(self) -> bool:
        """Whether it stands still with nothing to do; the next thing asked for goes on from there."""
        if self._still_since is None or not self.steering.idle or self._take is not None:
            return False
        if self._spring is not None or self._hits:
            return False
        return self.state.time - self._still_since >= _STILL_TIME

    def _await_turn(self) -> bool:
        """Wait until there is something to do; False at the end."""
        with self._changed:
            while not self._stopping and self._held and not self._inbox and self._told_state:
                self._changed.wait()
                self._due = time.perf_counter()
            return not self._stopping

    def _keep_time(self) -> None:
        now = time.perf_counter()
        self._due = max(self._due + self._dt, now - 2.0 * self._dt)
        while (left := self._due - time.perf_counter()) > 0.0 and not self._stopping:
            with self._changed:
                if self._inbox:
                    return
                self._changed.wait(left)

    def advance(self) -> None:
        """One step of the solver."""
        self._single_steps = max(self._single_steps - 1, 0)
        before = self.state
        try:
            objectives = self.steering.objectives(before, self.report, self._dt)
            kick = self._kick(before)
            stepper = self.creature.stepper
            start = before.kicked(kick)
            self.state, self._memory, reports = stepper.advance(start, self._memory, objectives, self._dt)
            if not np.isfinite(self.state.positions).all():
                raise FloatingPointError("positions are not finite")
        # A step that goes wrong must not end a session.
        except Exception as error:
            print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
            self._tell("the solver found no way on; the creature stands where it began")
            self.state = before
            self._stand_up()
            return
        self.report = reports[-1]
        body, velocities = self.creature.body, self.state.velocities
        speed = np.sqrt(body.node_mass @ (velocities**2).sum(axis=1) / body.mass)
        if speed > _STILL * body.speed_unit:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = self.state.time
        if self._take is not None:
            self._take.add(reports, kick=kick)
            if self._take.seconds >= LONGEST_TAKE:
                self._tell(f"a take has at most {LONGEST_TAKE:g} s")
                self._end_take()
        self._index += 1
        self._send(self._frame())

    def _kick(self, state: BodyState) -> np.ndarray | None:
        """(N, 3) m/s that the user's pull, and pushes since the last step, give the nodes; None if there are none."""
        hits, self._hits = self._hits, []
        kicks = [kick_of(self._place, np.array(hit.impulse), hit.height) for hit in hits]
        if self._spring is not None:
            kicks.append(self._spring.kick(state, self._dt))
        return np.sum(kicks, axis=0) if kicks else None

    def obey(self) -> None:
        """Do what the messages ask that came since."""
        with self._changed:
            messages = list(self._inbox)
            self._inbox.clear()
        for message in messages:
            try:
                self._do(message)
            # What goes wrong with one message must not end a session.
            except Exception as error:
                print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
                self._tell(f"that did not work: {str(error)[:200]}")

    def _do(self, message: Message) -> None:
        match message:
            case Perform(script):
                self.steering.perform(script)
            case Go(point):
                self.steering.go(np.array(point))
            case Steer(command):
                self.steering.drive(command)
            case Cancel():
                self.steering.cancel()
            case Pull(node, target):
                if self._spring is None or self._spring.node != node:
                    self._spring = Spring(self.creature.body, node)
                self._spring.target = np.array(target)
            case Release():
                self._spring = None
            case Hit():
                self._hits.append(message)
            case Change():
                self._change(message)
            case Restyle(style):
                self.steering.style = style
            case Pause(on):
                self._paused = on
                self._due = time.perf_counter()
            case Step():
                self._single_steps += 1 if self._paused else 0
            case StandUp():
                self._stand_up()
            case Record(on):
                self._record(on)
            case TellScript():
                requests = self.steering.requests[-MOST_MOTIONS:]
                self._send({"type": "script", "text": script_text(requests), "motions": len(requests)})

    def _stand_up(self) -> None:
        self._end_take()
        self._spring = self._still_since = None
        self._hits.clear()
        still = np.zeros_like(self.state.velocities)
        self.state = BodyState(self.creature.start.positions.copy(), still, self.state.time)
        self.report = None
        self._memory = self.creature.stepper.initial_memory()
        self.steering.stand(self._place)
        self._index += 1
        self._send(self._frame())

    def _change(self, wish: Change) -> None:
        """The same creature, as it stands, with another friction or stiffness."""
        friction = self.friction if wish.friction is None else wish.friction
        sag = self.sag if wish.sag is None else wish.sag
        if (friction, sag) == (self.friction, self.sag):
            return
        self._end_take()
        self._send({"type": "busy", "on": True})
        try:
            made = changed_creature(self.creature, friction=friction, sag=sag, muscles_file=self.options.muscles_file)
            place = first_place(made)
            if sag != self.sag and tilt_degrees(self._place, made.start.positions) > FALLEN:
                raise UserError(f"sag {sag:g}: so soft a body does not stand; choose a smaller one")
        except (UserError, FloatingPointError, np.linalg.LinAlgError) as error:
            self._tell(str(error))
            self._send({"type": "busy", "on": False})
            return
        self.creature, self.friction, self.sag, self._place = made, friction, sag, place
        self._still_since = None
        # Contacts and activations of the old body are as good a guess as any for the new one.
        self.steering.place = place
        self._due = time.perf_counter()
        self._send({"type": "busy", "on": False})

    def _record(self, on: bool) -> None:
        if on and self._take is None:
            self._take = Take(self.creature, self.state)
        elif not on:
            self._end_take()

    def _end_take(self) -> None:
        take, self._take = self._take, None
        if take is None:
            return
        if not take.reports:
            self._tell("nothing has moved since the take began; there is nothing to write")
            return
        self._send({"type": "busy", "on": True})
        try:
            path = take.write(
                self.options.takes,
                self.drawn_as,
                self.steering.begun,
                self.steering.requests,
                source=self.options.source,
                asked={"live": True, "friction": self.friction, "sag": self.sag},
                driven=[time for time in self.steering.driven if time >= take.start.time],
            )
            self._tell(f"wrote {path} ({take.seconds:.1f} s); egs-warp view {path}")
        except (UserError, OSError) as error:
            self._tell(f"the take could not be written: {error}")
        self._send({"type": "busy", "on": False})

    # What is sent.

    def _frame(self) -> Frame:
        return frame_of(self._index, self.state, self.report, self.creature)

    def _send(self, news: Frame | dict[str, Any]) -> None:
        with self._changed:
            if not self._watched:
                return
            self._outbox.append(news)
            if len(self._outbox) > _MOST_WAITING:
                oldest = next((one for one in self._outbox if isinstance(one, Frame)), None)
                if oldest is not None:
                    self._outbox.remove(oldest)
            wake = self._wake
        wake()

    def _tell(self, line: str) -> None:
        self._send({"type": "told", "text": line})

    def _tell_state(self) -> None:
        news = self.standing()
        if news != self._told_state:
            self._told_state = dict(news)
            self._send(dict(news))

    def standing(self) -> Mapping[str, Any]:
        """How things stand, beside the frames."""
        steering, goal = self.steering, self.steering.goal
        return {
            "type": "state",
            "doing": steering.doing,
            "queued": steering.queued,
            "walks": steering.walks,
            "goal": None if goal is None else [round(float(x), 6) for x in goal],
            "facing": [round(float(x), 2) for x in steering.facing(self.state.positions)],
            "paused": self._paused,
            "resting": self.resting,
            "recording": self._take is not None,
            "pulled": self._spring is not None,
            "friction": self.friction,
            "sag": self.sag,
            "style": vars(steering.style),
            "motions": len(steering.begun),
            "step": self._dt,
        }
