"""Motions of many worlds of one body, compared with the same motions of one world each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.batch import BatchStepper
from egs_warp.locomotion.batch_objectives import BatchObjectives
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.motions.motion_batch import MotionBatch
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from egs_warp.pipelines.creature import Creature, initial_stance
from tests.support.creatures import coarse_pawn, on_its_rim

CPU = torch.device("cpu")
SCRIPTS = ("jump 0.2", "jump 0.6 0.3", "twist 60", "twist -30", "hop 0.3", "stand 0.05, jump 0.3", "stand 1", "nod")
"""Scripts of the worlds; the stands and the nod have no world axis."""


@pytest.fixture(scope="module")
def creature() -> Creature:
    """Return the coarse pawn with contact points only at its rim, for the reason given in ``test_batch_plan``."""
    pawn = coarse_pawn()
    settings, geometry = LocomotionSettings(qp_solver="admm"), on_its_rim(pawn.geometry)
    return replace(pawn, stepper=LocomotionStepper(pawn.body, pawn.muscles, geometry, settings=settings, device="cpu"))


def sequences(creature: Creature, scripts: tuple[str, ...]) -> list[MotionSequence]:
    place, made = initial_stance(creature), []
    for text in scripts:
        script = motion(text)
        script.check(place)
        made.append(MotionSequence(place, script.parts(creature.body.height)))
    return made


def stepper(creature: Creature, worlds: int) -> BatchStepper:
    single = creature.stepper
    return BatchStepper(
        *(creature.body, creature.muscles, single.geometry, [0.8] * worlds),
        settings=single.settings,
        planner=single.planner,
    )


def costs(objectives: BatchObjectives, velocities: np.ndarray) -> np.ndarray:
    """Return the costs (c, 4) of the objectives on the end velocity at ``velocities`` (4, 3N) m/s in every world."""
    values = [
        objectives.rows.value(torch.as_tensor(np.tile(each, (len(objectives.rows.rows), 1)))) for each in velocities
    ]
    return torch.stack(values, dim=1).numpy()


def test_objectives_of_many_worlds_equal_those_of_one(creature: Creature) -> None:
    """The bodies are stretched, rotated, raised and thrown, so that the motions pass through all of their phases."""
    body, dt, random = creature.body, solver_steps(creature.body)[0], np.random.default_rng(0)
    single, count = sequences(creature, SCRIPTS), len(SCRIPTS)
    together = MotionBatch(body, sequences(creature, SCRIPTS), CPU)
    start = stepper(creature, count).start([creature.start] * count)
    probes = random.standard_normal((4, creature.start.positions.size))
    up = -body.gravity / np.linalg.norm(body.gravity)
    for number, (time, rise, speed) in enumerate(
        [(0.0, 0, 0), (0.2, 0, 0), (0.9, 0, 1.0), (1.0, 0.2, 0.1), (1.1, 0, -1)]
    ):
        shape = np.eye(3) + 0.03 * random.standard_normal((count, 3, 3))
        positions = creature.start.positions @ shape.swapaxes(1, 2) + rise * body.height * up
        velocities = 0.05 * random.standard_normal(positions.shape) + speed * up
        state = replace(
            start,
            positions=torch.as_tensor(positions),
            velocities=torch.as_tensor(velocities),
            time=torch.full((count,), time, dtype=torch.float64),
        )
        mine = together.objectives(state, dt)
        each = [
            one.objectives(BodyState(*of), None, dt)
            for one, of in zip(single, zip(positions, velocities, [time] * count, strict=True), strict=True)
        ]
        its = BatchObjectives.stack(each, len(positions[0]), CPU)
        np.testing.assert_allclose(costs(mine, probes), costs(its, probes), rtol=1e-9, err_msg=str(number))
        for name in ("momentum_weights", "momentum_targets"):
            one, other = (getattr(of, name)[:, :1].numpy() for of in (mine, its))
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.slow
def test_motions_of_many_worlds_equal_single_runs(creature: Creature) -> None:
    """The worlds make 40 steps in a closed loop."""
    scripts = ("jump 0.2", "jump 0.7", "twist 60", "stand 0.1, hop 0.3")
    dt, single = solver_steps(creature.body)[0], creature.stepper
    ends = []
    for sequence in sequences(creature, scripts):
        state, memory, report = creature.start, single.initial_memory(), None
        for _ in range(40):
            state, memory, done = single.advance(state, memory, sequence.objectives(state, report, dt), dt)
            report: StepReport | None = done[-1]
        ends.append(state.positions)
    batch = stepper(creature, len(scripts))
    motions = MotionBatch(creature.body, sequences(creature, scripts), CPU)
    state = batch.start([creature.start] * len(scripts))
    for _ in range(40):
        state, steps, failed = batch.advance(state, motions.objectives(state, dt), dt)
        assert not failed.any()
        motions.finish_step(steps)
    np.testing.assert_allclose(state.positions.numpy(), np.stack(ends), rtol=0, atol=1e-9 * creature.body.height)
    assert np.abs(ends[0] - ends[1]).max() > 1e-3 * creature.body.height
