"""Loop over the steps of a run: motion, stepper, recorder."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Protocol, TypeAlias, TypeVar

import numpy as np

from egs_warp.checked_calls import Range
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.implicit_step import UnsolvableStepError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.planner import MIN_STEPS_PER_TIME_UNIT
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.replay import Replay, digest
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.short_repr import short_repr

T = TypeVar("T")

FRAME_RATE = 60
"""Frame rate of a video, 1/s."""
REST_FRAMES = 20
"""Number of frames for which a run continues after the motion has finished."""
_MIN_SUPPORT_COSINE = 0.7
"""Minimum cosine of the angle between the normal and the vertical at a contact where another body supports the body."""
StepSize: TypeAlias = Annotated[float, Range(1e-6, 1.0, "a number of seconds")]
"""Maximum size of a solver step, s."""


Kicks: TypeAlias = Callable[[float, float], np.ndarray | None]
"""Function of the time and the step size, in seconds. It returns the velocities (N, 3) m/s that external pushes add to
the nodes at the start of the step, or None."""


class Motion(Protocol):
    """Source of objectives, computed from the measured state."""

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the step of ``dt`` seconds that starts at ``state``; ``report`` is the report of the
        previous step."""
        ...


@dataclass(frozen=True)
class RolloutResult:
    """Result of a simulation."""

    __repr__ = short_repr

    trajectory: Trajectory
    reports: tuple[StepReport, ...]
    """Report of each solver step."""
    frames: np.ndarray
    """(n,) int, index of each video frame among the states of the trajectory."""
    stopped: bool = False
    """True if the run ended at a step that could not be solved."""


def solver_steps(body: SoftBody, step: float | None = None) -> tuple[float, int]:
    """Return the size of a solver step in seconds, and the number of steps in a frame.

    A step lasts at most ``step`` seconds and at most sqrt(H / g) / 19 (docs/concepts/conventions.md). If ``step`` is
    longer than a frame, the frame is extended to ``step`` seconds.
    """
    max_step = body.time_unit / MIN_STEPS_PER_TIME_UNIT
    frame = max(1.0 / FRAME_RATE, step or 0.0)
    count = int(np.ceil(frame / min(max_step, step or max_step) - 1e-3))
    return frame / count, count


def are_supporting(faces: np.ndarray, normals: np.ndarray, gravity: np.ndarray, index: int) -> np.ndarray:
    """Return (n,) bool, True for the contacts that support a body: those with the ground and the solids, and those with
    other bodies below it.

    Args:
        faces: (n,) surface of each contact (``Trajectory.contact_plane``).
        normals: (n, 3) unit normals towards the body.
        gravity: (3,) m/s^2.
        index: index of the body in its world; -1 for a body that has no contact with itself.
    """
    upward = -(normals @ gravity) / np.linalg.norm(gravity)
    return (faces >= 0) | ((upward > _MIN_SUPPORT_COSINE) & (faces != -1 - index))


def support_report(stepper: LocomotionStepper, index: int, report: StepReport) -> StepReport:
    """Return the ``report`` of body ``index`` of a world with only the contacts that support the body: those with the
    ground, and those with other bodies below it. A motion must not treat another body that pushes from the side, or
    another part of the body, as its ground.

    The minimum gap is that to the ground or, if it is smaller, that of a contact with a body below.
    """
    contacts = report.contacts
    kept = are_supporting(contacts.faces, contacts.axes[:, 0], stepper.body.gravity, index)
    below = report.end_gaps[kept & (contacts.faces < 0)]
    contacts = contacts.of_entries(np.flatnonzero(kept))
    gaps, _ = stepper.detector.gaps(report.state.positions)
    return replace(
        report,
        contacts=contacts,
        forces=report.forces[kept],
        end_gaps=report.end_gaps[kept],
        min_gap=min(float(gaps.min()), float(below.min(initial=np.inf))),
    )


