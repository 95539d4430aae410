"""One creature, many runs of it: side by side on a GPU, over processes of this machine, or over the hosts of a Ray
cluster."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.launching import available_threads, use_device
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.batched_runs import choose_batch_size, is_batchable, run_batched
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.job import Job, RunSummary
from egs_warp.pipelines.ray_pool import HERE, RayPool
from egs_warp.pipelines.report import GaussianCounts, Report
from egs_warp.pipelines.worker_pool import (
    ProcessPool,
    ProgressCallback,
    TaskFunction,
    TaskResult,
    WorkerPool,
    ended_tasks,
)


@dataclass(frozen=True)
class JobResult:
    """How a job ended."""

    job: Job
    attempts: int
    """How often it was begun: more than once where a worker was lost."""
    error: str | None
    """Why there is nothing else, in a line."""
    report: Report | None
    """As ``animate`` writes it."""
    frames: np.ndarray
    """(n,) index into the trajectory's times for each frame of a video at 60 Hz."""
    file: Path | None
    """Where the trajectory was written, if that was asked for."""
    in_memory_trajectory: Trajectory | None
    """The trajectory, otherwise."""

    @property
    def state(self) -> State | None:
        """How the motion ended, None where it has not."""
        return None if self.report is None else self.report.state

    @property
    def trajectory(self) -> Trajectory:
        """Every solver step, read from its file where it lies in one. Raises ``UserError`` where there is none."""
        if self.in_memory_trajectory is None and self.file is None:
            raise UserError(f"job: it has no trajectory: {self.error}")
        return self.in_memory_trajectory if self.in_memory_trajectory is not None else Trajectory.load(self.file)  # pyright: ignore[reportArgumentType]


def simulate_many(
    creature: Creature,
    jobs: Sequence[Job],
    *,
    workers: int | str | None = None,
    worlds: int | None = None,
    out: Path | str | None = None,
    ended: Callable[[int, JobResult], object] = lambda number, outcome: None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> tuple[JobResult, ...]:
    """Run all ``jobs`` of one ``creature``, several at a time; the outcomes are in the order of the jobs. Each has the
    bits of its run alone (``Job.perform``) on a machine of this kind, or, made side by side, its nodes within 1e-9 body
    heights of those for 30 steps.

    ``worlds``: of the jobs whose activations are given and that nothing pushes, how many are made side by side in this
    process, on the creature's device. If None, on a GPU as many as it has room for, up to 1,024, where there are two
    or more for each core of this machine, and else none; none if 0.
    All others go to workers.

    ``workers``: how many processes of this machine, as many as it has cores if None; ``"ray"``, or the address of a Ray
    cluster, for its cores (docs/guide/many.md). Each is sent the creature once, and uses one core. A job whose worker
    is lost is begun again, at most twice; one that ends in an error says so in its outcome, and the others go on.
    ``out``: a folder for trajectories, ``job-0000.npz`` and so on, which then do not lie in memory. ``ended`` is told
    the number of each job as it ends, from 0, and its outcome; ``progress`` after each frame how many are done, and how
    many are expected in all by now. Raises ``UserError`` for workers that cannot be had.
    """
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
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
        counts.over(task.number)
        ended(task.number, outcome)
    return tuple(outcome for outcome in outcomes if outcome is not None)


def _run_jobs(
    creature: Creature, jobs: Sequence[Job], workers: int | str | None, worlds: int | None, counts: _FrameCounter
) -> Iterator[TaskResult]:
    """The jobs as they end: first those side by side."""
    if worlds is not None and worlds < 0:
        raise ArgumentError("worlds", "give how many are made side by side, at least 0", value=worlds)
    beside = [number for number, job in enumerate(jobs) if is_batchable(job)]
    worlds = choose_batch_size(creature, len(beside)) if worlds is None else worlds
    beside = beside if worlds > 0 else []
    yield from run_batched(creature, [(number, jobs[number]) for number in beside], worlds=worlds, told=counts.all_told)
    left = sorted(set(range(len(jobs))) - set(beside))
    given = [jobs[number] for number in left]

    def told(number: int, *values: Any) -> None:
        counts.told(left[number], *values)

    if given:
        for task in map_tasks(_RunJob(creature), given, workers=workers, told=told):
            yield replace(task, number=left[task.number])


def map_tasks(
    work: TaskFunction,
    tasks: Sequence[Any],
    *,
    workers: int | str | None = None,
    told: Callable[..., object] = lambda number, *values: None,
) -> Iterator[TaskResult]:
    """Each of ``tasks`` as ``work(task, tell)`` ends it, in whatever order; ``workers`` as in ``simulate_many``,
    ``told`` gets the number of a task and what it tells.

    Raises ``UserError`` for workers that cannot be had.
    """
    if not tasks:
        return
    yield from ended_tasks(_crew(work, workers, len(tasks)), tasks, told)


def _crew(work: TaskFunction, workers: int | str | None, tasks: int) -> WorkerPool:
    if isinstance(workers, str):
        if workers not in (HERE, "auto") and ":" not in workers:
            raise ArgumentError("workers", "give a number of processes, ray, or a Ray cluster's address", value=workers)
        return RayPool(work, tasks, workers)
    if workers is not None and workers < 1:
        raise ArgumentError("workers", "give a number of processes, at least 1", value=workers)
    return ProcessPool(work, min(tasks, workers or available_threads()))


class _RunJob:
    """What a worker does with a job."""

    def __init__(self, creature: Creature) -> None:
        self._device = str(creature.cloud.device)
        # A dot in place of its splats, which no motion sees.
        dot = [np.zeros((1, *shape)) for shape in ((3,), (4,), (3,), (), (1, 3))]
        cloud = GaussianCloud.from_numpy(*dot, device=self._device)
        # Read in the worker once it has said that Warp is to be quiet.
        self._sent: bytes = pickle.dumps(replace(creature, cloud=cloud))
        self._creature: Creature | None = None

    def __call__(self, job: Job, tell: ProgressCallback) -> RunSummary:
        if self._creature is None:
            use_device(self._device)
            self._creature = pickle.loads(self._sent)
            assert self._creature is not None, "it was sent"
        creature = self._creature
        return job.outcome(creature, job.run(creature, progress=tell))


class _FrameCounter:
    """Frames of all jobs, done and expected; those not begun are expected to have as many as the others have."""

    def __init__(self, jobs: int, progress: Callable[[int, int], object]) -> None:
        self._jobs, self._progress = jobs, progress
        self._known: dict[int, tuple[int, int]] = {}

    def told(self, number: int, done: int, expected: int) -> None:
        """By a job, after a frame."""
        self.all_told({number: (done, expected)})

    def all_told(self, told: dict[int, tuple[int, int]]) -> None:
        """Likewise by several at a time."""
        self._known |= told
        done, expected = np.sum(list(self._known.values()), axis=0).tolist()
        self._progress(done, round(expected * self._jobs / len(self._known)))

    def over(self, number: int) -> None:
        """Once a job has ended: with what it has done."""
        done, _ = self._known.get(number, (0, 0))
        self.told(number, done, done)
