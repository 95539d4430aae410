"""Batched runs: simulation of many jobs with prescribed activations at once, in one process on one device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.fem.implicit_step import UNSOLVABLE, UnsolvableStepError
from egs_warp.launching import available_threads
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.pipelines.captured_body import checked_friction
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.job import Job, RunSummary
from egs_warp.pipelines.simulated_run import check_frames, checked_activations
from egs_warp.pipelines.worker_pool import ProgressCallback, TaskResult, run_task

if TYPE_CHECKING:
    from egs_warp.locomotion.batch import BatchStepper

MAX_WORLDS = 1024
"""Maximum number of jobs in a batch. Larger batches are hardly faster, and all results stay in memory until the batch
ends."""
_MEMORY_FRACTION = 0.4
"""Fraction of the free memory of a GPU that matrix factors may use."""
_MIN_JOBS_PER_CORE = 2
"""Number of jobs per core of the machine from which a batch is faster than worker processes. On an H100, a batch of
eight worlds of 253 nodes computes 101 steps per second in total, and one worker process computes 21."""


def choose_batch_size(creature: Creature, jobs: int) -> int:
    """Return the batch size for ``jobs`` batchable jobs: as many as fit on the creature's device.

    Returns 0 if workers are faster for so few jobs, the device is a CPU, or torch cannot use it.
    """
    device = creature.body.assembly.device
    if not device.is_cuda or jobs < _MIN_JOBS_PER_CORE * available_threads():
        return 0
    try:
        import torch
    except ImportError:
        return 0
    if not torch.cuda.is_available():
        return 0
    free, _ = torch.cuda.mem_get_info(str(device))
    return min(MAX_WORLDS, int(_MEMORY_FRACTION * free) // (72 * len(creature.body.mesh.nodes) ** 2))


def is_batchable(job: Job) -> bool:
    """Return True if the job can run in a batch: its activations are prescribed, and nothing pushes the body."""
    return job.activations is not None and not job.pushes


def run_batched(
    creature: Creature,
    jobs: Sequence[tuple[int, Job]],
    *,
    worlds: int,
    progress: Callable[[dict[int, tuple[int, int]]], object],
) -> Iterator[TaskResult]:
    """Run jobs in batches and yield each result when its batch ends. A batch contains only jobs of the same step size.

    Args:
        creature: The creature of all jobs.
        jobs: Number and job, in any order.
        worlds: Maximum number of jobs in a batch.
        progress: Called after each frame with the frames done and expected, by the number of each running job.
    """
    batch_jobs: list[_BatchJob] = []
    for number, job in jobs:
        kind, value = run_task(partial(_make_batch_job, creature, number), job, progress)
        if kind == "done":
            batch_jobs.append(value)
        else:
            yield TaskResult(number, None, value, 1)
    batch_jobs.sort(key=lambda one: (one.dt, one.number))
    for _, same_step in groupby(batch_jobs, key=lambda one: one.dt):
        same_step_jobs = list(same_step)
        for first in range(0, len(same_step_jobs), worlds):
            yield from _run_batch(creature, same_step_jobs[first : first + worlds], progress)


@dataclass(frozen=True)
class _BatchJob:
    """A job whose arguments are valid."""

    number: int
    job: Job
    friction: float
    dt: float
    """Step size, s."""
    per_frame: int
    """Number of steps per frame."""
    activations: np.ndarray
    """(steps, M) m, prescribed activations; ``steps`` is a multiple of ``per_frame``."""


def _make_batch_job(creature: Creature, number: int, job: Job, _: ProgressCallback) -> _BatchJob:
    """Return the job with checked arguments. Raises ``UserError`` if one is invalid."""
    assert job.activations is not None, "the job is batchable"
    check_frames(job.frames)
    friction = creature.geometry.friction if job.friction is None else checked_friction(job.friction)
    activations = checked_activations(creature, job.activations, job.step)
    dt, per_frame = solver_steps(creature.body, job.step)
    frames = len(activations) // per_frame
    frames = frames if job.frames is None else min(frames, job.frames - 1)
    return _BatchJob(number, job, friction, dt, per_frame, activations[: frames * per_frame])


def _run_batch(
    creature: Creature, batch: Sequence[_BatchJob], progress: Callable[[dict[int, tuple[int, int]]], object]
) -> Iterator[TaskResult]:
    """Run one batch and yield its results. If the memory does not suffice, run it as two smaller batches."""
    import torch

    run, memory_error = None, ""
    try:
        run = _run(creature, batch, progress)
    except torch.OutOfMemoryError as error:
        memory_error = " ".join(str(error).split())
    # Retry outside the except block, whose traceback keeps the memory of the failed attempt allocated.
    if run is None and len(batch) == 1:
        why = f"out of GPU memory with a single world; set worlds=0 to use worker processes: {memory_error}"
        yield TaskResult(batch[0].number, None, why, 1)
        return
    if run is None:
        torch.cuda.empty_cache()
        half = len(batch) // 2
        yield from _run_batch(creature, batch[:half], progress)
        yield from _run_batch(creature, batch[half:], progress)
        return
    for one, run_creature, steps, is_unsolvable in zip(batch, run.creatures, run.steps, run.is_unsolvable, strict=True):
        kind, value = run_task(partial(_outcome, run_creature, steps, is_unsolvable), one.job, progress)
        yield TaskResult(one.number, *((value, None) if kind == "done" else (None, value)), 1)


@dataclass(frozen=True)
class _Run:
    """Results of one batch, one entry per job."""

    creatures: list[Creature]
    """The creature on the ground of each job."""
    steps: list[list[list[StepReport]]]
    """Reports of each step of each job, as ``_run_steps`` returns them."""
    is_unsolvable: list[bool]
    """True if the creature cannot stand on the ground of the job."""


def _run(
    creature: Creature, batch: Sequence[_BatchJob], progress: Callable[[dict[int, tuple[int, int]]], object]
) -> _Run:
    from egs_warp.locomotion.batch import BatchStepper

    stepper = BatchStepper(
        *(creature.body, creature.muscles, creature.geometry, [one.friction for one in batch]),
        settings=creature.stepper.settings,
    )
    starts = [creature.start] * len(batch)
    is_unsolvable = [False] * len(batch)
    # Without a friction of the job, the creature is already at rest.
    if any(one.job.friction is not None for one in batch):
        settled, failed = stepper.settle()
        has_friction = [one.job.friction is not None for one in batch]
        starts = [new if changed else start for new, changed, start in zip(settled, has_friction, starts, strict=True)]
        is_unsolvable = [bool(fail) and changed for fail, changed in zip(failed.tolist(), has_friction, strict=True)]
    creatures = [
        replace(creature, stepper=creature.stepper.with_friction(one.friction), start=start)
        for one, start in zip(batch, starts, strict=True)
    ]
    return _Run(creatures, _run_steps(stepper, batch, creatures, progress), is_unsolvable)


def _outcome(
    creature: Creature, steps: list[list[StepReport]], is_unsolvable: bool, job: Job, _: ProgressCallback
) -> RunSummary:
    if is_unsolvable:
        raise UnsolvableStepError(UNSOLVABLE)
    return job.outcome(creature, job.run_on_ground(replace(creature, stepper=_ReplayStepper(creature.stepper, steps))))


class _ReplayStepper(LocomotionStepper):
    """Stepper that replays the reports of a batched run, so that the motion can measure them."""

    def __init__(self, stepper: LocomotionStepper, steps: list[list[StepReport]]) -> None:
        vars(self).update(vars(stepper))
        self._steps = iter(steps)

    def advance_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        """Return state, warm start and reports of the next stored step."""
        done = next(self._steps)
        if not done:
            raise UnsolvableStepError(UNSOLVABLE)
        return done[-1].state, WarmStart.from_report(done[-1]), done


def _run_steps(
    stepper: BatchStepper,
    batch: Sequence[_BatchJob],
    creatures: Sequence[Creature],
    progress: Callable[[dict[int, tuple[int, int]]], object],
) -> list[list[list[StepReport]]]:
    """Advance all jobs and return, for each job and step, its reports; a step that cannot be solved has none."""
    import torch

    runs: list[list[list[StepReport]]] = [[] for _ in batch]
    state = stepper.start([creature.start for creature in creatures])
    max_steps, per_frame = max(len(one.activations) for one in batch), batch[0].per_frame
    for number in range(max_steps):
        has_step = torch.tensor([len(batch[world].activations) > number for world in state.worlds.tolist()])
        state = state.gather(has_step.nonzero().squeeze(1).to(stepper.device))
        if len(state.worlds) == 0:
            break
        worlds = state.worlds.tolist()
        for world in worlds:
            runs[world].append([])
        activations = np.stack([batch[world].activations[number] for world in worlds])
        state, done, _ = stepper.advance(state, activations, batch[0].dt)
        for step in done:
            for world, report in zip(step.worlds.tolist(), step.reports(), strict=True):
                runs[world][-1].append(report)
        if (number + 1) % per_frame == 0:
            frame = (number + 1) // per_frame
            progress({batch[w].number: (frame, len(batch[w].activations) // per_frame) for w in worlds})
    return runs
