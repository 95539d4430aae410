"""Many runs of one creature or of one world: in batches on a GPU, in processes on this machine, or on a Ray cluster."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast, overload

import numpy as np

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.launching import available_threads, use_device
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.batched_runs import choose_batch_size, is_batchable, run_batched
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.job import Job, RunSummary
from egs_warp.pipelines.ray_pool import DEFAULT_ADDRESS, RayPool
from egs_warp.pipelines.report import GaussianCounts, Report
from egs_warp.pipelines.worker_pool import (
    ProcessPool,
    ProgressCallback,
    TaskFunction,
    TaskResult,
    WorkerPool,
    ended_tasks,
)
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_job import WorldJob, WorldSummary
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class JobResult:
    """Result of a job of a creature."""

    __repr__ = short_repr

    job: Job
    attempts: int
    """Number of attempts: more than one if a worker was lost."""
    error: str | None
    """Reason for a failure in one line; None if the job succeeded. A failed job has no report and no trajectory."""
    report: Report | None
    """Report, as ``animate`` writes it."""
    frames: np.ndarray
    """(n,) Index of the trajectory's state for each frame of a video at 60 Hz."""
    file: Path | None
    """File of the trajectory; None if no folder was given or the job failed."""
    in_memory_trajectory: Trajectory | None
    """Trajectory; None if it was written to ``file`` or the job failed."""

    @property
    def state(self) -> State | None:
        """State of the run; None if the job failed."""
        return None if self.report is None else self.report.state

    @property
    def trajectory(self) -> Trajectory:
        """All solver steps, read from ``file`` if they are not in memory. Raises ``UserError`` if the job failed."""
        if self.in_memory_trajectory is None and self.file is None:
            raise UserError(f"job: it has no trajectory, because it failed: {self.error}")
        return self.in_memory_trajectory if self.in_memory_trajectory is not None else Trajectory.load(self.file)  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True)
class WorldJobResult:
    """Result of a job of a world."""

    __repr__ = short_repr

    job: WorldJob
    attempts: int
    """Number of attempts: more than one if a worker was lost."""
    error: str | None
    """Reason for a failure in one line; None if the job succeeded. A failed job has no bodies."""
    bodies: WorldSummary
    """Report, frames and trajectory of each body by its name."""

    @property
    def state(self) -> State | None:
        """Worst state of all bodies; None if the job failed."""
        if self.error is not None:
            return None
        if any(body.stopped for body in self.bodies.values()):
            return State.STOPPED
        return State.worst(tuple(body.report.state for body in self.bodies.values()))


@overload
def simulate_many(
    creature: Creature,
    jobs: Sequence[Job],
    *,
    workers: int | str | None = ...,
    worlds: int | None = ...,
    out: Path | str | None = ...,
    ended: Callable[[int, JobResult], object] = ...,
    progress: Callable[[int, int], object] = ...,
) -> tuple[JobResult, ...]: ...


@overload
def simulate_many(
    creature: World,
    jobs: Sequence[WorldJob],
    *,
    workers: int | str | None = ...,
    out: Path | str | None = ...,
    ended: Callable[[int, WorldJobResult], object] = ...,
    progress: Callable[[int, int], object] = ...,
) -> tuple[WorldJobResult, ...]: ...


