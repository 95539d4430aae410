"""Pose after a landing, and accents of a dance."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.motions.gestures import WHOLE_BODY
from egs_warp.motions.keyframes import Quantity
from egs_warp.motions.poses import beat_accents, landed_pose
from egs_warp.motions.sequence import Stance
from tests.support.meshes import ball_mesh, figure
from tests.support.stances import standing_stance


@pytest.fixture(scope="module")
def person() -> Stance:
    """Return the stance of a figure with a head and two extended arms."""
    return standing_stance(figure())


def test_a_pose_is_held_as_a_whole(person: Stance) -> None:
    """Crouch, lean and head are at their targets together for the requested time, and return to zero."""
    seconds = 1.5
    gesture = landed_pose(person, 0.1, seconds)
    assert {part.name for part in gesture.parts} == {WHOLE_BODY, "head"}
    middle = max(float(channel.times[1]) for channel in gesture.channels if len(channel.times) == 4)
    for time in (middle, middle + seconds):
        for channel in gesture.channels:
            value = np.linalg.norm(channel.at(time)[0])
            assert value == pytest.approx(np.linalg.norm(channel.values, axis=1).max()), (channel.part, time)
    depth = gesture.channels[0]
    assert depth.quantity is Quantity.POSITION and depth.values[0, 2] < 0.0, "it starts in the crouch of the landing"
    assert all(np.allclose(channel.values[-1], 0.0) for channel in gesture.channels)


def test_a_dance_has_an_accent_on_each_beat(person: Stance) -> None:
    """The head tilts to alternate sides, and one arm is up while the other one is down. A beat right after another one
    is skipped."""
    gesture = beat_accents(person, (1.0, 1.5, 1.6, 2.0))
    assert gesture is not None
    head, *arms = gesture.channels
    assert np.allclose(head.times[1:-1], [1.0, 1.5, 2.0])
    assert (np.sign(head.values[1:-1, 0]) == [1.0, -1.0, 1.0]).all()
    is_up = [np.linalg.norm(arm.values[1:-1], axis=1) > 1.0 for arm in arms]
    assert (is_up[0] != is_up[1]).all() and (is_up[0][1:] != is_up[0][:-1]).all()
    assert beat_accents(standing_stance(ball_mesh()), (1.0, 1.5)) is None
