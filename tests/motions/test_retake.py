"""Retakes: a motion in which the body fell is repeated more gently, with the same requested values."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.motions.act import Act
from egs_warp.motions.flip import Flip, FlipPlan
from egs_warp.motions.jump import Jump
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.motions.script import Script, motion
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.skip import Skip, SkipTo
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk
from tests.support.stances import block_place


def retaken(script: Script, *numbers: int) -> tuple[Script, str]:
    """Return ``script`` as changed after falls in the motions ``numbers``, and the last change."""
    change = ""
    for number in numbers:
        retake = script.retake(number)
        assert retake is not None
        script, change = retake
    return script, change


def begun(script: Script, place: Stance) -> list[BodyMotion]:
    return [part.begin(place) for part in script.parts(place.body.height)]


def test_the_motion_that_fell_becomes_softer_and_then_lower(place: Stance) -> None:
    """Motion 2 is the second of two hops, which are changed together; motion 3 is changed twice."""
    script = motion("jump 0.5 0.2, hop 0.5 0.2 x2, jump 0.4 0.2")
    softer, change = retaken(script, 2)
    assert [request.retake for request in softer.requests] == [0, 1, 0] and change == "hop slower and softer"
    lower, change = retaken(softer, 3, 3)
    assert [request.retake for request in lower.requests] == [0, 1, 2]
    assert change == "jump slower, softer, lower and shorter" and lower.retake(3) is None
    asked = [part.asked for part in script.parts(1.0)]
    assert [part.asked for part in softer.parts(1.0)] == asked == [part.asked for part in lower.parts(1.0)]
    usual, soft, low = (begun(each, place)[3] for each in (script, softer, lower))
    assert isinstance(usual, Jump) and isinstance(soft, Jump) and isinstance(low, Jump)
    assert soft.target == usual.target and soft.plan == usual.plan
    height = place.body.height
    assert (low.target.distance, low.target.height) == pytest.approx((0.24 * height, 0.12 * height))
    jump = begun(retaken(motion("jump 0.4 0.2"), 0)[0], place)[0]
    assert isinstance(jump, Jump) and jump.target == usual.target
    assert jump.plan.thrust_time > usual.plan.thrust_time
    assert jump.plan.landing_rate == pytest.approx(usual.plan.landing_rate / 1.5)


@pytest.mark.parametrize("text", ["backflip 1.2", "front flip 1.2"])
def test_a_somersault_becomes_higher(text: str) -> None:
    """In a longer flight, the body needs less angular momentum to turn over. There is no third take."""
    place = block_place()
    script, change = retaken(motion(text), 0)
    (usual,), (high,) = (begun(each, place) for each in (motion(text), script))
    assert isinstance(usual, Flip) and isinstance(high, Flip)
    assert high.target.height == pytest.approx(1.3 * usual.target.height)
    usual_plan, high_plan = usual.plan_record(), high.plan_record()
    assert isinstance(usual_plan, FlipPlan) and isinstance(high_plan, FlipPlan)
    assert high_plan.angular_momentum < 0.95 * usual_plan.angular_momentum and high_plan.lever < usual_plan.lever
    assert change.endswith("flip higher") and script.retake(0) is None


@pytest.mark.parametrize("text", ["walk 0.5", "walk to 0.4,0.2", "turn 90", "run 0.5"])
def test_walks_take_shorter_steps_to_the_same_place(text: str, place: Stance) -> None:
    """In the third take, a walk is replaced by jumps, but a run is not: its steps then have a quarter of the length."""
    walks = [begun(retaken(motion(text), *[0] * count)[0], place)[0] for count in (0, 1, 2)]
    usual, *shorter = (walk for walk in walks if isinstance(walk, Walk))
    assert len(shorter) == (2 if text.startswith("run") else 1)
    for walk, count in zip(shorter, (2, 4), strict=False):
        steps = walk.gait.step_count / usual.gait.step_count
        assert steps == pytest.approx(count, rel=0.3)
        assert walk.planar_poses[-1] == pytest.approx(usual.planar_poses[-1], abs=1e-9)


def test_a_sneak_takes_shorter_steps(place: Stance) -> None:
    counts = []
    for number in (0, 1, 2):
        (sneak,) = begun(retaken(motion("sneak 0.5"), *[0] * number)[0], place)
        assert isinstance(sneak, Act) and isinstance(sneak.below, Walk)
        counts.append(sneak.below.gait.step_count)
    assert np.divide(counts, counts[0]) == pytest.approx([1.0, 2.0, 4.0], rel=0.3)


def test_the_third_take_of_a_walk_jumps_to_the_same_place(place: Stance) -> None:
    """The sum of the jumps is the distance, and the direction of the first one leads to the target."""
    script, change = retaken(motion("walk -0.5"), 0, 0)
    (skip,) = begun(script, place)
    assert isinstance(skip, Skip) and change == "walk in slow, soft jumps"
    plan, jump = skip.plan_record(), skip.jumps[0]
    assert plan.jumps * plan.length == pytest.approx(0.5 * place.body.height)
    assert jump.ground.axes[0] @ place.ground.axes[0] == pytest.approx(-1.0)


def test_the_third_take_of_a_walk_to_a_point_faces_it_and_jumps_to_it(place: Stance) -> None:
    script, change = retaken(motion("walk to 0.4,0.2"), 0, 0)
    (skip,) = begun(script, place)
    assert isinstance(skip, SkipTo) and change == "walk to in slow, soft jumps"
    assert skip.plan_record().jumps * skip.plan_record().length == pytest.approx(np.hypot(0.4, 0.2) * place.body.height)


def test_the_third_take_of_a_turn_is_a_jump(place: Stance) -> None:
    (turn,) = begun(retaken(motion("turn 90"), 0, 0)[0], place)
    assert isinstance(turn, Turn)


def test_other_motions_have_no_retake() -> None:
    """Standing, getting up, gestures, and motions under commands, beats or key frames have no gentler form."""
    assert [name for name, kind in MOTIONS.items() if not kind.retakes] == [
        "drive",
        "stand",
        "get up",
        "dance",
        "trajectory",
        "nod",
        "shake",
        "look around",
        "wave",
        "bow",
        "groove",
    ]
    assert motion("stand 1, jump").retake(0) is None
