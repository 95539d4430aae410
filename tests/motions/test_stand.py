"""Standing, with the posture that gestures of the whole body request."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AngularMomentumObjective, Objective
from egs_warp.motions.script import motion, own_script
from egs_warp.motions.sequence import BodyMotion, Stance, TargetError
from egs_warp.motions.stand import PostureTarget, Stand
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.report import motion_reports
from egs_warp.pipelines.simulated_run import simulate
from tests.support.creatures import coarse_pawn
from tests.support.stances import DT, block_place


@pytest.fixture(scope="module")
def place() -> Stance:
    return block_place()


def objectives(place: Stance, posture: PostureTarget | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the target velocity (3,) of the centre of mass and the target angular momentum (3,) of a body at rest."""
    stand = Stand(place)
    stand.set_posture(posture)
    rules = stand.objectives(BodyState(place.standing, 0 * place.standing), None, DT)
    (spin,) = [rule.target for rule in rules if isinstance(rule, AngularMomentumObjective)]
    (moving,) = [rule.target for rule in rules if isinstance(rule, Objective) and len(rule.target) == 3]
    return moving, spin


def test_the_upright_posture_is_that_of_no_gesture(place: Stance) -> None:
    upright = objectives(place, PostureTarget(*np.zeros((4, 3))))
    assert all(np.array_equal(a, b) for a, b in zip(upright, objectives(place, None), strict=True))


def test_the_centre_of_mass_moves_with_its_target(place: Stance) -> None:
    """For a body at rest at its target, the velocity after a step is the step size times the target acceleration plus 2
    sqrt(g / h) times the target velocity."""
    nothing = np.zeros(3)
    aside = objectives(place, PostureTarget(np.array([0.0, 0.02, -0.01]), nothing, nothing, nothing))[0]
    assert aside[1] > 0.0 > aside[2] and abs(aside[0]) < 1e-9
    accelerating = objectives(place, PostureTarget(nothing, nothing, np.array([0.0, 0.5, 0.3]), nothing))[0]
    assert np.allclose(accelerating, [0.0, 0.5 * DT, 0.3 * DT], atol=1e-9)
    gravity = float(np.linalg.norm(place.body.gravity))
    height = float(place.body.centre_of_mass(place.ground.local(place.standing))[2])
    moving = objectives(place, PostureTarget(nothing, np.array([0.0, 0.05, 0.0]), nothing, nothing))[0]
    assert moving[1] == pytest.approx(2.0 * np.sqrt(gravity / height) * 0.05 * DT, rel=1e-6)


def test_the_body_turns_to_its_posture(place: Stance) -> None:
    """The target rate of rotation is 4 sqrt(g / H) times the angle, for an angle that the feet can correct."""
    nothing = np.zeros(3)
    _, spin = objectives(place, PostureTarget(nothing, nothing, nothing, np.array([0.0, 0.01, 0.0])))
    rate = place.ground.axes @ np.linalg.solve(place.body.inertia(place.standing), spin)
    unit = np.sqrt(np.linalg.norm(place.body.gravity) / place.body.height)
    assert np.allclose(rate, [0.0, 0.04 * unit, 0.0], atol=1e-6)


def test_a_target_out_of_reach_during_a_run_is_a_missed_target() -> None:
    """The body stands instead of making the motion, continues with the next motion, and the target is reported as
    missed."""

    def far(stance: Stance) -> BodyMotion:
        raise TargetError("kick: king is 3.00 body heights away")

    script = motion("stand 0.05") + own_script("far", far, seconds=1.0) + motion("stand 0.05")
    run = simulate(coarse_pawn(), script)
    reports = motion_reports(run.trajectory, run.records, run.ending)
    assert [each.state for each in reports] == [State.DONE, State.NOT_AS_REQUESTED, State.DONE]
    assert reports[1].notes == ("not as requested: kick: king is 3.00 body heights away",)
