"""Displacements that the targets of a script request."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.motions.planned_legs import planned_legs
from egs_warp.motions.script import motion


def test_displacements_add_up_along_the_heading() -> None:
    """A turn to the left makes the next jump go to the left of the first one; a turn itself is no displacement."""
    legs = planned_legs(motion("jump distance=0.5, turn heading_degrees=90, hop x2 distance=0.4"))
    assert [leg.name for leg in legs] == ["jump", "hop", "hop"]
    np.testing.assert_allclose([leg.start for leg in legs], [[0.0, 0.0], [0.5, 0.0], [0.5, 0.4]], atol=1e-12)
    np.testing.assert_allclose([leg.step for leg in legs], [[0.5, 0.0], [0.0, 0.4], [0.0, 0.4]], atol=1e-12)


def test_a_spin_turns_the_next_displacement() -> None:
    (leg,) = planned_legs(motion("spin turns=-0.25, jump distance=0.5"))
    np.testing.assert_allclose(leg.step, [0.0, -0.5], atol=1e-12)


@pytest.mark.parametrize("middle", ["backflip", "front flip", "dance", "get up", "drive a.csv", "trajectory a.json"])
def test_displacements_after_an_unknown_one_are_left_out(middle: str) -> None:
    legs = planned_legs(motion(f"jump distance=0.5, nod, stand 1, hop distance=0.4, {middle}, walk 1"))
    assert [leg.name for leg in legs] == ["jump", "hop"]


def test_a_goal_beside_the_body_is_a_displacement_to_the_left() -> None:
    (leg,) = planned_legs(motion("walk to ahead=0.3 left=0.4"))
    np.testing.assert_allclose(leg.step, [0.3, 0.4])
