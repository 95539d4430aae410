"""Motions towards other bodies: targets, parameters and error messages."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.motions.other_body import OtherBody
from egs_warp.motions.sequence import BodyMotion
from egs_warp.motions.towards import check_motion, script_among
from egs_warp.pipelines.creature import initial_stance
from tests.support.creatures import coarse_pawn
from tests.support.props import box_body


def test_targets_are_measured_when_the_motion_starts() -> None:
    creature = coarse_pawn()
    stance, height = initial_stance(creature), creature.body.height
    forward, left = stance.ground.axes[:2]
    place = {"now": 2.0 * forward}
    start = creature.start

    def state() -> BodyState:
        return BodyState(start.positions + place["now"], start.velocities)

    king = OtherBody(creature.body, state, creature.geometry)
    script = script_among("face king, jump to king height=0.3, kick king", {"king": king}, stance)
    assert [request.name for request in script.requests] == ["face king", "jump to king", "kick king"]
    place["now"] = 0.8 * left
    face, jump, kick = script.parts(height)
    face.begin(stance)
    assert face.asked["heading_degrees"] == pytest.approx(90.0)
    landing = _landing(jump.begin(stance))
    assert "distance" not in jump.asked
    # The jump is straight to the left and ends near the middle of the other body.
    assert landing @ left == pytest.approx(0.8, abs=0.2) and abs(landing @ forward) < 0.05
    # The kick lands beyond the other body and beside it.
    landing = _landing(kick.begin(stance))
    assert landing @ left > 0.9 and landing @ forward > 0.3


def _landing(motion: BodyMotion) -> np.ndarray:
    """Return the planned displacement (3,), m, at touch-down."""
    planned = [motion.planned_com(time) for time in np.linspace(0.0, motion.expected_time, 200)]
    return [moved for moved in planned if moved is not None and np.isfinite(moved).all()][-1]


def test_a_kick_out_of_reach_is_refused_with_the_distances() -> None:
    creature = coarse_pawn()
    king = OtherBody(creature.body, lambda: creature.moved((2.0, 0.0, 0.0)).start, creature.geometry)
    script = script_among("kick king", {"king": king}, initial_stance(creature))
    with pytest.raises(UserError, match=r"king is 2\.00 body heights away; walk or jump to a distance between"):
        script.check(initial_stance(creature))


def test_a_kick_that_is_shortened_before_the_other_body_is_refused() -> None:
    """The requested jump passes the other body, but the pawn could not stop after it."""
    creature = coarse_pawn()
    stance = initial_stance(creature)
    king = OtherBody(creature.body, lambda: creature.moved((1.9, 0.0, 0.0)).start, creature.geometry)
    script = script_among("kick king 2.5 0.1", {"king": king}, stance)
    with pytest.raises(UserError, match=r"king is 1\.90 body heights away; .* between [\d.]+ and 1\."):
        script.check(stance)


def test_a_walk_to_a_prop_is_refused_with_one_line() -> None:
    creature, box = coarse_pawn(), box_body((0.4, 0.4, 0.4)).stepper
    stance = initial_stance(creature)
    nodes = box.body.mesh.nodes + 1.5 * stance.ground.axes[0]
    king = OtherBody(box.body, lambda: BodyState(nodes, np.zeros_like(nodes)), box.geometry)
    with pytest.raises(UserError, match=r"king is at the target, 1.50 body heights ahead and 0.00 to the left"):
        script_among("walk to 1.5,0", {"king": king}, stance).check(stance)
    script_among("walk to 3,0", {"king": king}, stance).check(stance)
    # The target of a later motion is checked at the position at which that motion starts.
    expected = script_among("walk to king, kick king, walk to 1.5,0", {"king": king}, stance).check(stance)
    assert expected[0] > 0.0 and expected[1:] == [0.0, 0.0]
    # Slow discs are given 54 s to cross a circle of 3 m together (``test_steering``).
    (crossing,) = script_among("walk to 3,0", {f"king-{k}": king for k in range(7)}, stance).requests
    assert crossing.seconds is not None and crossing.seconds > 54.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hop, jump to kong", r"motion 2 \('jump to kong'\): no body 'kong' \(did you mean 'king'\?\)"),
        ("face king x2", "face cannot be repeated with x2; write the motion again"),
        ("walk to king gab=2", r"'gab=2' \(did you mean 'gap'\?\): walk to takes the numbers gap"),
        ("folow king", r"unknown motion 'folow' \(did you mean 'follow'\?\)"),
        ("kick", "name a body of the world after kick"),
        ("push king to 1", "give a position in the world in metres, as in push box to 1,0.5"),
        ("follow king 0", "seconds 0: give a number of seconds above 0"),
    ],
)
def test_mistakes_are_reported(text: str, message: str) -> None:
    creature = coarse_pawn()
    other = OtherBody(creature.body, lambda: creature.moved((2.0, 0.0, 0.0)).start, creature.geometry)
    with pytest.raises(UserError, match=message):
        script_among(text, {"king": other}, initial_stance(creature))


def test_coordinates_are_no_names() -> None:
    names = ["king"]
    check_motion("walk to 1,0.5, jump 0.5, walk to ahead=1 left=0, push king to 1,-0.5, kick king 1.2 0.4", names)
    with pytest.raises(UserError, match="unknown motion 'fly'"):
        check_motion("face king, fly", names)