def simulate_many(
    creature: Creature | World,
    jobs: Sequence[Job] | Sequence[WorldJob],
    *,
    workers: int | str | None = None,
    worlds: int | None = None,
    out: Path | str | None = None,
    ended: Callable[[int, Any], object] = lambda number, outcome: None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> tuple[JobResult, ...] | tuple[WorldJobResult, ...]:
    """Run all ``jobs`` of one ``creature`` or of one world, several at a time.

    In a worker process, the result of a job is bitwise equal to that of ``Job.run`` on a machine of the same kind. In a
    batch, the node positions differ from those of ``Job.run`` by less than 1e-9 body heights in the first 30 steps, as
    long as rounding does not decide between contact modes (docs/guide/many.md#gpu).

    Each worker receives the creature once and uses one core. A job whose worker is lost is run again, at most twice.
    The result of a job that fails contains an error; the other jobs continue.

    Args:
        creature: The creature of all jobs, or a world, whose jobs are ``WorldJob``.
        jobs: The jobs.
        workers: Number of processes on this machine; None uses its number of cores; ``"ray"`` or the address of a Ray
            cluster uses the cores of the cluster (docs/guide/many.md).
        worlds: Batch size for the jobs that can run in batches in this process, on the creature's device. These are all
            jobs of a creature, unless they are planned with the strategy ``paper`` or the QP solver ``daqp``. None uses
            batches of up to 1,024 jobs on a GPU if there are at least two such jobs for each core of this machine. 0
            uses no batches.
        out: Folder for trajectories, ``job-0000.npz`` and so on, which are then not held in memory. Those of a world,
            ``job-0000/NAME.npz``, are held in memory, too.
        ended: Called when a job ends, with its number from 0 and its result.
        progress: Called after each frame with the number of finished frames and the number expected in total.

    Returns:
        The results in the order of the jobs.

    Raises:
        UserError: The workers cannot be started, or ``jobs`` are not of the kind that ``creature`` requires.
    """
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    kind = WorldJob if isinstance(creature, World) else Job
    for number, job in enumerate(jobs):
        if not isinstance(job, kind):
            owner = "a world" if isinstance(creature, World) else "a creature"
            raise ArgumentError(
                "jobs", f"job {number} is a {type(job).__name__}; give only egs.{kind.__name__}, the jobs of {owner}"
            )
    if isinstance(creature, World):
        if worlds is not None:
            raise ArgumentError("worlds", "batches are for one creature; leave it out", value=worlds)
        return _simulate_worlds(creature, cast(Sequence[WorldJob], jobs), workers, folder, ended, progress)
    jobs = cast(Sequence[Job], jobs)
    outcomes: list[JobResult | None] = [None] * len(jobs)
    counts = _FrameCounter(len(jobs), progress)
    for task in _run_jobs(creature, jobs, workers, worlds, counts):
        report, frames, trajectory = task.value or (None, np.zeros(0, int), None)
        if report is not None:
            report = replace(report, gaussians=GaussianCounts.of(creature))
        file = None
        if folder is not None and trajectory is not None:
            file = folder / f"job-{task.number:04d}.npz"
            trajectory.save(file)
        outcome = JobResult(
            jobs[task.number], task.attempts, task.error, report, frames, file, trajectory if file is None else None
        )
        outcomes[task.number] = outcome
        counts.finish(task.number)
        ended(task.number, outcome)
    return tuple(outcome for outcome in outcomes if outcome is not None)


def _simulate_worlds(
    world: World,
    jobs: Sequence[WorldJob],
    workers: int | str | None,
    folder: Path | None,
    ended: Callable[[int, WorldJobResult], object],
    progress: Callable[[int, int], object],
) -> tuple[WorldJobResult, ...]:
    """Run the jobs of a world; the arguments are those of ``simulate_many``."""
    outcomes: list[WorldJobResult | None] = [None] * len(jobs)
    counts = _FrameCounter(len(jobs), progress)
    for task in map_tasks(_RunWorldJob(world), jobs, workers=workers, progress=counts.update) if jobs else ():
        bodies: WorldSummary = task.value or {}
        if folder is not None and bodies:
            own = folder / f"job-{task.number:04d}"
            own.mkdir(exist_ok=True)
            for name, body in bodies.items():
                body.trajectory.save(own / f"{name}.npz")
        outcome = WorldJobResult(jobs[task.number], task.attempts, task.error, bodies)
        outcomes[task.number] = outcome
        counts.finish(task.number)
        ended(task.number, outcome)
    return tuple(outcome for outcome in outcomes if outcome is not None)


def _run_jobs(
    creature: Creature, jobs: Sequence[Job], workers: int | str | None, worlds: int | None, counts: _FrameCounter
) -> Iterator[TaskResult]:
    """Run the jobs and yield each result as soon as it is available; batches run first."""
    if worlds is not None and worlds < 0:
        raise ArgumentError("worlds", "give the number of jobs in a batch, at least 0", value=worlds)
    batched = [number for number, job in enumerate(jobs) if is_batchable(creature, job)]
    worlds = choose_batch_size(creature, len(batched)) if worlds is None else worlds
    batched = batched if worlds > 0 else []
    yield from run_batched(
        creature, [(number, jobs[number]) for number in batched], worlds=worlds, progress=counts.update_all
    )
    remaining = sorted(set(range(len(jobs))) - set(batched))
    remaining_jobs = [jobs[number] for number in remaining]

    def update(number: int, *values: Any) -> None:
        counts.update(remaining[number], *values)

    if remaining_jobs:
        for task in map_tasks(_RunJob(creature), remaining_jobs, workers=workers, progress=update):
            yield replace(task, number=remaining[task.number])


def map_tasks(
    work: TaskFunction,
    tasks: Sequence[Any],
    *,
    workers: int | str | None = None,
    progress: Callable[..., object] = lambda number, *values: None,
) -> Iterator[TaskResult]:
    """Call ``work(task, progress)`` for each task in worker processes, and yield each result as soon as it is
    available.

    Args:
        work: The function; it must be picklable, like tasks and results.
        tasks: The tasks.
        workers: As in ``simulate_many``.
        progress: Called with the index of a task and the values that it reports.

    Raises:
        UserError: The workers cannot be started.
    """
    if not tasks:
        return
    yield from ended_tasks(_create_pool(work, workers, len(tasks)), tasks, progress)


def _create_pool(work: TaskFunction, workers: int | str | None, tasks: int) -> WorkerPool:
    if isinstance(workers, str):
        if workers not in (DEFAULT_ADDRESS, "auto") and ":" not in workers:
            raise ArgumentError("workers", "give a number of processes, ray, or a Ray cluster's address", value=workers)
        return RayPool(work, tasks, workers)
    if workers is not None and workers < 1:
        raise ArgumentError("workers", "give a number of processes, at least 1", value=workers)
    return ProcessPool(work, min(tasks, workers or available_threads()))


class _RunJob:
    """Task function that runs a job of a creature in a worker."""

    def __init__(self, creature: Creature) -> None:
        self._device = str(creature.cloud.device)
        # Send a single Gaussian instead of the capture, because no motion uses the capture.
        dot = [np.zeros((1, *shape)) for shape in ((3,), (4,), (3,), (), (1, 3))]
        cloud = GaussianCloud.from_numpy(*dot, device=self._device)
        # Send the creature pickled: the worker unpickles it after ``use_device``, which suppresses Warp's start
        # message.
        self._pickled_creature: bytes = pickle.dumps(replace(creature, cloud=cloud))
        self._creature: Creature | None = None

    def __call__(self, job: Job, progress: ProgressCallback) -> RunSummary:
        if self._creature is None:
            use_device(self._device)
            self._creature = pickle.loads(self._pickled_creature)
            assert self._creature is not None, "the creature was sent"
        creature = self._creature
        return job.outcome(job.run(creature, progress=progress))


class _RunWorldJob:
    """Task function that runs a job of a world in a worker."""

    def __init__(self, world: World) -> None:
        # Compute the level sets here, so that the workers receive them instead of computing them.
        world.stepper()
        self._pickled_world: bytes = pickle.dumps(world)
        self._world: World | None = None

    def __call__(self, job: WorldJob, progress: ProgressCallback) -> WorldSummary:
        if self._world is None:
            use_device("cpu")
            self._world = pickle.loads(self._pickled_world)
            assert self._world is not None, "the world was sent"
        return job.outcome(job.run(self._world, progress=progress))


class _FrameCounter:
    """Counts of finished and of expected frames over all jobs.

    A job that has not started is expected to have the mean number of frames of the other jobs.
    """

    def __init__(self, jobs: int, progress: Callable[[int, int], object]) -> None:
        self._jobs, self._progress = jobs, progress
        self._frames: dict[int, tuple[int, int]] = {}

    def update(self, number: int, done: int, expected: int) -> None:
        """Record the frames of one job."""
        self.update_all({number: (done, expected)})

    def update_all(self, frames: dict[int, tuple[int, int]]) -> None:
        """Record the numbers of finished and of expected frames of several jobs."""
        self._frames |= frames
        done, expected = np.sum(list(self._frames.values()), axis=0).tolist()
        self._progress(done, round(expected * self._jobs / len(self._frames)))

    def finish(self, number: int) -> None:
        """Record that a job has ended, so that its finished frames are all of its frames."""
        done, _ = self._frames.get(number, (0, 0))
        self.update(number, done, done)
