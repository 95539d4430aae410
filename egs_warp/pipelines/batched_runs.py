"""Jobs whose activations are given, many at a time in one process on the creature's own device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import UNSOLVABLE, UnsolvableStepError
from egs_warp.launching import available_threads
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.pipelines.creature import Creature, checked_friction
from egs_warp.pipelines.job import Job, RunSummary
from egs_warp.pipelines.simulated_run import check_frames, checked_activations
from egs_warp.pipelines.worker_pool import ProgressCallback, TaskResult, run_task

if TYPE_CHECKING:
    from egs_warp.locomotion.batch import BatchStepper

MOST_WORLDS = 1024
"""Side by side: more are hardly faster, and what they have done lies in memory until they end."""
_SHARE = 0.4
"""Of the free memory of a GPU that factors of matrices may take."""
_WORTH = 2
"""Jobs for each core of the machine from which on they end sooner side by side: on an H100 eight worlds of 253 nodes
make 101 steps a second, one process 21."""


def choose_batch_size(creature: Creature, jobs: int) -> int:
    """How many of so many ``jobs`` to do side by side: as many as the creature's device has room for, and 0 where
    workers do so few sooner, that device is a CPU, torch does not see it, or the ground is not flat."""
    device = creature.body.assembly.device
    if not device.is_cuda or creature.geometry.field is not None or jobs < _WORTH * available_threads():
        return 0
    try:
        import torch
    except ImportError:
        return 0
    if not torch.cuda.is_available():
        return 0
    free, _ = torch.cuda.mem_get_info(str(device))
    return min(MOST_WORLDS, int(_SHARE * free) // (72 * len(creature.body.mesh.nodes) ** 2))


def is_batchable(job: Job) -> bool:
    """Whether the job can be done beside others: its muscles do what is given, and nothing pushes it."""
    return job.activations is not None and not job.pushes


def run_batched(
    creature: Creature,
    jobs: Sequence[tuple[int, Job]],
    *,
    worlds: int,
    told: Callable[[dict[int, tuple[int, int]]], object],
) -> Iterator[TaskResult]:
    """The ``jobs``, each with its number, as each ends: so many ``worlds`` side by side, those of one length of step
    together. ``told`` hears after each frame of each job in work how many it has done, and of how many."""
    entered: list[_BatchJob] = []
    for number, job in jobs:
        kind, value = run_task(partial(_make_batch_job, creature, number), job, told)
        if kind == "done":
            entered.append(value)
        else:
            yield TaskResult(number, None, value, 1)
    entered.sort(key=lambda one: (one.dt, one.number))
    for _, alike in groupby(entered, key=lambda one: one.dt):
        every = list(alike)
        for first in range(0, len(every), worlds):
            yield from _run_batch(creature, every[first : first + worlds], told)


@dataclass(frozen=True)
class _BatchJob:
    """A job that can be done."""

    number: int
    job: Job
    friction: float
    dt: float
    """Seconds of a step."""
    per_frame: int
    activations: np.ndarray
    """(steps, M) metres, of whole frames."""


def _make_batch_job(creature: Creature, number: int, job: Job, _: ProgressCallback) -> _BatchJob:
    """Raises ``UserError`` for what cannot be done."""
    assert job.activations is not None, "it fits"
    check_frames(job.frames)
    friction = creature.geometry.friction if job.friction is None else checked_friction(job.friction)
    given = checked_activations(creature, job.activations, job.step)
    dt, per_frame = solver_steps(creature.body, job.step)
    frames = len(given) // per_frame
    frames = frames if job.frames is None else min(frames, job.frames - 1)
    return _BatchJob(number, job, friction, dt, per_frame, given[: frames * per_frame])


def _run_batch(
    creature: Creature, together: Sequence[_BatchJob], told: Callable[[dict[int, tuple[int, int]]], object]
) -> Iterator[TaskResult]:
    """Step all, then tell of each. What there is no room for is done again in halves."""
    import torch

    run, cramped = None, ""
    try:
        run = _run(creature, together, told)
    except torch.OutOfMemoryError as error:
        cramped = " ".join(str(error).split())
    # Past the except, whose traceback holds what there was no more room beside.
    if run is None and len(together) == 1:
        why = f"out of GPU memory beside nothing else; give worlds=0 for workers: {cramped}"
        yield TaskResult(together[0].number, None, why, 1)
        return
    if run is None:
        torch.cuda.empty_cache()
        half = len(together) // 2
        yield from _run_batch(creature, together[:half], told)
        yield from _run_batch(creature, together[half:], told)
        return
    for one, its, made, gone in zip(together, run.creatures, run.steps, run.lost, strict=True):
        kind, value = run_task(partial(_outcome, its, made, gone), one.job, told)
        yield TaskResult(one.number, *((value, None) if kind == "done" else (None, value)), 1)


@dataclass(frozen=True)
class _Run:
    """What jobs have done side by side, each with a row."""

    creatures: list[Creature]
    """On their own ground."""
    steps: list[list[list[StepReport]]]
    """See ``_stepped``."""
    lost: list[bool]
    """Whether there is no standing on that ground."""


def _run(
    creature: Creature, together: Sequence[_BatchJob], told: Callable[[dict[int, tuple[int, int]]], object]
) -> _Run:
    from egs_warp.locomotion.batch import BatchStepper

    stepper = BatchStepper(
        *(creature.body, creature.muscles, creature.geometry, [one.friction for one in together]),
        settings=creature.stepper.settings,
    )
    starts = [creature.start] * len(together)
    lost = [False] * len(together)
    # On its own ground the creature stands already.
    if any(one.job.friction is not None for one in together):
        settled, failed = stepper.settle()
        moved = [one.job.friction is not None for one in together]
        starts = [there if anew else start for there, anew, start in zip(settled, moved, starts, strict=True)]
        lost = [bool(gone) and anew for gone, anew in zip(failed.tolist(), moved, strict=True)]
    creatures = [
        replace(creature, stepper=creature.stepper.with_friction(one.friction), start=start)
        for one, start in zip(together, starts, strict=True)
    ]
    return _Run(creatures, _stepped(stepper, together, creatures, told), lost)


def _outcome(creature: Creature, made: list[list[StepReport]], lost: bool, job: Job, _: ProgressCallback) -> RunSummary:
    if lost:
        raise UnsolvableStepError(UNSOLVABLE)
    return job.outcome(creature, job.run_on_ground(replace(creature, stepper=_ReplayStepper(creature.stepper, made))))


class _ReplayStepper(LocomotionStepper):
    """Of a run whose steps were made beside others: it tells them again, for the motion to measure."""

    def __init__(self, stepper: LocomotionStepper, made: list[list[StepReport]]) -> None:
        vars(self).update(vars(stepper))
        self._made = iter(made)

    def advance_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        """The next step in its parts."""
        done = next(self._made)
        if not done:
            raise UnsolvableStepError(UNSOLVABLE)
        return done[-1].state, WarmStart.from_report(done[-1]), done


def _stepped(
    stepper: BatchStepper,
    together: Sequence[_BatchJob],
    creatures: Sequence[Creature],
    told: Callable[[dict[int, tuple[int, int]]], object],
) -> list[list[list[StepReport]]]:
    """Of each the reports of each of its steps; the last of one that cannot be solved has none."""
    import torch

    runs: list[list[list[StepReport]]] = [[] for _ in together]
    state = stepper.start([creature.start for creature in creatures])
    longest, per_frame = max(len(one.activations) for one in together), together[0].per_frame
    for number in range(longest):
        asked = torch.tensor([len(together[world].activations) > number for world in state.worlds.tolist()])
        state = state.gather(asked.nonzero().squeeze(1).to(stepper.device))
        if len(state.worlds) == 0:
            break
        worlds = state.worlds.tolist()
        for world in worlds:
            runs[world].append([])
        given = np.stack([together[world].activations[number] for world in worlds])
        state, done, _ = stepper.advance(state, given, together[0].dt)
        for step in done:
            for world, report in zip(step.worlds.tolist(), step.reports(), strict=True):
                runs[world][-1].append(report)
        if (number + 1) % per_frame == 0:
            frame = (number + 1) // per_frame
            told({together[w].number: (frame, len(together[w].activations) // per_frame) for w in worlds})
    return runs
