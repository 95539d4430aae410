"""Motion of a coarse block that is thrown, lands, slides and rotates under muscle work, so that all terms of the energy
balance occur."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AngularMomentumObjective, centre_of_mass_velocity, node_velocities
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.locomotion.trajectory import Trajectory
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh
from tests.support.stances import DT, FORWARD


@dataclass(frozen=True)
class Slide:
    """Simulated motion of the block."""

    stepper: LocomotionStepper
    start: BodyState
    reports: tuple[StepReport, ...]
    kicks: tuple[np.ndarray | None, ...]
    """(N, 3) m/s, external velocity change of the nodes at the start of each step, or None."""

    def recorder(self, **options: Any) -> Recorder:
        """Return a recorder of this body that has no steps yet."""
        stepper = self.stepper
        gaps, _ = stepper.detector.gaps(self.start.positions)
        drag = stepper.settings.drag
        return Recorder(
            stepper.body, stepper.muscles, stepper.geometry, self.start, float(gaps.min()), drag=drag, **options
        )

    def trajectory(self) -> Trajectory:
        """Return the trajectory of all steps."""
        recorder = self.recorder()
        for report, kick in zip(self.reports, self.kicks, strict=True):
            recorder.add([report], kick=kick)
        return recorder.trajectory()


def with_self_contact(t: Trajectory) -> Trajectory:
    """Return ``t`` with contacts of the body with itself, a pair of records with opposite forces in each step."""
    steps, force = np.repeat(np.arange(len(t.dt), dtype=np.int32), 2), 3.0 * t.node_mass.sum() * 9.81
    signs = np.tile([1.0, -1.0], len(t.dt))[:, None]
    added = {
        "contact_step": steps,
        "contact_nodes": np.tile(t.tets[0], (len(steps), 1)),
        "contact_weights": np.full((len(steps), 4), 0.25),
        "contact_plane": np.full(len(steps), -3, np.int32),
        "contact_normal": signs * [0.0, 0.0, 1.0],
        "contact_force": signs * force * [0.2, 0.0, 1.0],
        "contact_gap": np.zeros(len(steps)),
    }
    arrays = {name: np.concatenate([getattr(t, name), values]) for name, values in added.items()}
    return replace(t, world_index=2, **arrays)


@cache
def slide(*, struck: bool = False) -> Slide:
    """Simulate 24 steps with drag. With ``struck``, a blow hits one side in the ninth step, and wind blows from then
    on."""
    creature = coarse_creature(block_mesh(), forward=FORWARD)
    body, muscles, geometry = creature.stepper.body, creature.stepper.muscles, creature.stepper.geometry
    stepper = LocomotionStepper(body, muscles, geometry, settings=LocomotionSettings(drag=0.3), device="cpu")
    positions = creature.start.positions + np.array([0.0, 0.0, 0.01])
    arms = positions - body.centre_of_mass(positions)
    start = BodyState(positions, np.array([0.8, 0.2, -0.5]) + np.cross([0.5, 0.3, 1.0], arms))
    state, memory, reports = start, stepper.initial_memory(), []
    one_side = (arms[:, 1] > 0.0)[:, None]
    blow = np.array([0.3, -0.2, 0.1]) * one_side / (body.node_mass @ one_side) * body.mass
    wind = np.tile([0.0, 0.02, 0.0], (len(positions), 1))
    kicks = [None if not struck or step < 8 else blow + wind if step == 8 else wind for step in range(24)]
    for step, kick in enumerate(kicks):
        target = np.array([0.0, 0.0, -0.12 * np.sin(6.0 * DT * (step + 1))])
        objectives = [
            centre_of_mass_velocity(body, target, 2.0),
            AngularMomentumObjective(np.zeros(3), 5.0),
            node_velocities(body, np.tile(target, (len(positions), 1)), 0.01),
        ]
        state, memory, done = stepper.advance(state.with_velocity_kick(kick), memory, objectives, DT)
        assert len(done) == 1, "the velocity change of a step must not be divided into substeps"
        reports += done
    return Slide(stepper, start, tuple(reports), tuple(kicks))
