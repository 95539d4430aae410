"""The one list of the motions that can be asked for by name: what each takes, how it is begun, how long it lasts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from egs_warp.motions.follow import Follow
from egs_warp.motions.hop import Squares
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.keyframes import Key, read_keyframes
from egs_warp.motions.request import LARGEST_TARGET, LARGEST_TURN, MotionRequest, Value
from egs_warp.motions.sequence import BodyMotion, Part, Place
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk

TRAJECTORY_TAIL = 200
"""Frames after the last key of a trajectory within which the body is at rest."""


@dataclass(frozen=True)
class MotionKind:
    """A motion that can be asked for by name."""

    takes: tuple[Value, ...]
    """In the order in which bare numbers are read."""
    parts: Callable[[MotionRequest, float], list[Part]]
    """What a request, all of its repeats, comes to for a body of a height in metres. Raises ``UserError`` for a bad
    file."""
    frames: Callable[[MotionRequest], int]
    """At 60 Hz, within which one repeat comes to rest; what takes longer is cut off."""
    file: str | None = None
    """The file that it needs, for messages."""

    def usage(self, name: str) -> str:
        """What the motion called ``name`` takes, for messages."""
        names = ", ".join(value.name for value in self.takes)
        return f"{name} takes {names}" if names else f"{name} takes a file"


def _target(asked: Mapping[str, float], height: float) -> JumpTarget:
    return JumpTarget(asked["distance"] * height, asked["height"] * height)


def _repeated(request: MotionRequest, asked: Mapping[str, float], begin: Callable[[Place], BodyMotion]) -> list[Part]:
    return [Part(request.name, asked, begin)] * request.repeat


def _jumps(request: MotionRequest, height: float) -> list[Part]:
    target = _target(request.asked, height)
    return _repeated(request, request.asked, lambda place: Jump(place, target))


def _hops(request: MotionRequest, height: float) -> list[Part]:
    target = _target(request.asked, height)
    return Squares(target.distance, target.height, request.repeat, request.asked).parts()


def _turns(request: MotionRequest, height: float) -> list[Part]:
    target, turn = _target(request.asked, height), float(np.radians(request.asked["heading_degrees"]))
    return _repeated(request, request.asked, lambda place: Turn(place, target, turn))


def _walks(request: MotionRequest, height: float) -> list[Part]:
    steps, length = request.asked["steps"], request.asked["step_length"]
    asked = {**request.asked, "distance": steps * length}
    return _repeated(request, asked, lambda place: Walk(place, int(steps), length * height))


def _follows(request: MotionRequest, height: float) -> list[Part]:
    keys = _keys(request)
    asked = {"keys": float(len(keys)), "duration": max(key.time for key in keys)}
    return _repeated(request, asked, lambda place: Follow(place, keys))


def _keys(request: MotionRequest) -> tuple[Key, ...]:
    assert request.file is not None
    return read_keyframes(request.file)


def _length(name: str, default: float, *, above: bool = False) -> Value:
    return Value(name, default, 0.0, LARGEST_TARGET, "body heights", above=above)


REPERTOIRE: Mapping[str, MotionKind] = {
    "jump": MotionKind((_length("distance", 0.5), _length("height", 0.2, above=True)), _jumps, lambda request: 120),
    "hop": MotionKind(
        (_length("distance", 0.7, above=True), _length("height", 0.3, above=True)), _hops, lambda request: 150
    ),
    "twist": MotionKind(
        (
            Value("heading_degrees", 180.0, -LARGEST_TURN, LARGEST_TURN, "degrees"),
            _length("distance", 0.0),
            _length("height", 0.3, above=True),
        ),
        _turns,
        lambda request: 480,
    ),
    "walk": MotionKind(
        (Value("steps", 4, 1, 50, "steps", whole=True), _length("step_length", 0.1, above=True)),
        _walks,
        lambda request: 170 + 36 * int(request.asked["steps"]),
    ),
    "trajectory": MotionKind(
        (),
        _follows,
        lambda request: int(np.ceil(60.0 * max(key.time for key in _keys(request)))) + TRAJECTORY_TAIL,
        file="a file of key frames, as trajectory keys.json",
    ),
}