class BodyRun:
    """Progress of one body in a run: its state, warm start, reports and recording."""

    def __init__(
        self,
        stepper: LocomotionStepper,
        start: BodyState,
        motion: Motion,
        *,
        place: BodyFrame | None = None,
        front: np.ndarray | None = None,
        parts: Callable[[], Path] | None = None,
        resume: Path | None = None,
        kicks: Kicks = lambda time, dt: None,
        index: int | None = None,
    ) -> None:
        """Begin at ``start``; arguments as for ``rollout_steps``.

        ``index`` is that of the body in its world if it may touch other bodies or itself; None otherwise.
        """
        self.stepper, self._motion, self._kicks, self._index = stepper, motion, kicks, index
        self.state, self.memory = start, stepper.initial_memory()
        self.reports: list[StepReport] = []
        self._shown = [0]
        gaps, _ = stepper.detector.gaps(start.positions)
        self._recorder = Recorder(
            *(stepper.body, stepper.muscles, stepper.geometry, start, float(gaps.min())),
            drag=stepper.settings.drag,
            frame=place,
            front=front,
            folder=parts,
            world_index=index,
        )
        self._replay = Replay(resume, self._recorder.start) if resume is not None else None
        # Digests take time and are only read when a run is continued.
        self._needs_digest = parts is not None or resume is not None
        self._kick: np.ndarray | None = None
        self._digest = 0

    def objectives(self, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the motion for the next step of ``dt`` s."""
        with one_blas_thread():
            report = self.reports[-1] if self.reports else None
            if report is not None and self._index is not None:
                report = support_report(self.stepper, self._index, report)
            return self._motion.objectives(self.state, report, dt)

    def begin_step(
        self, objectives: Sequence[AnyObjective], dt: float, activations: np.ndarray | None = None
    ) -> tuple[BodyState, list[StepReport]]:
        """Apply the external pushes of the next step.

        Args:
            objectives: objectives of the step.
            dt: step size, s.
            activations: (M,) m, prescribed activations; None if they are planned.

        Returns:
            The state from which the step starts, and the reports of the step if it is replayed, else an empty list.
        """
        self._kick = self._kicks(self.state.time, dt)
        prescribed = [each for each in (self._kick, activations) if each is not None]
        self._digest = digest([*objectives, *prescribed]) if self._needs_digest else 0
        done = self._replay.step(self._digest) if self._replay is not None else []
        return self.state.with_velocity_kick(self._kick), done

    def finish_step(self, done: Sequence[StepReport]) -> None:
        """Continue from the end of a step and record its reports ``done``, one for each part into which it was
        divided."""
        self.state, self.memory = done[-1].state, WarmStart.from_report(done[-1])
        self.reports.extend(done)
        self._recorder.add(done, request_digest=self._digest, kick=self._kick)

    def show_frame(self) -> None:
        """Show the current state in the next frame of the video. If it is shown already, do nothing."""
        if self._shown[-1] < len(self.reports):
            self._shown.append(len(self.reports))

    def result(self, *, stopped: bool) -> RolloutResult:
        """Return the result; ``stopped`` is True if the next step cannot be solved."""
        return RolloutResult(self._recorder.trajectory(), tuple(self.reports), np.array(self._shown), stopped)


@dataclass(frozen=True)
class StepRequest:
    """Inputs of a step that a run requests from its caller."""

    state: BodyState
    """State at the start, after external pushes."""
    memory: WarmStart
    objectives: Sequence[AnyObjective]
    """Objectives of the motion."""
    activations: np.ndarray | None
    """(M,) m, prescribed activations; None plans them from the objectives."""
    dt: float
    """Step size, s."""
    motion: Motion
    """Source of the objectives."""

    def advance(self, stepper: LocomotionStepper) -> list[StepReport]:
        """Make the step with ``stepper``. Return its reports; an empty list if neither the step nor a part of it can be
        solved."""
        state, memory, activations = self.state, self.memory, self.activations
        try:
            if activations is None:
                _, _, done = stepper.advance(state, memory, self.objectives, self.dt)
            else:
                _, _, done = stepper.advance_with_activations(state, memory, activations, self.dt)
        except (UnsolvableStepError, np.linalg.LinAlgError):
            return []
        return done if any(report.converged for report in done) else []


RunSteps: TypeAlias = Generator[StepRequest, list[StepReport], T]
"""Generator of a run: it yields the request for each step, receives the reports of the step, and returns the result of
the run."""


def run_with(stepper: LocomotionStepper, steps: RunSteps[T]) -> T:
    """Compute the ``steps`` of a run with ``stepper`` and return the result of the run."""
    try:
        request = next(steps)
        while True:
            request = steps.send(request.advance(stepper))
    except StopIteration as end:
        return end.value


def rollout_steps(
    stepper: LocomotionStepper,
    start: BodyState,
    motion: Motion,
    *,
    frames: int,
    step: float | None = None,
    place: BodyFrame | None = None,
    front: np.ndarray | None = None,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    finished: Callable[[], bool] = lambda: False,
    aborted: Callable[[], bool] = lambda: False,
    kicks: Kicks = lambda time, dt: None,
    activations: np.ndarray | None = None,
    progress: Callable[[int], object] = lambda frame: None,
) -> RunSteps[RolloutResult]:
    """Run ``frames`` frames of ``motion`` from ``start``. The run ends earlier if the motion has ``finished`` for
    ``REST_FRAMES`` frames, or if a step cannot be solved. The caller computes the steps, for example with ``run_with``.

    Args:
        stepper: stepper of the body.
        start: first state.
        motion: source of the objectives.
        frames: maximum number of frames.
        step: maximum size of a solver step, s, see ``solver_steps``.
        place: placement of the body in its capture.
        front: (3,) unit vector in which the body faces, for the recording; None is its x axis.
        parts: function that returns the folder in which the steps are recorded (``Recorder``); None records none.
        resume: folder of a recording whose steps are replayed instead of solved (``Replay``); None replays none.
        finished: function that returns True once the motion has finished.
        aborted: function that is called after the motion has returned the objectives of a step. If it returns True, the
            run ends before this step.
        kicks: external pushes, see ``Kicks``.
        activations: (steps, M) m, prescribed activations, which replace the planned ones; the run ends with the last
            whole frame that they cover.
        progress: function that receives the index of each finished frame.
    """
    dt, per_frame = solver_steps(stepper.body, step)
    if activations is not None:
        frames = min(frames, len(activations) // per_frame)
    run = BodyRun(stepper, start, motion, place=place, front=front, parts=parts, resume=resume, kicks=kicks)
    resting = 0
    stopped = False
    for frame in range(frames):
        for part in range(per_frame):
            stopped = not run.state.is_finite()
            if stopped:
                break
            objectives = run.objectives(dt)
            if aborted():
                break
            step_activations = None if activations is None else activations[frame * per_frame + part]
            state, done = run.begin_step(objectives, dt, step_activations)
            if not done:
                done = yield StepRequest(state, run.memory, objectives, step_activations, dt, motion)
            stopped = not done
            if stopped:
                break
            run.finish_step(done)
        run.show_frame()
        progress(frame)
        resting = resting + 1 if finished() else 0
        if stopped or resting == REST_FRAMES or aborted():
            break
    return run.result(stopped=stopped)
