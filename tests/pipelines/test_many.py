"""Many runs of one creature, each of which has the bits of a single run."""

from __future__ import annotations

import importlib.util
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.gaussians import ARRAYS
from egs_warp.locomotion.batch import BatchStepper
from egs_warp.locomotion.batch_state import BatchState
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.push import read_pushes
from egs_warp.motions.script import motion
from egs_warp.motions.style import read_style
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.job import Job
from egs_warp.pipelines.many import JobResult, simulate_many
from egs_warp.pipelines.simulated_run import simulate
from tests.support.creatures import coarse_pawn

FRAMES, FEW = 31, 11
"""Numbers of frames of long and of short jobs, which are the first frame plus 30 or 10 steps."""


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


@pytest.fixture(scope="module")
def jobs(creature: Creature) -> list[Job]:
    """Return jobs that differ in target, friction, style, push or activations, and two invalid ones."""
    count = creature.muscles.segment_count
    held = 0.1 * np.sin(np.arange(10.0)[:, None] + np.arange(count)) * creature.muscles.bounds
    return [
        Job(motion("jump"), frames=FRAMES),
        Job(motion("jump 0.2 0.1"), frames=FEW),
        Job(motion("jump"), friction=0.3, frames=FRAMES),
        Job(motion("jump"), frames=FEW, style=read_style("anticipation=1.5")),
        Job(motion("stand 1"), frames=FEW, pushes=read_pushes("0.05 0.3 left"), get_up=False),
        Job(motion("stand 1"), activations=held, get_up=False),
        Job(motion("jump"), frames=FEW, activations=held[:, 2:]),
        Job(motion("stand 1"), activations=held[:, 1:]),
    ]


@pytest.fixture(scope="module")
def progress_calls() -> list[tuple[int, int]]:
    return []


@pytest.fixture(scope="module")
def outcomes(creature: Creature, jobs: list[Job], progress_calls: list[tuple[int, int]]) -> tuple[JobResult, ...]:
    return simulate_many(
        creature, jobs, workers=2, progress=lambda done, expected: progress_calls.append((done, expected))
    )


def same(one: Trajectory, other: Trajectory) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name == "planned_com")
        for name in one.__dataclass_fields__
    )


def test_each_result_has_the_bits_of_a_single_run(
    creature: Creature, jobs: list[Job], outcomes: tuple[JobResult, ...]
) -> None:
    alone = {
        0: simulate(creature, jobs[0].motion, frames=FRAMES),
        1: simulate(creature, jobs[1].motion, frames=FEW),
        2: simulate(creature.with_friction(0.3), jobs[2].motion, frames=FRAMES),
        3: simulate(creature, jobs[3].motion, frames=FEW, style=jobs[3].style),
        4: simulate(creature, jobs[4].motion, frames=FEW, pushes=jobs[4].pushes, get_up=False),
        5: simulate(creature, jobs[5].motion, activations=jobs[5].activations, get_up=False),
    }
    for number, performance in alone.items():
        outcome = outcomes[number]
        assert outcome.job is jobs[number] and outcome.error is None and outcome.attempts == 1
        assert len(outcome.trajectory.dt) >= (30 if number in (0, 2) else 10)
        assert same(outcome.trajectory, performance.trajectory), number
        assert np.array_equal(outcome.frames, performance.simulation.frames)
    # The trajectories differ from one another.
    ends = np.array([outcomes[number].trajectory.positions[10] for number in alone])
    apart = np.abs(ends[:, None] - ends[None]).max(axis=(2, 3)) + np.eye(len(ends))
    assert apart.min() > 1e-6 * creature.body.height
    assert outcomes[2].trajectory.friction == 0.3 and outcomes[0].trajectory.friction == 0.8


def test_the_error_of_one_does_not_end_the_others(outcomes: tuple[JobResult, ...]) -> None:
    assert outcomes[6].error is not None and outcomes[6].error.startswith("activations: of shape (10, ")
    assert outcomes[7].error is not None and outcomes[7].error.startswith("activations: of shape (10, ")
    for outcome in outcomes[6:]:
        assert outcome.state is None and outcome.report is None and outcome.attempts == 1
        with pytest.raises(UserError, match="job: it has no trajectory"):
            _ = outcome.trajectory


