"""Batched runs: simulation of many jobs at once, in one process and on one device.

Each job is a generator of step requests (``Job.steps``), and ``BatchStepper`` computes the requested steps of all jobs
of a batch in lockstep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from egs_warp.fem.implicit_step import UNSOLVABLE, UnsolvableStepError
from egs_warp.launching import available_threads
from egs_warp.locomotion.rollout import RunSteps, StepRequest, solver_steps
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.strategies import Strategy
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.motions.current_motion import joined_motion
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.joined_motion import JoinedMotion
from egs_warp.pipelines.captured_body import checked_friction
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.job import Job, RunSummary
from egs_warp.pipelines.simulated_run import SimulatedRun
from egs_warp.pipelines.worker_pool import ProgressCallback, TaskResult, run_task

if TYPE_CHECKING:
    import torch

    from egs_warp.locomotion.batch import BatchStepper
    from egs_warp.locomotion.batch_state import BatchState

MAX_WORLDS = 1024
"""Maximum number of jobs in a batch. Larger batches are hardly faster, and all results stay in memory until the batch
ends."""
_MEMORY_FRACTION = 0.4
"""Fraction of the free memory of a GPU that matrix factors may use."""
_MIN_JOBS_PER_CORE = 2
"""Number of jobs per core of the machine at and above which a batch is faster than worker processes. On an H100, a
batch of eight worlds of 253 nodes computes 101 steps per second in total; one worker process computes 21."""


def choose_batch_size(creature: Creature, jobs: int) -> int:
    """Return the batch size for ``jobs`` batchable jobs: as many as fit on the creature's device.

    Returns 0 if the jobs are so few that worker processes are faster, if the device is a CPU, or if torch cannot use
    the device.
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


def is_batchable(creature: Creature, job: Job) -> bool:
    """Return True if the job can run in a batch: its activations are prescribed, or the creature's strategy and QP
    solver can plan them in a batch."""
    settings = creature.stepper.settings
    return job.activations is not None or (
        Strategy(settings.strategy) is Strategy.MODES
        and settings.qp_solver_on(creature.body.assembly.device) is not QpSolver.DAQP
    )


Progress = Callable[[dict[int, tuple[int, int]]], object]
"""Function that is called with the numbers of finished and of expected frames of each job that has advanced, by job
number."""


def run_batched(
    creature: Creature, jobs: Sequence[tuple[int, Job]], *, worlds: int, progress: Progress
) -> Iterator[TaskResult]:
    """Run jobs in batches and yield each result when its run ends. All jobs of a batch have the same step size, and
    their activations are either all prescribed or all planned.

    Args:
        creature: The creature of all jobs.
        jobs: Number and job, in any order.
        worlds: Maximum number of jobs in a batch.
        progress: Called after each step.
    """
    batch_jobs: list[_BatchJob] = []
    for number, job in jobs:
        kind, value = run_task(partial(_make_batch_job, creature, number), job, _no_progress)
        if kind == "done":
            batch_jobs.append(value)
        else:
            yield TaskResult(number, None, value, 1)
    batch_jobs.sort(key=lambda one: (one.is_planned, one.dt, one.number))
    for _, alike in groupby(batch_jobs, key=lambda one: (one.is_planned, one.dt)):
        alike_jobs = list(alike)
        for first in range(0, len(alike_jobs), worlds):
            yield from _run_batch(creature, alike_jobs[first : first + worlds], progress)


@dataclass(frozen=True)
class _BatchJob:
    """Job of a batch, with a valid friction."""

    number: int
    job: Job
    friction: float
    dt: float
    """Step size, s."""

    @property
    def is_planned(self) -> bool:
        """True if the activations are planned."""
        return self.job.activations is None


def _no_progress(*values: int) -> None:
    """Report nothing."""


def _make_batch_job(creature: Creature, number: int, job: Job, _: ProgressCallback) -> _BatchJob:
    """Return the job with checked friction. Raises ``UserError`` if it is invalid."""
    friction = creature.geometry.friction if job.friction is None else checked_friction(job.friction)
    return _BatchJob(number, job, friction, solver_steps(creature.body, job.step)[0])


