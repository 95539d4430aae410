"""Leaps on a block that is posed by hand: the frame of the landing."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.motions.jump import JumpPhase, JumpTarget
from egs_warp.motions.leap import Leap
from egs_warp.motions.sequence import Place
from tests.support.places import DT, moved


def test_a_landing_frame_holds_the_landed_body(place: Place) -> None:
    """From take-off on, a body that stands turned at the target has the coordinates of the start."""
    target = JumpTarget(0.5, 0.3, 0.1)
    leap = Leap(place, target, turn=0.8)
    start = place.ground.local(place.standing)
    leap.phase = JumpPhase.THRUST
    flying = place.standing + [0.2, 0.0, 0.3]
    leap.objectives(BodyState(flying, np.tile([1.0, 0.0, 2.5], (len(flying), 1)), 0.01), None, DT)
    assert leap.phase is JumpPhase.FLIGHT and leap.left_ground
    landed = moved(place, 0.8, np.array([0.5, 0.0, 0.1]))
    assert np.allclose(leap.ground.local(landed), start)
    assert leap.pose.measure(BodyState(landed, 0 * landed), None).heading == pytest.approx(0.0, abs=1e-9)
