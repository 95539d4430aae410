"""Messages of the page: valid ones are read, invalid ones are refused."""

from __future__ import annotations

from typing import Any

import pytest

from egs_warp.motions.command import Drive
from egs_warp.motions.style import Style
from egs_warp.web.messages import (
    Cancel,
    Change,
    GoTo,
    Message,
    Pause,
    PlayScript,
    Pull,
    PushOnce,
    Record,
    Release,
    RequestScript,
    Restyle,
    StandUp,
    Steer,
    Step,
    read_message,
)


def _read(**message: Any) -> Message:
    return read_message(message, height=2.0, node_count=10)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ({"type": "go", "x": 1, "y": -0.5}, GoTo((1.0, -0.5))),
        ({"type": "pull", "node": 9, "x": 0, "y": 1, "z": 2.5}, Pull(9, (0.0, 1.0, 2.5))),
        ({"type": "release"}, Release()),
        ({"type": "push", "x": 0.2, "y": 0, "z": -0.1}, PushOnce((0.2, 0.0, -0.1))),
        ({"type": "push", "x": 0, "y": 1, "z": 0, "height": 0.9}, PushOnce((0.0, 1.0, 0.0), 0.9)),
        ({"type": "set", "friction": 0.3}, Change(friction=0.3)),
        ({"type": "set", "sag": 0.02, "friction": 0}, Change(friction=0.0, sag=0.02)),
        ({"type": "style", "squash": 1.5}, Restyle(Style(squash=1.5))),
        ({"type": "style"}, Restyle(Style())),
        ({"type": "pause", "on": True}, Pause(True)),
        ({"type": "step"}, Step()),
        ({"type": "drive", "forward": 0.1, "turn": -0.2}, Steer(Drive(0.1, 0.0, -0.2))),
        ({"type": "drive"}, Steer(Drive())),
        ({"type": "cancel"}, Cancel()),
        ({"type": "stand"}, StandUp()),
        ({"type": "record", "on": False}, Record(False)),
        ({"type": "script"}, RequestScript()),
    ],
)
def test_each_message_is_read(message: dict[str, Any], expected: Message):
    assert _read(**message) == expected


def test_motions_are_those_of_scripts():
    asked = _read(type="motion", text="hop x2, jump 0.5 height=0.3")
    assert isinstance(asked, PlayScript)
    assert [(request.name, request.repeat) for request in asked.script.requests] == [("hop", 2), ("jump", 1)]
    assert asked.script.requests[1].asked["height"] == 0.3


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({}, "type 'None' is unknown; known types are motion, go"),
        ({"type": ["go"]}, r"type \"\['go'\]\""),
        ({"type": "fly"}, "type 'fly'"),
        ({"type": "step", "count": 3}, "step has no field 'count'"),
        ({"type": "drive", "forward": 3}, "forward: give a number from -2 to 2"),
        ({"type": "motion"}, "text: give motions in at most 200"),
        ({"type": "motion", "text": "hop, " * 100}, "text: give motions in at most 200"),
        ({"type": "motion", "text": "fly"}, "unknown motion 'fly'"),
        ({"type": "motion", "text": "jump 11"}, "distance 11: give a number"),
        ({"type": "motion", "text": "jump nan"}, "distance nan: give a number"),
        ({"type": "motion", "text": "hop x101"}, "repeat 101"),
        ({"type": "motion", "text": "script.json"}, "text: give motions by name"),
        ({"type": "motion", "text": "../../etc/passwd"}, "text: give motions by name"),
        ({"type": "motion", "text": "trajectory keys.csv"}, "text: give motions by name"),
        ({"type": "motion", "text": "trajectory keys"}, "text: motions that need a file"),
        ({"type": "go", "x": 1}, "y: give a number"),
        ({"type": "go", "x": 1, "y": "2"}, "y: give a number"),
        ({"type": "go", "x": True, "y": 0}, "x: give a number"),
        ({"type": "go", "x": 201, "y": 0}, "x: give a number from -200 to 200"),
        ({"type": "go", "x": float("nan"), "y": 0}, "x: give a number from"),
        ({"type": "go", "x": float("inf"), "y": 0}, "x: give a number from"),
        ({"type": "go", "x": 10**400, "y": 0}, "x: give a number from"),
        ({"type": "pull", "node": 10, "x": 0, "y": 0, "z": 0}, "node: give a whole number from 0 to 9"),
        ({"type": "pull", "node": -1, "x": 0, "y": 0, "z": 0}, "node: give a whole number"),
        ({"type": "pull", "node": 1.0, "x": 0, "y": 0, "z": 0}, "node: give a whole number"),
        ({"type": "pull", "node": 1, "x": 0, "y": 0}, "z: give a number"),
        ({"type": "push", "x": 1, "y": 0}, "z: give a number"),
        ({"type": "push", "x": 11, "y": 0, "z": 0}, "x: give a number from -10 to 10"),
        ({"type": "push", "x": 8, "y": 8, "z": 0}, r"push: give at most 10 m sqrt\(g H\)"),
        ({"type": "push", "x": 1, "y": 0, "z": 0, "height": 2}, "height: give a number from 0 to 1"),
        ({"type": "push", "x": 1, "y": 0, "z": 0, "height": None}, "height: give a number"),
        ({"type": "push", "x": 1, "y": 0, "z": 0, "node": 3}, "push has no field 'node'"),
        ({"type": "set"}, "set: give friction or sag"),
        ({"type": "set", "friction": -0.1}, "friction: give a number from 0 to 2"),
        ({"type": "set", "sag": 0.5}, "sag: give a number from 0.01 to 0.1"),
        ({"type": "style", "squash": 2.5}, "squash: give a number from 0.5 to 2"),
        ({"type": "style", "timing": "quick"}, "timing: give a number"),
        ({"type": "style", "wobble": 1}, "style has no field 'wobble'"),
        ({"type": "pause", "on": 1}, "on: give true or false"),
        ({"type": "record"}, "on: give true or false"),
    ],
)
def test_invalid_input_is_a_one_line_error(message: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said) as refused:
        _read(**message)
    assert "\n" not in str(refused.value)
