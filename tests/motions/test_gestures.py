"""Curves of gestures, and errors for bodies that cannot make them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.locomotion.objectives import BodyPart
from egs_warp.motions.acting import ACTING
from egs_warp.motions.follow import parts_of_body
from egs_warp.motions.gestures import WHOLE_BODY, Gesture, GestureOutcome, bow, groove, nod, wave
from egs_warp.motions.keyframes import Quantity
from egs_warp.motions.sequence import Stance
from tests.support.meshes import ball_mesh, block_mesh, carved, figure, figure_with_tool, rabbit
from tests.support.stances import standing_stance


@pytest.fixture(scope="module")
def person() -> Stance:
    """Return the stance of a figure with a head and two extended arms; forward is +y, left is -x."""
    return standing_stance(figure())


def defaults(name: str) -> dict[str, float]:
    return {value.name: value.default for value in ACTING[name].parameters}


def built(name: str, stance: Stance, **values: float) -> Gesture:
    gesture = ACTING[name].gesture
    assert gesture is not None
    return gesture(stance, defaults(name) | values)


GESTURES = [name for name, kind in ACTING.items() if kind.gesture is not None]


@pytest.mark.parametrize("name", GESTURES)
def test_each_gesture_starts_and_ends_at_zero_and_reaches_its_size(name: str, person: Stance) -> None:
    gesture = built(name, person)
    for channel in gesture.channels:
        assert np.allclose(channel.values[[0, -1]], 0.0), channel.part
        assert (np.diff(channel.times) > 0.0).all()
    size = defaults(name)["sway" if name == "groove" else "degrees"]
    along = np.abs(gesture.channels[0].values).max()
    assert along == pytest.approx(size) or size == 0.0
    assert gesture.duration == max(channel.times[-1] for channel in gesture.channels)
    assert gesture.body_follows == (name in ("nod", "wave"))
    assert gesture.moves_whole_body == (name in ("bow", "groove"))


def test_a_nod_has_as_many_dips_as_requested(person: Stance) -> None:
    """A positive rotation about the left axis moves the head forward and down."""
    channel = nod(person, {"degrees": 20.0, "count": 3.0}).channels[0]
    assert channel.part == "head" and channel.quantity is Quantity.ORIENTATION
    assert np.count_nonzero(channel.values[:, 1] == 20.0) == 3
    assert np.allclose(channel.values[:, [0, 2]], 0.0)


def test_the_angle_of_a_nod_is_not_almost_zero(person: Stance) -> None:
    with pytest.raises(UserError, match=r"^nod: degrees 0\.03: give 2 or more, or 0 for an angle that the film shows$"):
        nod(person, defaults("nod") | {"degrees": 0.03})
    assert nod(person, defaults("nod") | {"degrees": 2.0}).channels[0].values.max() == pytest.approx(2.0)


def test_the_angle_of_a_nod_follows_from_the_picture() -> None:
    """From the side, all of a nod is visible, so it is smaller than from ahead."""
    stance = standing_stance(rabbit())
    seen = [replace(stance, seen_from=axis) for axis in stance.ground.axes[:2]]
    ahead, side = (float(nod(place, defaults("nod")).channels[0].values.max()) for place in seen)
    assert 20.0 <= side < ahead <= 40.0


def test_a_body_follows_a_head_that_is_hardly_visible(person: Stance) -> None:
    """It leans and dips, and more so from ahead, where less of the nod is visible; but not on feet, nor on top of
    another motion."""
    assert len(nod(person, defaults("nod")).channels) == 1, "a body on feet does not follow"
    block, leans = standing_stance(block_mesh()), []
    for seen_from in block.ground.axes[:2]:
        gesture = nod(replace(block, seen_from=seen_from), defaults("nod"))
        head, lean, dip = gesture.channels
        assert lean.part == dip.part == WHOLE_BODY and dip.values.min() < 0.0 <= lean.values[2, 1]
        assert gesture.without([WHOLE_BODY]).channels == (head,)
        leans.append(lean.values.max())
    assert leans[1] < leans[0]


def test_a_wave_raises_the_tip_of_the_right_branch(person: Stance) -> None:
    """The right one of two arms at equal height waves. A small rotation along the curve moves its tip up."""
    gesture = wave(person, defaults("wave"))
    (part,), (channel,) = gesture.parts, gesture.channels
    local = person.ground.local(person.standing)
    arm = part.centre(local) - person.body.centre_of_mass(local)
    assert part.name.startswith("branch ") and arm[1] < 0.0
    axis = channel.values[1] / np.linalg.norm(channel.values[1])
    assert np.cross(axis, arm)[2] > 0.9 * np.linalg.norm(arm[:2])
    sizes = np.linalg.norm(channel.values, axis=1)
    assert np.count_nonzero(sizes > 0.99 * sizes.max()) == 3
    left = wave(person, {**defaults("wave"), "branch": 3.0 - float(part.name.split()[1])})
    assert left.parts[0].name != part.name


def test_a_wave_is_that_of_an_arm_that_holds_nothing() -> None:
    """The left arm waves, not the right one, which holds a tool, and not the tail, which ends higher."""
    stance = standing_stance(figure_with_tool())
    assert len([part for part in parts_of_body(stance) if part.name.startswith("branch ")]) == 3
    (part,) = wave(stance, defaults("wave")).parts
    local = stance.ground.local(stance.standing[part.nodes])
    assert local[:, 1].min() > 0.2 and np.ptp(local[:, 2]) < 0.3


def test_the_lighter_arm_waves_if_the_other_one_holds_something() -> None:
    """The right hand holds a block, which is no branch of its own."""

    def keep(c: np.ndarray) -> np.ndarray:
        x, z = np.abs(c[:, 0]), c[:, 2]
        legs, trunk = (z < 0.5) & (x > 0.1) & (x < 0.3), (z > 0.5) & (x < 0.3)
        return legs | trunk | ((z > 0.8) & (z < 1.0)) | ((c[:, 0] > 0.6) & (z > 0.7) & (z < 1.1))

    stance = standing_stance(carved((1.6, 0.2, 1.4), 0.1, keep))
    (part,) = wave(stance, defaults("wave")).parts
    assert stance.ground.local(stance.standing[part.nodes])[:, 1].min() > 0.2


def test_a_hand_that_stays_below_its_shoulder_is_reported() -> None:
    """The arms hang from shoulders that are 0.95 m high. Raised by 120 degrees, a hand is above its shoulder; raised by
    20 degrees, it hangs 0.2 to 0.7 m below it, and the body is 1.4 m high."""

    def keep(c: np.ndarray) -> np.ndarray:
        x, z = np.abs(c[:, 0]), c[:, 2]
        legs, trunk = (z < 0.5) & (x > 0.1) & (x < 0.3), (z > 0.5) & (x < 0.3)
        return legs | trunk | ((z > 0.9) & (z < 1.0) & (x < 0.7)) | ((x > 0.6) & (x < 0.7) & (z > 0.4) & (z < 1.0))

    stance = standing_stance(carved((1.6, 0.2, 1.4), 0.1, keep))
    assert wave(stance, defaults("wave") | {"degrees": 120.0}).notes == ()
    (note,) = wave(stance, defaults("wave") | {"degrees": 20.0}).notes
    below, rest = note.removeprefix("the waving part stays low: its tip reaches ").split(maxsplit=1)
    assert 0.2 / 1.4 < float(below) < 0.7 / 1.4 and rest == "body heights below the joint of the limb"


def test_ears_wave_only_if_they_are_selected() -> None:
    stance = standing_stance(rabbit())
    with pytest.raises(UserError) as error:
        wave(stance, defaults("wave"))
    missing = "wave: the body has no branch on its trunk, such as an arm or a tail"
    assert str(error.value) == f"{missing}; use nod, shake, look around, bow or groove, or give branch=1"
    assert wave(stance, defaults("wave") | {"branch": 1.0}).parts[0].name == "branch 1"


def test_a_part_that_is_too_short_for_a_branch_waves_if_there_is_no_branch() -> None:
    def keep(c: np.ndarray) -> np.ndarray:
        is_stump = (c[:, 0] < 0.3) & (np.abs(c[:, 1]) < 0.1) & (np.abs(c[:, 2] - 0.6) < 0.1)
        return (c[:, 0] < 0.1) | is_stump

    stance = standing_stance(carved((1.0, 0.6, 1.2), 0.1, keep))
    assert [part for part in parts_of_body(stance) if part.name.startswith("branch ")] == []
    gesture = wave(stance, defaults("wave"))
    assert [note.partition(";")[0] for note in gesture.notes] == ["the body has no free arm or other branch"]
    part, whole = gesture.parts
    assert whole.name == WHOLE_BODY, "the body rocks with a part whose travel is small"
    x, _, z = stance.body.mesh.nodes[part.nodes].T
    assert part.name == "protruding part" and x.mean() > 0.1 and z.min() > 0.4 and z.max() < 0.8


def test_a_groove_is_on_the_beats_and_to_both_sides(person: Stance) -> None:
    gesture = groove(person, {"tempo": 120.0, "beats": 4.0, "sway": 0.05})
    body, head = gesture.channels
    assert body.part == WHOLE_BODY and body.quantity is Quantity.POSITION
    assert np.allclose(body.times[::2], [0.0, 0.5, 1.0, 1.5, 2.0])
    assert np.allclose(body.values[::2, 1], [0.0, 0.05, -0.05, 0.05, 0.0])
    assert (body.values[1::2, 2] < 0.0).all(), "it dips between the beats"
    assert head.part == "head" and (head.times[1:] > body.times[1:]).all(), "the head follows"


def test_a_heavy_head_leans_the_body_less(person: Stance) -> None:
    """In a bow of 30 degrees, the head rotates relative to the body, and the whole body leans by 0.2 to 0.4 of the
    angle."""
    head, whole = bow(person, {"degrees": 30.0}).channels
    assert head.part == "head" and whole.part == WHOLE_BODY
    assert 0.2 * 30.0 <= whole.values[:, 1].max() <= 0.4 * 30.0


def test_a_part_above_the_neck_that_is_most_of_the_body_is_no_head(
    person: Stance, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = BodyPart.of(person.body, "head", np.flatnonzero(person.ground.local(person.standing)[:, 2] > 0.2))
    monkeypatch.setattr("egs_warp.motions.gestures.parts_of_body", lambda stance: [most])
    part = nod(person, defaults("nod")).parts[0]
    assert part.name == "head" and len(part.nodes) < len(most.nodes)
    assert part.masses.sum() < 0.5 * most.masses.sum()


def test_a_body_that_cannot_do_a_gesture_is_told_what_is_missing(person: Stance) -> None:
    block, ball = standing_stance(block_mesh()), standing_stance(ball_mesh())
    with pytest.raises(UserError) as error:
        wave(block, defaults("wave"))
    expected = "wave: the body has no branch that is free, such as an arm, a tail or an ear"
    instead = "use nod, shake, look around, bow or groove"
    assert str(error.value) == f"{expected}; parts that touch the trunk do not count; {instead}"
    with pytest.raises(UserError, match=r"such as an arm, a tail or an ear; walk or jump$"):
        wave(ball, defaults("wave"))
    with pytest.raises(UserError, match=r"^nod: the body has no branch 1; it has none, so use nod without branch$"):
        nod(block, {**defaults("nod"), "branch": 1.0})
    with pytest.raises(UserError, match=r"^wave: the body has no branch 7; it has branch 1, branch 2$"):
        wave(person, {**defaults("wave"), "branch": 7.0})
    with pytest.raises(UserError, match=r"^nod: the body stands on a round base and has no head above the rest; walk"):
        nod(ball, defaults("nod"))
    with pytest.raises(UserError, match=r"^groove: the body stands on a round base and has no feet to sway over"):
        groove(ball, defaults("groove"))


@pytest.mark.parametrize(
    ("requested", "reached", "unit", "missed"),
    [
        (20.0, 17.1, "degrees", False),
        (20.0, 15.9, "degrees", True),
        (5.0, 2.1, "degrees", False),
        (20.0, 24.1, "degrees", True),
        (0.04, 0.031, "body heights", False),
        (0.1, 0.079, "body heights", True),
    ],
)
def test_a_gesture_is_missed_by_a_fifth_or_a_small_amount(
    requested: float, reached: float, unit: str, missed: bool
) -> None:
    outcome = GestureOutcome("nod", requested, reached, "angle", unit)
    assert outcome.is_missed == missed
    assert outcome.text.startswith("nod angle ") and outcome.text.endswith(f" {unit}")
