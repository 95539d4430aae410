"""Live session: a thread that simulates a creature and handles the messages from its page.

If a step takes less time than the simulated time that it covers, the thread waits for the clock; otherwise the
simulation is slower than real time. No steps are computed while no page is subscribed.
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
from egs_warp.motions.capture_step import FALLEN_TILT
from egs_warp.motions.script import MAX_MOTIONS
from egs_warp.pipelines.creature import Creature, changed_creature, initial_stance
from egs_warp.pipelines.render_data import RenderData
from egs_warp.web.frame_encoding import encode_frame
from egs_warp.web.idle import StillnessDetector, tilt_degrees
from egs_warp.web.mailbox import Mailbox, News
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
from egs_warp.web.recordings import MAX_TAKE_SECONDS, SessionRecording, script_text
from egs_warp.web.steering import MotionScheduler
from egs_warp.web.user_forces import UserForces


@dataclass(frozen=True)
class SessionOptions:
    """Options that do not change during a session."""

    source: str = "capture"
    """Name of the capture, for reports."""
    takes: Path = Path("out/live")
    """Folder for recorded takes."""
    muscles_file: Path | None = None
    """JSON file with muscle fibres; None uses automatic muscles."""
    sag: float = DEFAULT_SAG
    """Sag rho g H / E with which the creature was built."""


class Session:
    """A simulated creature, the thread that simulates it, and the queue of news for the page."""

    def __init__(self, creature: Creature, drawn_as: RenderData, options: SessionOptions | None = None) -> None:
        """Create a session without starting its thread.

        Args:
            creature: creature in its initial stance.
            drawn_as: data from which the creature is rendered, for the page and the takes.
            options: options of the session; None uses the defaults.
        """
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

    # The following methods may be called from any thread.

    def start(self) -> None:
        """Start the thread; the simulation starts when a page subscribes."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and write the take that is being recorded, if there is one."""
        self._mailbox.stop()
        if self._thread.is_alive():
            self._thread.join()

    def put_request(self, message: Message) -> None:
        """Queue a message; it is handled before the next step."""
        self._mailbox.put_request(message)

    def subscribe(self, wake: Callable[[], object]) -> None:
        """Subscribe a page and continue the simulation.

        ``wake`` is called from the thread of the session when ``take_news`` has new entries. The first entry is the
        current frame.
        """
        self._mailbox.subscribe(wake, self._frame)

    def unsubscribe(self) -> None:
        """Unsubscribe the page: suspend the simulation and release a pull by the user."""
        self._mailbox.unsubscribe()

    def take_news(self) -> list[News]:
        """Return and remove the queued frames and events."""
        return self._mailbox.take_news()

    # The following methods are called from the thread of the session.

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
        """True if no step has to be computed: no page is open; or no single steps are requested, and the session is
        paused or the body is at rest."""
        if not self._mailbox.watched:
            return True
        return self._single_steps == 0 and (self._paused or self.resting)

    @property
    def resting(self) -> bool:
        """True if the body is still and has no task; the simulation continues at the next message."""
        if not self.steering.idle or self._take is not None or self._user_forces.has_input:
            return False
        return self._stillness.is_still(self.state)

    def _reset_clock(self) -> None:
        """Restart the clock, so that the session does not catch up on a pause."""
        self._due = time.perf_counter()

    def _wait_for_clock(self) -> None:
        """Wait until the next step is due; a session that is late catches up by at most two steps."""
        self._due = max(self._due + self._dt, time.perf_counter() - 2.0 * self._dt)
        self._mailbox.wait_until(lambda: self._due - time.perf_counter())

    def advance(self) -> None:
        """Compute one step and send its frame. If the step fails, reset the body to its start."""
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
        # An error in a step must not end the session.
        except Exception as error:
            print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
            self._mailbox.send_line("the solver failed; the creature is back at its start")
            self.state = before
            self._stand_up()
            return
        self.report = reports[-1]
        self._stillness.update(self.creature.body, self.state)
        if self._take is not None:
            self._take.add(reports, kick=kick)
            if self._take.seconds >= MAX_TAKE_SECONDS:
                self._mailbox.send_line(f"the take has ended: its maximum length is {MAX_TAKE_SECONDS:g} s")
                self._end_take()
        self._index += 1
        self._mailbox.send(self._frame())

    def process_requests(self) -> None:
        """Handle all queued messages."""
        for message in self._mailbox.take_requests():
            try:
                self._do(message)
            # An error in a message must not end the session.
            except Exception as error:
                print(f"egs-warp: live: {type(error).__name__}: {error}", file=sys.stderr)
                self._mailbox.send_line(f"the command failed: {str(error)[:200]}")

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
                requests = self.steering.requests[-MAX_MOTIONS:]
                self._mailbox.send({"type": "script", "text": script_text(requests), "motions": len(requests)})

    def _stand_up(self) -> None:
        """Reset the body to its upright start."""
        self._end_take()
        self._user_forces.clear()
        self._stillness.reset()
        positions = self.creature.start.positions.copy()
        self.state = BodyState(positions, np.zeros_like(positions), self.state.time)
        self.report, self._memory = None, self.creature.stepper.initial_memory()
        self.steering.stand(self._place)
        self._index += 1
        self._mailbox.send(self._frame())

    def _change(self, change: Change) -> None:
        """Rebuild the creature in its current pose with another friction or stiffness."""
        friction = self.friction if change.friction is None else change.friction
        sag = self.sag if change.sag is None else change.sag
        if (friction, sag) == (self.friction, self.sag):
            return
        self._end_take()
        with self._mailbox.send_busy():
            try:
                muscles = self.options.muscles_file
                changed = changed_creature(self.creature, friction=friction, sag=sag, muscles_file=muscles)
                place = initial_stance(changed)
                if sag != self.sag and tilt_degrees(self._place, changed.start.positions) > FALLEN_TILT:
                    raise UserError(f"sag {sag:g}: a body this soft cannot stand; choose a smaller sag")
            except (UserError, FloatingPointError, np.linalg.LinAlgError) as error:
                self._mailbox.send_line(str(error))
                return
            self.creature, self.friction, self.sag, self._place = changed, friction, sag, place
            self._stillness.reset()
            # Keep the contacts and activations of the old body, because they are a good initial guess for the new one.
            self.steering.change_place(place)
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
            self._mailbox.send_line("nothing has moved since the take started; no take is written")
            return
        with self._mailbox.send_busy():
            try:
                path = take.write(
                    *(self.options.takes, self.drawn_as, self.steering.records, self.steering.requests),
                    source=self.options.source,
                    requested={"live": True, "friction": self.friction, "sag": self.sag},
                    drive_starts=[time for time in self.steering.drive_starts if time >= take.start.time],
                )
                self._mailbox.send_line(f"wrote {path} ({take.seconds:.1f} s); to show it: egs-warp view {path}")
            except (UserError, OSError) as error:
                self._mailbox.send_line(f"the take cannot be written: {error}")

    # The following methods create frames and events for the page.

    def _frame(self) -> Frame:
        return encode_frame(self._index, self.state, self.report, self.creature)

    def state_message(self) -> Mapping[str, Any]:
        """Return the event ``state``; docs/guide/live.md lists its fields."""
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
            "style": {name: getattr(steering.style, name) for name in STYLE_NAMES},
            "motions": len(steering.records),
            "pushes": self._user_forces.push_count,
            "dropped_pushes": self._user_forces.dropped_count,
            "step": self._dt,
        }