def test_reports_have_the_end_state(creature: Creature, outcomes: tuple[JobResult, ...]) -> None:
    for outcome in outcomes[:6]:
        assert outcome.report is not None
        assert outcome.state is outcome.report.state is not State.DONE
        assert outcome.report.gaussians.read == creature.cloud.count
        assert outcome.report.cage.nodes == len(creature.body.mesh.nodes)
        assert outcome.report.audit.momentum_residual < 1e-9
    assert outcomes[2].report is not None and outcomes[2].report.asked["friction"] == 0.3


def test_progress_ends_at_the_total(progress_calls: list[tuple[int, int]], outcomes: tuple[JobResult, ...]) -> None:
    frames = sum(len(outcome.frames) - 1 for outcome in outcomes if outcome.report is not None)
    done = [one for one, _ in progress_calls]
    assert (
        progress_calls[-1] == (frames, frames) and done == sorted(done) and all(one <= of for one, of in progress_calls)
    )


@pytest.mark.slow
def test_worlds_of_a_batch_equal_single_runs(creature: Creature, tmp_path: Path) -> None:
    """The jobs have two step sizes, three grounds and different lengths; one is planned, and two are invalid. All
    trajectories agree with single runs to 1e-9 body heights, in the order of the jobs."""
    count = creature.muscles.segment_count
    held = 0.3 * np.sin(np.arange(6.0)[:, None] + np.arange(count)) * creature.muscles.bounds
    asked = motion("stand 1")
    jobs = [
        Job(asked, friction=0.3, activations=held, get_up=False),
        Job(asked, frames=4),
        Job(asked, activations=held[:4], get_up=False),
        Job(asked, friction=1.1, activations=-held, frames=4),
        Job(asked, activations=held, step=1.0 / 120.0),
        Job(asked, activations=held[:, 2:]),
        Job(asked, activations=held[:, 1:]),
    ]
    progress_calls: list[tuple[int, int]] = []
    ended: list[int] = []
    made = simulate_many(
        *(creature, jobs),
        worlds=2,
        workers=1,
        out=tmp_path,
        ended=lambda number, one: ended.append(number),
        progress=lambda done, of: progress_calls.append((done, of)),
    )
    assert sorted(ended) == list(range(7)) and progress_calls[-1] == (19, 19)
    assert [one.error for one in made[:5]] == [None] * 5
    assert made[5].error is not None and made[5].error.startswith("activations: of shape (")
    assert made[6].error is not None and made[6].error.startswith("activations: of shape (6, ")
    steps = []
    for job, outcome in zip(jobs[:5], made, strict=False):
        alone = job.run(creature)
        one, other = outcome.trajectory, alone.trajectory
        steps.append(len(one.dt))
        assert outcome.job is job and one.friction == other.friction == (job.friction or 0.8)
        assert np.array_equal(outcome.frames, alone.simulation.frames)
        assert np.array_equal(one.dt, other.dt) and np.array_equal(one.contact_step, other.contact_step)
        for name, unit in (("positions", creature.body.height), ("velocities", creature.body.speed_unit)):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-9 * unit)
        assert outcome.state is not None and outcome.report is not None
        assert outcome.report.audit.momentum_residual < 1e-9
        assert outcome.report.asked["activations"] == (job.activations is not None)
    assert steps == [6, 3, 4, 3, 6]


def test_a_batch_too_large_for_a_gpu_is_halved(creature: Creature, monkeypatch: pytest.MonkeyPatch) -> None:
    """With memory for only two of four requested worlds, the batch is halved; with memory for none, each result reports
    the error in one line."""
    room, asked = 2, []

    class Cramped(BatchStepper):
        def advance_with_activations(self, state: BatchState, *given: Any) -> Any:
            asked.append(len(state.worlds))
            if len(state.worlds) > room:
                raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 20.00 MiB")
            return super().advance_with_activations(state, *given)

    monkeypatch.setattr("egs_warp.locomotion.batch.BatchStepper", Cramped)
    held = np.zeros((2, creature.muscles.segment_count))
    jobs = [Job(motion("stand 1"), activations=held + level, get_up=False) for level in (0.0, 1e-3, 2e-3, 3e-3)]
    made = simulate_many(creature, jobs, worlds=4)
    assert asked == [4, 2, 2, 2, 2] and [one.error for one in made] == [None] * 4
    np.testing.assert_array_equal([one.trajectory.activations[0, 0] for one in made], [0.0, 1e-3, 2e-3, 3e-3])
    room = 0
    assert [one.error for one in simulate_many(creature, jobs[:2], worlds=2)] == [
        "out of GPU memory with a single world; set worlds=0 to use worker processes: CUDA out of memory. Tried to"
        " allocate 20.00 MiB"
    ] * 2


