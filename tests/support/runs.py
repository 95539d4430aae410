"""A script simulated on a coarse block."""

from __future__ import annotations

from dataclasses import dataclass

from egs_warp.fem.body import SoftBody
from egs_warp.geometry.height_field import HeightField
from egs_warp.locomotion.rollout import roll_out
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from tests.support.creatures import coarse_creature
from tests.support.meshes import box_mesh
from tests.support.stances import FORWARD


@dataclass(frozen=True)
class Run:
    """What a simulated script left."""

    body: SoftBody
    sequence: MotionSequence
    trajectory: Trajectory
    reports: tuple[StepReport, ...]


def coarse_block_run(script: str, field: HeightField | None = None) -> Run:
    """``script`` on a block of 45 nodes, 0.5 x 0.5 x 1 metres: a few hundred steps of the whole stepper; on ``field``
    in place of the floor.
    """
    made = coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD, field=field)
    asked = motion(script)
    sequence = MotionSequence(made.place, asked.parts(made.place.body.height))
    done = roll_out(
        made.stepper,
        made.stepper.geometry,
        made.start,
        sequence,
        frames=asked.frames(),
        finished=lambda: sequence.is_finished,
    )
    return Run(made.place.body, sequence, done.trajectory, done.reports)