def _run_batch(creature: Creature, batch: Sequence[_BatchJob], progress: Progress) -> Iterator[TaskResult]:
    """Run one batch and yield its results. If the memory does not suffice, run the unfinished jobs in batches of half
    the size."""
    import torch

    memory_error, finished = "", set[int]()
    try:
        for result in _run(creature, batch, progress):
            finished.add(result.number)
            yield result
    except torch.OutOfMemoryError as error:
        memory_error = " ".join(str(error).split())
    # Retry outside the except block, whose traceback keeps the memory of the failed attempt allocated.
    if not memory_error:
        return
    remaining = [one for one in batch if one.number not in finished]
    if len(batch) == 1:
        why = f"out of GPU memory with a single world; set worlds=0 to use worker processes: {memory_error}"
        yield TaskResult(remaining[0].number, None, why, 1)
        return
    torch.cuda.empty_cache()
    half = len(batch) // 2
    for first in range(0, len(remaining), half):
        yield from _run_batch(creature, remaining[first : first + half], progress)


@dataclass
class _Run:
    """Run of one job in a batch: its creature, its steps, and the step that it requests next."""

    one: _BatchJob
    creature: Creature
    """The creature on the ground of the job."""
    steps: RunSteps[SimulatedRun]
    request: StepRequest | None = None
    last: StepReport | None = None
    """Report of the last step."""

    def resume(self, done: list[StepReport] | None, job: Job, _: ProgressCallback) -> RunSummary | None:
        """Continue the run with the reports of its last step; with None, start it. Return the summary if the run has
        ended."""
        self.last = done[-1] if done else None
        try:
            self.request = next(self.steps) if done is None else self.steps.send(done)
        except StopIteration as end:
            return job.outcome(end.value)
        return None


def _run(creature: Creature, batch: Sequence[_BatchJob], progress: Progress) -> Iterator[TaskResult]:
    """Advance all runs of a batch in lockstep and yield the result of each when it ends."""
    from egs_warp.locomotion.batch import BatchStepper

    stepper = BatchStepper(
        *(creature.body, creature.muscles, creature.geometry, [one.friction for one in batch]),
        settings=creature.stepper.settings,
        planner=creature.stepper.planner if batch[0].is_planned else None,
    )
    frames: dict[int, tuple[int, int]] = {}
    runs = _start_runs(creature, stepper, batch, frames)
    state = stepper.start([run.creature.start for run in runs])
    done: dict[int, list[StepReport]] = {}
    running = list(range(len(runs)))
    while running:
        _prepare_motions([runs[world] for world in running], [done.get(world, []) for world in running])
        results = [(world, *_resumed(runs[world], done.get(world))) for world in running]
        if frames:
            progress(dict(frames))
            frames.clear()
        for world, kind, value in results:
            if kind == "failed" or value is not None:
                yield TaskResult(runs[world].one.number, *((value, None) if kind == "done" else (None, value)), 1)
        running = [world for world, kind, value in results if kind == "done" and value is None]
        done = {world: [] for world in running}
        state = _advanced(stepper, state, {world: runs[world] for world in running}, done)


def _prepare_motions(runs: Sequence[_Run], done: Sequence[list[StepReport]]) -> None:
    """Compute the next objectives of the motions that have a world axis; ``done`` contains the reports of the last step
    of each run. The motions return these objectives when the runs call them."""
    groups: dict[tuple[type, int], list[tuple[JoinedMotion[Any], StepReport]]] = {}
    dt = 0.0
    for run, reports in zip(runs, done, strict=True):
        if not reports or run.request is None or not isinstance(run.request.motion, FallMonitor):
            continue
        motion, dt = joined_motion(run.request.motion.sequence), run.request.dt
        if motion is not None and run.one.is_planned:
            groups.setdefault((type(motion), len(motion.reference.shares)), []).append((motion, reports[-1]))
    for (kind, _), members in groups.items():
        reports = [report for _, report in members]
        with one_blas_thread():
            kind.prepare([motion for motion, _ in members], [report.state for report in reports], reports, dt)


