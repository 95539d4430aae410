"""A jump that ends in a crouch that is held."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpTarget
from egs_warp.motions.land_and_pose import LandAndPose
from tests.support.stances import DT, block_place


def test_the_body_lands_in_the_crouch_that_the_pose_holds() -> None:
    place = block_place()
    posed, target = LandAndPose(place, JumpTarget(0.3, 0.2), 1.0), JumpTarget(0.3, 0.2)
    standing = Jump(place, target).landing_height
    assert posed.jump.landing_height == pytest.approx(0.8 * standing), "feet of 0.4 body heights"
    assert posed.plan_record() == Jump(place, target).plan and posed.expected_time > posed.jump.expected_time + 1.0
    state = BodyState(place.standing, 0 * place.standing, 2.0)
    posed.objectives(state, None, DT)
    assert posed.outcome_record(None, 0, 0) is None, "it has not landed"  # pyright: ignore[reportArgumentType]
    posed.jump.phase = JumpPhase.REST
    low = place.standing * [1.0, 1.0, 0.8]
    for time in (2.1, 3.1):
        posed.objectives(BodyState(low, 0 * low, time), None, DT)
    outcome = posed.outcome_record(None, 0, 0)  # pyright: ignore[reportArgumentType]
    assert outcome is not None and not posed.is_at_rest
    (pose,) = outcome.gestures
    assert pose.quantity == "depth" and pose.requested == pytest.approx(0.2 * standing / place.body.height)
    assert pose.reached == pytest.approx(pose.requested, rel=1e-3)
    assert np.isfinite(posed.planned_com(0.1)).all()
