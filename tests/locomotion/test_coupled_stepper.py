"""The stepper in the making: a coarse body is carried where it is asked to go, without chatter and with all audits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.locomotion.objectives import SpinObjective, centre_of_mass_velocity, node_velocities
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh
from tests.support.places import DT


def test_a_body_bobs_as_asked() -> None:
    """Half a period of 2 % of the height: speed of the centre of mass to 5 % of its peak, load without reversals."""
    creature = coarse_creature(block_mesh(), forward=np.array([1.0, 0.0, 0.0]))
    body, state = creature.stepper.body, creature.start
    stepper = LocomotionStepper(body, creature.stepper.muscles, creature.stepper.geometry, device="cpu")
    memory, loads, misses = stepper.initial_memory(), [], []
    peak, rate = 0.02 * body.height * 6.0, 6.0
    for step in range(30):
        wanted = np.array([0.0, 0.0, -peak * np.sin(rate * DT * (step + 1))])
        spread = np.tile(wanted, (len(state.positions), 1))
        objectives = [
            centre_of_mass_velocity(body, wanted, 1000.0),
            SpinObjective(np.zeros(3), 1000.0),
            node_velocities(body, spread, 0.1),
        ]
        state, memory, reports = stepper.advance(state, memory, objectives, DT)
        assert all(report.converged for report in reports) and len(reports) == 1
        loads.append(reports[0].forces[:, 0].sum() / body.weight)
        misses.append(abs(body.centre_of_mass(state.velocities)[2] - wanted[2]) / peak)
        assert np.abs(memory.activations / stepper.muscles.bounds).max() <= 1.0
        assert reports[0].added_spin < 0.01
    assert max(misses[5:]) < 0.05
    changes = np.diff(loads[5:])
    reversals = (changes[1:] * changes[:-1] < 0.0) & (np.minimum(abs(changes[1:]), abs(changes[:-1])) > 0.02)
    assert reversals.mean() <= 0.15


def test_what_does_not_converge_is_done_again_in_halves_under_the_same_activations() -> None:
    """What is asked is asked for the whole step: halves that asked again would push twice."""
    creature = coarse_creature(block_mesh(), forward=np.array([1.0, 0.0, 0.0]))
    body = creature.stepper.body
    stepper = LocomotionStepper(body, creature.stepper.muscles, creature.stepper.geometry, device="cpu")
    stepper.solver = replace(stepper.solver, tolerance=0.0)
    lift = [centre_of_mass_velocity(body, np.array([0.0, 0.0, 0.05]), 2.0)]
    planned = stepper.step(creature.start, stepper.initial_memory(), lift, DT)[2]
    end, memory, reports = stepper.advance(creature.start, stepper.initial_memory(), lift, DT)
    assert len(reports) == 16 and sum(report.dt for report in reports) == pytest.approx(DT)
    assert np.abs(planned.activations).max() > 0.0
    assert all((report.activations == planned.activations).all() for report in reports)
    assert end.time == pytest.approx(creature.start.time + DT) and (memory.activations == planned.activations).all()
    rise = [body.centre_of_mass(state.velocities)[2] for state in (end, planned.state)]
    assert rise[0] == pytest.approx(rise[1], rel=0.3)
