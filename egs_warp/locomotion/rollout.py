"""The loop over the steps of a run: motion, stepper, recorder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from egs_warp.contact.detection import ContactGeometry
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

FRAME_RATE = 60
"""Frame rate of a video, 1/s."""
REST_FRAMES = 20
"""Number of frames for which a run continues after the motion has finished."""


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


def roll_out(
    stepper: LocomotionStepper,
    geometry: ContactGeometry,
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
    kicks: Callable[[float, float], np.ndarray | None] = lambda time, dt: None,
    activations: np.ndarray | None = None,
    progress: Callable[[int], object] = lambda frame: None,
) -> RolloutResult:
    """Run ``frames`` frames of ``motion`` from ``start``. The run ends earlier if the motion has ``finished`` for
    ``REST_FRAMES`` frames, or if a step cannot be solved.

    Args:
        stepper: stepper of the body.
        geometry: ground and contact points, for the recording.
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
        kicks: function of time and step size, s, that returns the velocities (N, 3) m/s that external pushes add to the
            nodes at the start of the step, or None.
        activations: (steps, M) m, prescribed activations, which replace the planned ones; the run ends with the last
            whole frame that they cover.
        progress: function that receives the index of each finished frame.
    """
    dt, per_frame = solver_steps(stepper.body, step)
    if activations is not None:
        frames = min(frames, len(activations) // per_frame)
    state, memory = start, stepper.initial_memory()
    reports: list[StepReport] = []
    shown = [0]
    resting = 0
    stopped = False
    gaps, _ = stepper.detector.gaps(start.positions)
    recorder = Recorder(
        stepper.body,
        stepper.muscles,
        geometry,
        start,
        float(gaps.min()),
        drag=stepper.settings.drag,
        frame=place,
        front=front,
        folder=parts,
    )
    replay = Replay(resume, recorder.start, stepper.detector) if resume is not None else None
    # Digests take time and are only read when a run is continued.
    needs_digest = parts is not None or resume is not None
    for frame in range(frames):
        for part in range(per_frame):
            with one_blas_thread():
                objectives = motion.objectives(state, reports[-1] if reports else None, dt)
            if aborted():
                break
            kick = kicks(state.time, dt)
            step_activations = None if activations is None else activations[frame * per_frame + part]
            prescribed = [each for each in (kick, step_activations) if each is not None]
            request_digest = digest([*objectives, *prescribed]) if needs_digest else 0
            done = replay.step(request_digest) if replay is not None else []
            pushed_state = state.with_velocity_kick(kick)
            if step_activations is None:
                done = done or _try_advance(partial(stepper.advance, pushed_state, memory, objectives, dt))
            else:
                done = done or _try_advance(
                    partial(stepper.advance_with_activations, pushed_state, memory, step_activations, dt)
                )
            stopped = not done
            if stopped:
                break
            state, memory = done[-1].state, WarmStart.from_report(done[-1])
            reports.extend(done)
            recorder.add(done, request_digest=request_digest, kick=kick)
        if shown[-1] < len(reports):
            shown.append(len(reports))
        progress(frame)
        resting = resting + 1 if finished() else 0
        if stopped or resting == REST_FRAMES or aborted():
            break
    return RolloutResult(recorder.trajectory(), tuple(reports), np.array(shown), stopped)


def _try_advance(advance: Callable[[], tuple[BodyState, WarmStart, list[StepReport]]]) -> list[StepReport]:
    """Return the reports of a step; an empty list if neither the step nor a part of it can be solved."""
    try:
        _, _, done = advance()
    except (UnsolvableStepError, np.linalg.LinAlgError):
        return []
    return done if any(report.converged for report in done) else []