def _start_runs(
    creature: Creature, stepper: BatchStepper, batch: Sequence[_BatchJob], frames: dict[int, tuple[int, int]]
) -> list[_Run]:
    """Prepare the runs of a batch. If a job has another friction, the creature first comes to rest on its ground. The
    runs write the numbers of finished and of expected frames to ``frames``, by job number."""
    starts, is_unsolvable = [creature.start] * len(batch), [False] * len(batch)
    # If no job has a friction of its own, the creature is already at rest.
    if any(one.job.friction is not None for one in batch):
        settled, failed = stepper.settle()
        has_friction = [one.job.friction is not None for one in batch]
        starts = [new if changed else start for new, changed, start in zip(settled, has_friction, starts, strict=True)]
        is_unsolvable = [bool(fail) and changed for fail, changed in zip(failed.tolist(), has_friction, strict=True)]
    runs = []
    for one, start, fails in zip(batch, starts, is_unsolvable, strict=True):
        standing = replace(creature, stepper=creature.stepper.with_friction(one.friction), start=start)

        def update(done: int, expected: int, number: int = one.number) -> None:
            frames[number] = done, expected

        runs.append(_Run(one, standing, _unsolvable() if fails else one.job.steps(standing, progress=update)))
    return runs


def _unsolvable() -> RunSteps[SimulatedRun]:
    """Return a generator of steps that raises ``UnsolvableStepError``, for a creature that cannot come to rest on its
    ground."""
    raise UnsolvableStepError(UNSOLVABLE)
    yield


def _resumed(run: _Run, done: list[StepReport] | None) -> tuple[str, Any]:
    """Continue ``run``. Return "done" and the summary of the run, which is None before its end; or "failed" and the
    reason in one line."""
    return run_task(partial(run.resume, done), run.one.job, _no_progress)


def _advanced(
    stepper: BatchStepper, state: BatchState, runs: dict[int, _Run], done: dict[int, list[StepReport]]
) -> BatchState:
    """Compute the steps that the ``runs`` (keyed by world) request, add their reports to ``done``, and return the new
    state.

    A run whose step cannot be solved gets no reports, and its world is removed from the state.
    """
    import torch

    worlds = state.worlds.tolist()
    rows = [row for row, world in enumerate(worlds) if world in runs]
    state = state.gather(torch.tensor(rows, dtype=torch.int64, device=stepper.device))
    requests = [(runs[worlds[row]], _request(runs[worlds[row]])) for row in rows]
    if not requests:
        return state
    state = replace(state, velocities=_pushed_velocities(state, requests))
    dt = requests[0][1].dt
    if requests[0][0].one.is_planned:
        state, steps, _ = stepper.advance(state, [request.objectives for _, request in requests], dt)
    else:
        activations = np.stack([np.asarray(request.activations) for _, request in requests])
        state, steps, _ = stepper.advance_with_activations(state, activations, dt)
    for step in steps:
        for world, report in zip(step.worlds.tolist(), step.reports(), strict=True):
            done[world].append(report)
    return state


def _request(run: _Run) -> StepRequest:
    assert run.request is not None, "the run has not ended"
    return run.request


def _pushed_velocities(state: BatchState, requests: Sequence[tuple[_Run, StepRequest]]) -> torch.Tensor:
    """Return the velocities (c, N, 3) m/s of ``state``, with the velocities of pushed bodies replaced."""
    velocities = state.velocities
    for row, (run, request) in enumerate(requests):
        before = run.creature.start if run.last is None else run.last.state
        if request.state.velocities is not before.velocities:
            velocities = velocities.clone() if velocities is state.velocities else velocities
            velocities[row] = velocities.new_tensor(request.state.velocities)
    return velocities
