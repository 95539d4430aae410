"""A creature that lives while it is watched: its solver steps in a thread and does what messages ask.

A step takes the time that it takes; where that is less than the time that it covers, the thread waits for the clock.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.motions.script import MOST_MOTIONS
from egs_warp.pipelines.creature import Creature, changed_creature, initial_stance
from egs_warp.pipelines.render_data import RenderData
from egs_warp.web.frame_encoding import encode_frame
from egs_warp.web.idle import StillnessDetector, tilt_degrees
from egs_warp.web.mailbox import Mailbox, News
from egs_warp.web.messages import (
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
from egs_warp.web.recordings import MAX_TAKE_SECONDS, SessionRecording, script_text
from egs_warp.web.steering import FALLEN_TILT, MotionScheduler
from egs_warp.web.user_forces import UserForces


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

    def __init__(self, creature: Creature, drawn_as: RenderData, options: SessionOptions | None = None) -> None:
        self.options = options or SessionOptions()
        self.creature, self.drawn_as = creature, drawn_as
        self.sag, self.friction = self.options.sag, creature.geometry.friction
        self.state, self.report = creature.start, None
        self._memory = creature.stepper.initial_memory()
        self._dt, _ = solver_steps(creature.body)
        self._place = initial_stance(creature)
        self._mailbox = Mailbox()
        self.steering = MotionScheduler(self._place, self._mailbox.send_line)
        self._user_forces = UserForces()
        self._take: SessionRecording | None = None
        self._paused, self._single_steps = False, 0
        self._stillness = StillnessDetector()
        self._index = 0
        self._thread = threading.Thread(target=self._run_loop, name="session", daemon=True)
        self._due = time.perf_counter()

    # Of any thread.

    def start(self) -> None:
        """Begin to live; nothing moves until it is watched."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and write the take that was going on."""
        self._mailbox.stop()
        if self._thread.is_alive():
            self._thread.join()

    def put_request(self, message: Message) -> None:
        """Leave a message; it is obeyed before the next step."""
        self._mailbox.put_request(message)

    def subscribe(self, wake: Callable[[], object]) -> None:
        """Live on; ``wake`` is called, from the session's thread, when ``waiting`` has something: first how it is."""
        self._mailbox.subscribe(wake, self._frame)

    def unsubscribe(self) -> None:
        """Nobody watches: hold still, and let go of what is pulled."""
        self._mailbox.unsubscribe()

    def take_news(self) -> list[News]:
        """Frames and news since the last call."""
        return self._mailbox.take_news()

    # Of the session's own thread.

    def _run_loop(self) -> None:
        while self._mailbox.wait_for_work(lambda: self._is_suspended, self._reset_clock):
            self.process_requests()
            if not self._is_suspended:
                self.advance()
                self._wait_for_clock()
            self._mailbox.send_state(self.state_message())
        if self._take is not None:
            self._end_take()

    @property
    def _is_suspended(self) -> bool:
        if not self._mailbox.watched:
            return True
        return self._single_steps == 0 and (self._paused or self.resting)

    @property
    def resting(self) -> bool:
        """Whether it stands still with nothing to do; the next thing asked for goes on from there."""
        if not self.steering.idle or self._take is not None or self._user_forces.has_input:
            return False
        return self._stillness.is_still(self.state)

    def _reset_clock(self) -> None:
        """What was waited for is not caught up."""
        self._due = time.perf_counter()

    def _wait_for_clock(self) -> None:
        self._due = max(self._due + self._dt, time.perf_counter() - 2.0 * self._dt)
        self._mailbox.wait_until(lambda: self._due - time.perf_counter())

    def advance(self) -> None:
        """One step of the solver."""
        self._single_steps = max(self._single_steps - 1, 0)
        before = self.state
        try:
            with one_blas_thread():
                objectives = self.steering.objectives(before, self.report, self._dt)
            kick = self._user_forces.kick(self._place, before, self._dt)
            stepper, start = self.creature.stepper, before.with_velocity_kick(kick)
            self.state, self._memory, reports = stepper.advance(start, self._memory, objectives, self._dt)
            if not np.isfinite(self.state.positions).all():
                raise FloatingPointError("positions are not finite")
        # A step that goes wrong must not end a session.
        except Exception as error:
            print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
            self._mailbox.send_line("the solver found no way on; the creature stands where it began")
            self.state = before
            self._stand_up()
            return
        self.report = reports[-1]
        self._stillness.update(self.creature.body, self.state)
        if self._take is not None:
            self._take.add(reports, kick=kick)
            if self._take.seconds >= MAX_TAKE_SECONDS:
                self._mailbox.send_line(f"a take has at most {MAX_TAKE_SECONDS:g} s")
                self._end_take()
        self._index += 1
        self._mailbox.send(self._frame())

    def process_requests(self) -> None:
        """Do what the messages ask that came since."""
        for message in self._mailbox.take_requests():
            try:
                self._do(message)
            # What goes wrong with one message must not end a session.
            except Exception as error:
                print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
                self._mailbox.send_line(f"that did not work: {str(error)[:200]}")

    def _do(self, message: Message) -> None:
        match message:
            case PlayScript(script):
                self.steering.perform(script)
            case GoTo(point):
                self.steering.go(np.array(point))
            case Steer(command):
                self.steering.drive(command)
            case Cancel():
                self.steering.cancel()
            case Pull():
                self._user_forces.pull(self.creature.body, message)
            case Release():
                self._user_forces.release()
            case PushOnce():
                self._user_forces.push(message)
            case Change():
                self._change(message)
            case Restyle(style):
                self.steering.style = style
            case Pause(on):
                self._paused = on
                self._reset_clock()
            case Step():
                self._single_steps += 1 if self._paused else 0
            case StandUp():
                self._stand_up()
            case Record(on):
                self._record(on)
            case RequestScript():
                requests = self.steering.requests[-MOST_MOTIONS:]
                self._mailbox.send({"type": "script", "text": script_text(requests), "motions": len(requests)})

    def _stand_up(self) -> None:
        self._end_take()
        self._user_forces.clear()
        self._stillness.reset()
        stood = self.creature.start.positions.copy()
        self.state = BodyState(stood, np.zeros_like(stood), self.state.time)
        self.report, self._memory = None, self.creature.stepper.initial_memory()
        self.steering.stand(self._place)
        self._index += 1
        self._mailbox.send(self._frame())

    def _change(self, wish: Change) -> None:
        """The same creature, as it stands, with another friction or stiffness."""
        friction = self.friction if wish.friction is None else wish.friction
        sag = self.sag if wish.sag is None else wish.sag
        if (friction, sag) == (self.friction, self.sag):
            return
        self._end_take()
        with self._mailbox.send_busy():
            try:
                muscles = self.options.muscles_file
                made = changed_creature(self.creature, friction=friction, sag=sag, muscles_file=muscles)
                place = initial_stance(made)
                if sag != self.sag and tilt_degrees(self._place, made.start.positions) > FALLEN_TILT:
                    raise UserError(f"sag {sag:g}: so soft a body does not stand; choose a smaller one")
            except (UserError, FloatingPointError, np.linalg.LinAlgError) as error:
                self._mailbox.send_line(str(error))
                return
            self.creature, self.friction, self.sag, self._place = made, friction, sag, place
            self._stillness.reset()
            # Contacts and activations of the old body are as good a guess as any for the new one.
            self.steering.place = place
            self._reset_clock()

    def _record(self, on: bool) -> None:
        if on and self._take is None:
            self._take = SessionRecording(self.creature, self.state)
        elif not on:
            self._end_take()

    def _end_take(self) -> None:
        take, self._take = self._take, None
        if take is None:
            return
        if not take.reports:
            self._mailbox.send_line("nothing has moved since the take began; there is nothing to write")
            return
        with self._mailbox.send_busy():
            try:
                path = take.write(
                    *(self.options.takes, self.drawn_as, self.steering.records, self.steering.requests),
                    source=self.options.source,
                    asked={"live": True, "friction": self.friction, "sag": self.sag},
                    driven=[time for time in self.steering.drive_starts if time >= take.start.time],
                )
                self._mailbox.send_line(f"wrote {path} ({take.seconds:.1f} s); egs-warp view {path}")
            except (UserError, OSError) as error:
                self._mailbox.send_line(f"the take could not be written: {error}")

    # What is sent.

    def _frame(self) -> Frame:
        return encode_frame(self._index, self.state, self.report, self.creature)

    def state_message(self) -> Mapping[str, Any]:
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
            "pulled": self._user_forces.is_pulling,
            "friction": self.friction,
            "sag": self.sag,
            "style": vars(steering.style),
            "motions": len(steering.records),
            "step": self._dt,
        }
