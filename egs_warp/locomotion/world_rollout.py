"""Loop over the steps of a world, in which all bodies advance in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.fem.implicit_step import UnsolvableStepError
from egs_warp.locomotion.rollout import FRAME_RATE, REST_FRAMES, BodyRun, RolloutResult, solver_steps
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.world_stepper import WorldStepper


def world_steps(bodies: Sequence[SoftBody], step: float | None = None) -> tuple[float, int]:
    """Return the size of a solver step in seconds, and the number of steps in a frame, for the body that needs the
    shortest steps (``solver_steps``)."""
    count = max(solver_steps(body, step)[1] for body in bodies)
    return max(1.0 / FRAME_RATE, step or 0.0) / count, count


def roll_out_world(
    stepper: WorldStepper,
    runs: Sequence[BodyRun],
    *,
    frames: int,
    step: float | None = None,
    finished: Callable[[], bool] = lambda: False,
    progress: Callable[[int], object] = lambda frame: None,
) -> list[RolloutResult]:
    """Run ``frames`` frames of all bodies. The run ends earlier if the motions have ``finished`` for ``REST_FRAMES``
    frames, or if the step of a body cannot be solved.

    Args:
        stepper: stepper of the world.
        runs: run of each body at its start, in the order of ``stepper.bodies``.
        frames: maximum number of frames.
        step: maximum size of a solver step, s, see ``world_steps``.
        finished: function that returns True once all motions have finished.
        progress: function that receives the index of each finished frame.

    Returns:
        The result of each body. If a step cannot be solved, all of them are ``stopped``.
    """
    dt, per_frame = world_steps([run.stepper.body for run in runs], step)
    resting = 0
    stopped = False
    for frame in range(frames):
        for _ in range(per_frame):
            objectives = [run.objectives(dt) for run in runs]
            begun = [run.begin_step(each, dt) for run, each in zip(runs, objectives, strict=True)]
            done = [reports for _, reports in begun]
            # The bodies are recorded one after the other, so an interrupted run may lack the last steps of some bodies.
            if all(done):
                stepper.observe(done)
            else:
                states, memories = [state for state, _ in begun], [run.memory for run in runs]
                done = _try_advance(partial(stepper.advance, states, memories, objectives, dt))
            stopped = not done
            if stopped:
                break
            for run, reports in zip(runs, done, strict=True):
                run.finish_step(reports)
        for run in runs:
            run.show_frame()
        progress(frame)
        resting = resting + 1 if finished() else 0
        if stopped or resting == REST_FRAMES:
            break
    return [run.result(stopped=stopped) for run in runs]


def _try_advance(advance: Callable[[], list[list[StepReport]]]) -> list[list[StepReport]]:
    """Return the reports of a step for each body; an empty list if no part of the step of one body can be solved."""
    try:
        done = advance()
    except (UnsolvableStepError, np.linalg.LinAlgError):
        return []
    return done if all(any(report.converged for report in reports) for reports in done) else []
