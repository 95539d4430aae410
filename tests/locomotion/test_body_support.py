"""Support of a body by other bodies at rest: the rest on a box and on a post, and the contacts from below."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.body_support import StepperAmongBodies
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.world_stepper import WorldBody
from tests.support.meshes import UP
from tests.support.props import box_body

FRICTIONS = np.full((2, 2), 0.8)


def at_rest(body: WorldBody) -> BodyState:
    return BodyState(body.rest_positions, np.zeros_like(body.rest_positions))


@pytest.mark.parametrize("width", [0.5, 0.1])
def test_a_box_comes_to_rest_on_a_box_or_on_a_post_that_does_not_move(width: float) -> None:
    """The box is 0.3 wide and starts 4 mm above the top of the other body. A post of 0.1 touches the middle of its base
    with its own points; a wider box is touched by the points of the base."""
    upper, lower = box_body((0.3, 0.3, 0.3)), box_body((width, width, 0.4))
    lower_state = at_rest(lower)
    stepper = StepperAmongBodies(upper, [lower], [lower_state], FRICTIONS)
    state = settle(stepper, upper.rest_positions + 0.404 * UP)
    np.testing.assert_allclose(state.positions, upper.rest_positions + 0.4 * UP, atol=1e-3)
    np.testing.assert_array_equal(lower_state.positions, lower.rest_positions)
    support = stepper.support(state, 0.003)
    np.testing.assert_array_equal(support.faces, -2)
    np.testing.assert_allclose(support.normal, UP, atol=0.02)
    half = 0.5 * min(width, 0.3)
    np.testing.assert_allclose(support.points[:, 2], 0.4, atol=2e-3)
    np.testing.assert_allclose(np.abs(support.points[:, :2]).max(axis=0), half, atol=2e-3)


def test_a_neighbour_is_no_support() -> None:
    """Two boxes stand side by side on the ground, 1 mm apart."""
    body, other = box_body((0.3, 0.3, 0.3)), box_body((0.3, 0.3, 0.3))
    beside = BodyState(other.rest_positions + [0.301, 0.0, 0.0], np.zeros_like(other.rest_positions))
    support = StepperAmongBodies(body, [other], [beside], FRICTIONS).support(at_rest(body), 0.003)
    assert len(support.points) > 0 and (support.faces == 0).all()