def test_a_negative_number_of_worlds_is_refused(creature: Creature) -> None:
    with pytest.raises(ArgumentError, match=r"^worlds -1: give the number of jobs in a batch, at least 0$"):
        simulate_many(creature, [Job(motion("stand 1"))], worlds=-1)


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (the extra ray)")
def test_over_ray_it_has_the_same_bits(creature: Creature, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    job = Job(motion("jump 0.2 0.1"), friction=0.5, frames=FEW)
    (outcome,) = simulate_many(creature, [job], workers="ray")
    assert outcome.error is None and same(outcome.trajectory, job.run(creature).trajectory)


def test_trajectories_may_be_written_to_a_folder(creature: Creature, tmp_path: Path) -> None:
    """The callback receives the number of the job with each result."""
    ended: dict[int, JobResult] = {}
    jobs = [Job(motion("stand 1"), frames=count) for count in (4, 3)]
    made = simulate_many(
        creature, jobs, workers=1, out=tmp_path / "runs", ended=lambda number, one: ended.update({number: one})
    )
    assert [one.file for one in made] == [tmp_path / "runs" / f"job-000{number}.npz" for number in (0, 1)]
    assert [one.in_memory_trajectory for one in made] == [None, None] and [ended[0], ended[1]] == list(made)
    assert [len(one.trajectory.dt) for one in made] == [3, 2]


def test_a_creature_can_be_pickled(creature: Creature) -> None:
    """A pickled copy of a creature moves identically and has the same splats."""
    other: Creature = pickle.loads(pickle.dumps(creature))
    asked = motion("jump")
    assert same(simulate(other, asked, frames=5).trajectory, simulate(creature, asked, frames=5).trajectory)
    assert other.cloud.antialiased == creature.cloud.antialiased
    for name in ARRAYS:
        assert np.array_equal(getattr(other.cloud, name).numpy(), getattr(creature.cloud, name).numpy()), name


@pytest.mark.slow
def test_a_changed_ground_equals_that_of_a_new_creature(creature: Creature) -> None:
    again = coarse_pawn(friction=0.4)
    other = creature.with_friction(0.4)
    assert other.geometry.friction == other.stepper.planner.friction == 0.4
    assert np.array_equal(other.start.positions, again.start.positions)
    with pytest.raises(ArgumentError, match=r"^friction nan: give a Coulomb coefficient from 0 to 10$"):
        creature.with_friction(float("nan"))


def test_activations_of_a_run_reproduce_it(creature: Creature) -> None:
    """A run with the recorded activations of 10 steps agrees to 1e-3 body heights. The agreement is not exact, because
    contact points are selected differently if the activations are prescribed."""
    first = simulate(creature, motion("jump"), frames=11)
    assert all(report.dt == first.simulation.reports[0].dt for report in first.simulation.reports)
    again = simulate(creature, motion("jump"), activations=first.trajectory.activations)
    assert np.array_equal(again.trajectory.activations, first.trajectory.activations)
    off = np.abs(again.trajectory.positions - first.trajectory.positions).max()
    assert off < 1e-3 * creature.body.height
    still = simulate(creature, motion("jump"), activations=np.zeros_like(first.trajectory.activations))
    moved = np.abs(still.trajectory.positions[-1] - first.trajectory.positions[-1]).max()
    assert moved > 1e-3 * creature.body.height


def test_activations_that_no_muscle_has_are_refused(creature: Creature) -> None:
    count, bounds = creature.muscles.segment_count, creature.muscles.bounds
    for given in (np.zeros((0, count)), np.zeros(count), np.zeros((5, count + 1))):
        with pytest.raises(ArgumentError, match=rf"^activations: of shape .*; give a row of {count} metres"):
            simulate(creature, motion("jump"), activations=given)
    for given in (np.tile(1.01 * bounds, (5, 1)), np.full((5, count), np.nan)):
        with pytest.raises(
            ArgumentError, match=r"^activations: .* m in row 0 is outside the bound .* m of muscle 0; keep"
        ):
            simulate(creature, motion("jump"), activations=given)
    assert replace(Job(motion("jump")), frames=2).run(creature).frames.shape[0] == 2
