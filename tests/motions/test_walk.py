"""The walk of a coarse stool: its plan, and every step of it audited."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.locomotion.trajectory import measure
from egs_warp.motions.sequence import Place
from egs_warp.motions.walk import Walk, WalkPhase
from tests.support.creatures import coarse_creature
from tests.support.meshes import UP, coarse_stool, figure, stool
from tests.support.places import DT


def standing(
    mesh: TetMesh, *, forward: np.ndarray, up: np.ndarray = UP, settled: bool = True
) -> tuple[LocomotionStepper, Place, BodyState]:
    """A body of ``mesh``, as stiff and strong as captures are, on its lowest nodes; ``up`` (3,) is against gravity."""
    made = coarse_creature(mesh, forward=forward, up=up, sag=DEFAULT_SAG, settled=settled)
    return made.stepper, made.place, made.start


def test_a_walk_goes_along_its_feet_and_refuses_other_bodies() -> None:
    """The way forward is turned to the nearest side of the feet; a body on two feet is told that a walk needs four."""
    _, place, _ = standing(stool(), forward=np.array([0.9, 0.3, 0.0]), settled=False)
    walk = Walk(place, 3, 0.08)
    assert np.allclose(walk.ground.axes[0], [1.0, 0.0, 0.0], atol=1e-9)
    for pair in walk.pairs:
        centres = [place.standing[walk.feet[index].sole].mean(axis=0) for index in pair]
        assert np.allclose(centres[0][:2], -centres[1][:2], atol=1e-9)
    planned = walk.planned()
    assert planned.steps == 3.0 and planned.stride == pytest.approx(0.16) and walk.notes() == []
    strides_out = Walk(place, 3, 0.8)
    assert strides_out.gait.step_length == pytest.approx(0.5 * min(foot.length for foot in strides_out.feet))
    assert strides_out.notes()[0].startswith("steps of 1.00 body heights were asked; the legs are long enough for 0.3")
    _, place, _ = standing(figure(), forward=np.array([1.0, 0.0, 0.0]), settled=False)
    with pytest.raises(UserError, match="walk: a walk needs four separate feet, the body has 2"):
        Walk(place, 4, 0.1)


@pytest.mark.parametrize("slope", [0.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_a_coarse_stool_takes_a_step(slope: float) -> None:
    """One step, up a slope too, and the closing one: each foot lands once, none slips 2 % of the stride, the distance
    is met, the audit holds."""
    tilt = np.radians(slope)
    up = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    stepper, place, state = standing(coarse_stool(), forward=np.array([1.0, 0.0, 0.0]), up=up)
    body, start, walk = stepper.body, state, Walk(place, 1, 0.06)
    reports: list[StepReport] = []
    memory, air = stepper.initial_memory(), 0.0
    for _ in range(260):
        wishes = walk.objectives(state, reports[-1] if reports else None, DT)
        state, memory, fresh = stepper.advance(state, memory, wishes, DT)
        reports += fresh
        for index in walk.swinging:
            air = max(air, float(state.positions[walk.feet[index].sole, 2].min()))
        if walk.phase is WalkPhase.REST:
            break
    recorder = Recorder(body, stepper.muscles, stepper.geometry, start, 0.0, drag=0.0)
    recorder.add(reports)
    trajectory = recorder.trajectory()
    fell, reached, found = walk.reached(trajectory, 0, -1), measure(trajectory), audit(trajectory)
    assert walk.phase is WalkPhase.REST and walk.notes() == []
    assert fell.landings == 4 and fell.slip < 0.02 and fell.sole_shift < 0.05
    assert air > 0.3 * walk.gait.lift
    assert reached.distance * body.height == pytest.approx(0.06, rel=0.1)
    assert reached.tilt_degrees < 3.0 and abs(reached.heading_degrees) < 3.0 and reached.airborne_frames == 0.0
    assert found.momentum_residual < 1e-5 and found.angular_momentum_residual < 1e-4 and found.penetration < 0.01
    assert found.cone_violation < 1e-4 and found.complementarity_gap < 1e-4 and found.inverted_elements == 0
