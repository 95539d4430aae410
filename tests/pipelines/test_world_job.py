"""Jobs of a world in ``simulate_many``, which run in worker processes with the same bits as single runs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.motions.style import Style
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.job import Job
from egs_warp.pipelines.many import WorldJobResult, simulate_many
from egs_warp.pipelines.prop import make_prop
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_job import BodyOutcome, WorldJob
from tests.support.live_sessions import coarse_pawn


@pytest.mark.slow
def test_jobs_of_a_world_have_the_bits_of_a_run_alone(tmp_path: Path) -> None:
    pawn, world = coarse_pawn(), World(friction=0.7)
    world.add(pawn, heading=0.0, name="jumper")
    target = make_prop(pawn.cloud, up=np.array([0.0, 0.0, 1.0]), height=0.4, density=200)
    world.add(target, at=(0.55, 0.0), name="target")
    jobs = [WorldJob({"jumper": "jump 0.3"}, frames=6), WorldJob({"knight": "jump"}, frames=6)]
    first, second = simulate_many(world, jobs, workers=1, out=tmp_path)
    alone = jobs[0].run(world)
    assert first.error is None and first.state is State.CUT_OFF and list(first.bodies) == ["jumper", "target"]
    for name, outcome in first.bodies.items():
        np.testing.assert_array_equal(outcome.trajectory.positions, alone[name].trajectory.positions)
        np.testing.assert_array_equal(
            Trajectory.load(tmp_path / "job-0000" / f"{name}.npz").positions, outcome.trajectory.positions
        )
    assert second.state is None and "motion of 'knight': the world has no such body" in str(second.error)


def test_a_world_of_props_that_stopped_is_not_done() -> None:
    """A prop has no motion, so only the job itself can report that a step was not solved."""
    report: Any = SimpleNamespace(state=State.DONE)
    trajectory: Any = None
    for stopped, state in ((False, State.DONE), (True, State.STOPPED)):
        bodies = {"box": BodyOutcome(report, np.zeros(1, int), trajectory, stopped)}
        assert WorldJobResult(WorldJob(), 1, None, bodies).state is state


def test_jobs_of_a_creature_are_no_jobs_of_a_world() -> None:
    jobs: Any = [Job(motion("jump"))]
    with pytest.raises(UserError, match=r"jobs: job 0 is a Job; give only egs\.WorldJob, the jobs of a world"):
        simulate_many(World(), jobs)
    with pytest.raises(UserError, match="worlds 4: batches are for one creature"):
        simulate_many(World(), [WorldJob()], worlds=4)  # pyright: ignore[reportCallIssue, reportArgumentType]


def test_a_style_without_a_jump_is_refused_when_a_job_is_created() -> None:
    style = Style(squash=2.0)
    assert WorldJob({"a": "walk 1, kick b", "b": "hop"}, style=style).style == style
    with pytest.raises(UserError, match="style: no motion of 'walk' jumps"):
        WorldJob({"a": "walk 1, kick b"}, style=style)
