"""Simulation of a motion script with a coarse block."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.height_field import HeightField
from egs_warp.locomotion.rollout import Motion, RolloutResult, rollout_steps, run_with
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from tests.support.creatures import coarse_creature
from tests.support.meshes import box_mesh
from tests.support.stances import FORWARD


@dataclass(frozen=True)
class Run:
    """Result of a simulated script."""

    body: SoftBody
    sequence: MotionSequence
    trajectory: Trajectory
    reports: tuple[StepReport, ...]


def roll_out(stepper: LocomotionStepper, start: BodyState, motion: Motion, **options: Any) -> RolloutResult:
    """Run ``motion`` from ``start`` with ``stepper``; options as for ``rollout_steps``."""
    return run_with(stepper, rollout_steps(stepper, start, motion, **options))


def coarse_block_run(script: str, field: HeightField | None = None) -> Run:
    """Simulate ``script`` with a block of 45 nodes, 0.5 x 0.5 x 1 m, for a few hundred steps of the full stepper.

    If ``field`` is given, it is the ground in place of the floor.
    """
    creature = coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD, field=field)
    requested = motion(script)
    sequence = MotionSequence(creature.place, requested.parts(creature.place.body.height))
    done = roll_out(
        creature.stepper,
        creature.start,
        sequence,
        frames=requested.frames(),
        finished=lambda: sequence.is_finished,
    )
    return Run(creature.place.body, sequence, done.trajectory, done.reports)
