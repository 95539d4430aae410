"""Motions towards other bodies: a target is the position of the other body at the time at which the motion starts."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.motions.towards import OtherBody, check_motion, script_among
from egs_warp.pipelines.creature import initial_stance
from tests.support.creatures import coarse_pawn


def test_targets_are_measured_when_the_motion_starts() -> None:
    creature = coarse_pawn()
    stance, height = initial_stance(creature), creature.body.height
    forward, left = stance.ground.axes[:2]
    place = {"now": 2.0 * forward}
    start = creature.start

    def state() -> BodyState:
        return BodyState(start.positions + place["now"], start.velocities)

    script = script_among(
        "face king, walk to king, jump to king height=0.3", {"king": OtherBody(creature.body, state)}, stance
    )
    assert [request.name for request in script.requests] == ["face king", "walk to king", "jump to king"]
    place["now"] = 1.5 * left
    face, walk, jump = script.parts(height)
    for task in (face, walk):
        task.begin(stance)
    assert face.asked["heading_degrees"] == pytest.approx(90.0)
    size = float(np.ptp(stance.ground.local(stance.standing)[:, :2], axis=0).mean())
    assert walk.asked["distance"] * height == pytest.approx(1.5 - size - 0.1 * height, abs=1e-6)
    begun = jump.begin(stance)
    assert "distance" not in jump.asked
    planned = [begun.planned_com(time) for time in np.linspace(0.0, begun.expected_time, 200)]
    landing = [moved for moved in planned if moved is not None and np.isfinite(moved).all()][-1]
    # A straight jump to the left, which ends near the middle of the other body.
    assert landing @ left == pytest.approx(1.5, abs=0.2) and abs(landing @ forward) < 0.05


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hop, jump to kong", r"motion 2 \('jump to kong'\): no body 'kong' \(did you mean 'king'\?\)"),
        ("face king x2", "cannot be repeated"),
        ("walk to king sped=2", "sped"),
    ],
)
def test_mistakes_are_reported(text: str, message: str) -> None:
    creature = coarse_pawn()
    other = OtherBody(creature.body, lambda: creature.moved((2.0, 0.0, 0.0)).start)
    with pytest.raises(UserError, match=message):
        script_among(text, {"king": other}, initial_stance(creature))


def test_coordinates_are_no_names() -> None:
    check_motion("walk to 1,0.5, jump 0.5, walk to ahead=1 left=0")
    with pytest.raises(UserError, match="unknown motion 'fly'"):
        check_motion("face king, fly")
