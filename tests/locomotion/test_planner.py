"""Cost of activations and of muscle work compared with explicit formulas, and the effect of the work cost (Eq. 13)."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion import planner
from egs_warp.locomotion.contact_modes import CoulombProgram
from egs_warp.locomotion.objectives import AngularMomentumObjective, AnyObjective, centre_of_mass_velocity
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh
from tests.support.stances import DT


def objectives_at(stepper: LocomotionStepper, step: int) -> list[AnyObjective]:
    """Return the objectives of a step: zero angular momentum, and a centre of mass that moves down for five steps and
    then up at increasing speed."""
    up = -0.3 if step < 5 else min(0.3 * (step - 4), 0.9)
    return [
        centre_of_mass_velocity(stepper.body, np.array([0.0, 0.0, up]), 600.0),
        AngularMomentumObjective(np.zeros(3), 600.0),
    ]


def thrust(steps: int) -> tuple[LocomotionStepper, list[BodyState], list[StepReport]]:
    """Make ``steps`` steps of a block with ``objectives_at``; return the stepper, all states and all reports."""
    creature = coarse_creature(block_mesh(), forward=np.array([1.0, 0.0, 0.0]))
    stepper, states, memory = creature.stepper, [creature.start], creature.stepper.initial_memory()
    reports: list[StepReport] = []
    for step in range(steps):
        end, memory, fresh = stepper.advance(states[-1], memory, objectives_at(stepper, step), DT)
        states.append(end)
        reports += fresh
    assert len(reports) == steps
    return stepper, states, reports


def works(stepper: LocomotionStepper, start: np.ndarray, end: np.ndarray, tensions: np.ndarray) -> np.ndarray:
    """Return the work (M,), m g H, of segments with ``tensions`` (M,) newtons from node positions ``start`` to ``end``
    (N, 3)."""
    ends = [stepper.muscles.difference_rows @ positions for positions in (start, end)]
    before, after = (np.linalg.norm(each, axis=1) for each in ends)
    return tensions * (before - after) / (stepper.body.weight * stepper.body.height)


def test_activations_cost_the_squares_of_their_muscles_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """For each group, the work cost adds the squares of the work of the group's segments to the diagonal of P. It does
    not change the gradient, the constant, or the entries of contact forces."""
    stepper, states, reports = thrust(7)
    muscles, start = stepper.muscles, states[-1]
    memory = WarmStart.from_report(reports[-1])
    problem = StepProblem(stepper.body, start, DT, stepper.settings.drag)
    prospect = stepper.predict(stepper.step_inputs(problem, reports[-1].contacts, memory))

    def pieces() -> CoulombProgram:
        return stepper.planner.program(prospect, memory.activations, objectives_at(stepper, 7)).program

    with_work = pieces()
    P, q, constant = with_work.P.copy(), with_work.q.copy(), with_work.constant
    monkeypatch.setattr(planner, "WORK_WEIGHT", 0.0)
    without = pieces()
    np.testing.assert_allclose(q, without.q, rtol=1e-12)
    assert constant == pytest.approx(without.constant, rel=1e-12)
    ends = problem.end_positions(prospect.velocities)
    given = works(stepper, start.positions, ends, muscles.stiffness * muscles.bounds)
    assert given.max() > 1e-3 and given.min() < -1e-4
    added = np.zeros(len(P))
    for group, segments in enumerate(stepper.planner.synergies.members.T.toarray()):
        added[group] = 2.0 * 10.0 * np.sum(given[segments > 0.0] ** 2)
    np.testing.assert_allclose(P - without.P, np.diag(added), rtol=1e-9, atol=1e-9 * np.abs(P).max())


def test_a_work_cost_reduces_the_work_of_a_thrust(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the work cost, the sum of the positive work of all segments is at least 5 % lower, and the final speed is
    the same to 2 %."""

    def worked(steps: int = 8) -> tuple[float, float]:
        stepper, states, reports = thrust(steps)
        given = [
            works(stepper, before.positions, report.state.positions, stepper.muscles.stiffness * report.activations)
            for before, report in zip(states, reports, strict=False)
        ]
        up = stepper.body.centre_of_mass(states[-1].velocities)[2]
        return float(np.sum(np.maximum(given, 0.0))), float(up)

    work, speed = worked()
    monkeypatch.setattr(planner, "WORK_WEIGHT", 0.0)
    more, same = worked()
    assert work < 0.95 * more
    assert speed == pytest.approx(same, rel=0.02)
