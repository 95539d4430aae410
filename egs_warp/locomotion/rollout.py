"""A body, its muscles and its ground, ready to move; and the loop that moves it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from egs_warp.contact.detection import ContactGeometry
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.step_problem import UnsolvableStepError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.planner import MIN_STEPS_PER_TIME_UNIT
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.replay import Replay, digest
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.locomotion.trajectory import Trajectory

FRAME_RATE = 60
"""Frames of a video, 1/s."""
SETTLING_STEP, SETTLING_STEPS = 0.25, 12
"""sqrt(H / g) of each step in which a body comes to rest on its ground, and how many it has for that."""
REST_FRAMES = 20
"""Frames shown after the last motion has come to rest."""


class Motion(Protocol):
    """Anything that writes objectives from the measured state."""

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` seconds that starts at ``state``; ``report`` is of the step before."""
        ...


@dataclass(frozen=True)
class RolloutResult:
    """A finished simulation."""

    trajectory: Trajectory
    reports: tuple[StepReport, ...]
    frames: np.ndarray
    """(n,) index into the trajectory's times for each frame of the video."""
    stopped: bool = False
    """Whether it ended at a step that could not be solved."""


def solver_steps(body: SoftBody, step: float | None = None) -> tuple[float, int]:
    """Seconds of a solver step, and how many make a frame: steps of at most ``step`` seconds and of sqrt(H / g) / 19,
    within which a body can be steered (docs/concepts/conventions.md). A frame is as long as a ``step`` that is longer.
    """
    longest = body.time_unit / MIN_STEPS_PER_TIME_UNIT
    frame = max(1.0 / FRAME_RATE, step or 0.0)
    count = int(np.ceil(frame / min(longest, step or longest) - 1e-3))
    return frame / count, count


def settle(stepper: LocomotionStepper) -> BodyState:
    """The body at rest on its ground: contact steps from rest, long ones, each begun without velocity.

    One that gives way is not followed to the ground: it is returned once a node has gone 0.2 H in one step, or its
    centre of mass 0.1 H in all.
    """
    body = stepper.body
    state = BodyState(body.mesh.nodes.copy(), np.zeros_like(body.mesh.nodes))
    dt = SETTLING_STEP * body.time_unit
    memory = stepper.initial_memory()
    for _ in range(SETTLING_STEPS):
        with one_blas_thread():
            result = stepper.passive_step(state, memory, dt)
        moved = dt * float(np.abs(result.velocities).max())
        state = BodyState(state.positions + dt * result.velocities, np.zeros_like(state.positions))
        memory = replace(memory, points=result.contacts.points, forces=result.forces)
        gone = body.centre_of_mass(state.positions) - body.centre_of_mass(body.mesh.nodes)
        if has_settled(body, moved, np.linalg.norm(gone)):
            break
    return state


def has_settled(body: SoftBody, moved: Any, gone: Any) -> Any:
    """Whether a body rests, or gives way, whose nodes have ``moved`` so many metres at most in the last step, and whose
    centre of mass has ``gone`` so many in all: of one, or of as many as there are numbers."""
    return (moved > 0.2 * body.height) | (gone > 0.1 * body.height) | (moved < 2e-4 * body.height)


def roll_out(
    stepper: LocomotionStepper,
    geometry: ContactGeometry,
    start: BodyState,
    motion: Motion,
    *,
    frames: int,
    step: float | None = None,
    place: BodyFrame | None = None,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    finished: Callable[[], bool] = lambda: False,
    kicks: Callable[[float, float], np.ndarray | None] = lambda time, dt: None,
    activations: np.ndarray | None = None,
    progress: Callable[[int], object] = lambda frame: None,
) -> RolloutResult:
    """Run ``frames`` frames of ``motion`` from ``start``, fewer if it has ``finished`` for ``REST_FRAMES``, or a step
    cannot be solved.

    ``step``: seconds that a solver step takes at most, see ``solver_steps``. ``place`` is where the body lies in its
    capture; steps are written into the folder that ``parts`` tells as they are done (``Recorder``); those in the folder
    ``resume`` are not solved again (``Replay``). ``kicks`` tells the velocities (N, 3) m/s that something from outside
    gives the nodes in the step from a time on, if anything does. With ``activations`` (steps, M) metres muscles do what
    those say, whatever the motion asks for, as long as there are any for a whole frame. ``progress`` is told each frame
    done.
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
        folder=parts,
    )
    replay = Replay(resume, recorder.start, stepper.detector) if resume is not None else None
    # It takes time, and is read where a run goes on.
    digested = parts is not None or resume is not None
    for frame in range(frames):
        for part in range(per_frame):
            with one_blas_thread():
                objectives = motion.objectives(state, reports[-1] if reports else None, dt)
            kick = kicks(state.time, dt)
            held = None if activations is None else activations[frame * per_frame + part]
            given = [each for each in (kick, held) if each is not None]
            asked = digest([*objectives, *given]) if digested else 0
            done = replay.step(asked) if replay is not None else []
            begin = state.with_velocity_kick(kick)
            if held is None:
                done = done or _advanced(partial(stepper.advance, begin, memory, objectives, dt))
            else:
                done = done or _advanced(partial(stepper.advance_with_activations, begin, memory, held, dt))
            stopped = not done
            if stopped:
                break
            state, memory = done[-1].state, WarmStart.from_report(done[-1])
            reports.extend(done)
            recorder.add(done, asked=asked, kick=kick)
        if shown[-1] < len(reports):
            shown.append(len(reports))
        progress(frame)
        resting = resting + 1 if finished() else 0
        if stopped or resting == REST_FRAMES:
            break
    return RolloutResult(recorder.trajectory(), tuple(reports), np.array(shown), stopped)


def _advanced(advance: Callable[[], tuple[BodyState, WarmStart, list[StepReport]]]) -> list[StepReport]:
    """A step in the parts it was divided into; none if it cannot be solved, nor any part of it."""
    try:
        _, _, done = advance()
    except (UnsolvableStepError, np.linalg.LinAlgError):
        return []
    return done if any(report.converged for report in done) else []
