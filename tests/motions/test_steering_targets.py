"""Targets of steered walks: the points to walk to, the end of the walk, and the judgement of its success."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.motions.other_body import OtherBody
from egs_warp.motions.sequence import Stance
from egs_warp.motions.steering import View
from egs_warp.motions.steering_targets import AvoidBody, FollowBody, PushTo, WalkToBody
from egs_warp.pipelines.creature import initial_stance
from tests.support.creatures import coarse_pawn
from tests.support.props import box_body


@cache
def _cube() -> LocomotionStepper:
    return box_body((0.4, 0.4, 0.4)).stepper


class Box:
    """Cube with a side of 0.4 m at a position in the ground frame of a pawn that tests can change."""

    def __init__(self) -> None:
        self.stance: Stance = initial_stance(coarse_pawn())
        self.at = np.array([1.5, 0.0])
        stepper = _cube()
        self._nodes = stepper.body.mesh.nodes
        self.other = OtherBody(stepper.body, self._state, stepper.geometry)
        self.touching = self.other.place(self.stance)[1]

    def _state(self) -> BodyState:
        ground = self.stance.ground
        nodes = (self._nodes + [*self.at, 0.0]) @ ground.axes + ground.origin
        return BodyState(nodes, np.zeros_like(nodes))


def view(x: float, y: float, time: float = 0.0) -> View:
    return View(time, np.array([x, y]), 0.0)


def test_a_push_begins_behind_the_box_and_returns_to_its_line() -> None:
    box = Box()
    push = PushTo(box.stance, box.other, "box", np.array([1.5, 1.0]))
    behind = push.goal(view(0.0, 0.0))
    assert behind[0] == pytest.approx(1.5) and -0.9 < behind[1] < -0.5
    assert push.ignored() == ()
    straight = push.goal(view(*behind)) - behind
    assert push.ignored() is None and straight @ [0.0, 1.0] == pytest.approx(np.linalg.norm(straight))
    # A pawn to the right of the line of the push steers to the left.
    beside = behind + [0.1, 0.1]
    assert (push.goal(view(*beside)) - beside)[0] < 0.0
    # A pawn beside the box starts again behind the box.
    np.testing.assert_allclose(push.goal(view(1.5 + box.touching, 0.0)), behind)
    assert push.ignored() == ()


def test_a_push_is_judged_by_the_place_of_the_box() -> None:
    box = Box()
    push = PushTo(box.stance, box.other, "box", np.array([2.5, 0.0]))
    assert not push.is_over(view(0.0, 0.0))
    assert push.failures(view(0.0, 0.0)) == ("box is 1.00 body heights from its target",)
    box.at = np.array([2.49, 0.0])
    assert push.is_over(view(0.0, 0.0)) and not push.failures(view(0.0, 0.0))


def test_walks_aim_at_a_body_that_moves() -> None:
    box = Box()
    walk = WalkToBody(box.stance, box.other, "box", 0.1)
    follow = FollowBody(box.stance, box.other, "box", 0.1, 2.0)
    box.at = np.array([0.0, 3.0])
    for policy in (walk, follow):
        goal = policy.goal(view(0.0, 0.0))
        assert goal is not None
        np.testing.assert_allclose(goal, box.at, atol=1e-9)
    near = view(0.0, 3.0 - box.touching - 0.1)
    assert walk.is_over(near) and not walk.is_over(view(0.0, 0.0))
    assert follow.goal(near) is None and not follow.is_over(near) and follow.is_over(view(0.0, 0.0, 2.0))
    assert walk.failures(view(0.0, 1.0)) and not walk.failures(near)
    assert follow.failures(view(0.0, 0.0)) and not follow.failures(near)


def test_a_body_walks_away_only_from_a_near_one() -> None:
    box = Box()
    avoid = AvoidBody(box.stance, box.other, "box", 0.5, 2.0)
    assert avoid.goal(view(0.0, 0.0)) is None and not avoid.failures(view(0.0, 0.0))
    away = avoid.goal(view(1.5, box.touching + 0.2))
    assert away is not None and away[1] > 1.0
    avoid.goal(view(1.5, 0.5 * box.touching))
    assert avoid.failures(view(0.0, 0.0)) == ("box was touched",)
