"""The one list of the motions that can be asked for by name: what each takes, how it is begun, how long it lasts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from egs_warp.motions.beats import LATEST, MOST_BEATS, even_beats, read_beats
from egs_warp.motions.command import DrivePlan, read_drive
from egs_warp.motions.dance import Dance
from egs_warp.motions.drive import ScriptedDrive
from egs_warp.motions.follow import Follow
from egs_warp.motions.gait_selection import move_along, turn_in_place
from egs_warp.motions.get_up import GetUp
from egs_warp.motions.hop import HopTargets
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.keyframes import Key, read_keyframes
from egs_warp.motions.request import LARGEST_TARGET, LARGEST_TURN, MotionRequest
from egs_warp.motions.route import Route, path_route, read_path, straight_route
from egs_warp.motions.sequence import BodyMotion, MotionTask, Stance
from egs_warp.motions.stand import StandFor
from egs_warp.motions.style import Style
from egs_warp.motions.turn import Turn
from egs_warp.motions.values import Value

_PACE = 0.1
"""Body heights."""
_CALMING = 120
"""Frames after it has stood for its time within which a body that was pushed is at rest."""
_CLOSING = 300
"""Frames after it is told to stand within which a body that was driven has closed its feet and stands."""
TRAJECTORY_TAIL = 200
"""Frames after the last key of a trajectory within which the body is at rest."""


@dataclass(frozen=True)
class MotionKind:
    """A motion that can be asked for by name."""

    parameters: tuple[Value, ...]
    """In the order in which bare numbers are read."""
    build_tasks: Callable[[MotionRequest, float], list[MotionTask]]
    """What a request, all of its repeats, comes to for a body of a height in metres. Raises ``UserError`` for a bad
    file."""
    frames: Callable[[MotionRequest], int]
    """At 60 Hz, within which one repeat comes to rest; what takes longer is cut off."""
    file: str | None = None
    """The file that it needs, for messages."""
    jumps: bool = False
    """Whether it is made of jumps, which have a style."""
    beats: bool = False
    """Whether it may be given a file of beats, in place of its numbers."""

    def usage(self, name: str) -> str:
        """What the motion called ``name`` takes, for messages."""
        names = ", ".join(value.name for value in self.parameters)
        takes = f"{name} takes {names or ('a file' if self.file else 'no numbers')}"
        return f"{takes} or a file of beats" if self.beats else takes


def _target(asked: Mapping[str, float], height: float) -> JumpTarget:
    return JumpTarget(asked["distance"] * height, asked["height"] * height)


def _repeated(
    request: MotionRequest, asked: Mapping[str, float], begin: Callable[[Stance], BodyMotion]
) -> list[MotionTask]:
    return [MotionTask(request.name, asked, begin)] * request.repeat


def _jumps(request: MotionRequest, height: float) -> list[MotionTask]:
    target = _target(request.asked, height)
    return _repeated(request, request.asked, lambda place: Jump(place, place.landing(target)))


def _hops(request: MotionRequest, height: float) -> list[MotionTask]:
    target = _target(request.asked, height)
    return HopTargets(target.distance, target.height, request.repeat, request.asked).parts()


def _turns(request: MotionRequest, height: float) -> list[MotionTask]:
    target, turn = _target(request.asked, height), float(np.radians(request.asked["heading_degrees"]))
    return _repeated(request, request.asked, lambda place: Turn(place, target, turn))


def _walking(request: MotionRequest, asked: Mapping[str, float], route: Route, height: float) -> list[MotionTask]:
    length = asked.get("step_length", _PACE) * height
    return _repeated(request, asked, lambda place: move_along(place, route, length, speed=asked["speed"]))


def _walks(request: MotionRequest, height: float) -> list[MotionTask]:
    return _walking(request, request.asked, straight_route(request.asked["distance"] * height), height)


def _walks_to(request: MotionRequest, height: float) -> list[MotionTask]:
    goal = np.array([[request.asked["ahead"], request.asked["left"]]])
    asked = {**request.asked, "distance": float(np.linalg.norm(goal))}
    return _walking(request, asked, path_route(goal * height), height)


def _walks_along(request: MotionRequest, height: float) -> list[MotionTask]:
    points = _path(request)
    asked = {**request.asked, "distance": float(np.linalg.norm(points[-1]))}
    return _walking(request, asked, path_route(points * height), height)


def _turns_on_the_spot(request: MotionRequest, height: float) -> list[MotionTask]:
    angle = float(np.radians(request.asked["heading_degrees"]))
    asked, length = {**request.asked, "distance": 0.0}, _PACE * height
    return _repeated(request, asked, lambda place: turn_in_place(place, angle, length, speed=asked["speed"]))


def _stands(request: MotionRequest, height: float) -> list[MotionTask]:
    seconds = request.asked["seconds"]
    return _repeated(request, request.asked, lambda place: StandFor(place, seconds))


def _gets_up(request: MotionRequest, height: float) -> list[MotionTask]:
    return _repeated(request, request.asked, GetUp)


def _runs(request: MotionRequest, height: float) -> list[MotionTask]:
    route, length = straight_route(request.asked["distance"] * height), LARGEST_TARGET * height
    return _repeated(request, request.asked, lambda place: move_along(place, route, length, speed=_SPEED.most))


def _dances(request: MotionRequest, height: float) -> list[MotionTask]:
    beats = _beats(request)
    asked = request.asked if request.file is None else {"beats": float(len(beats)), "duration": beats[-1]}
    return _repeated(request, asked, lambda place: Dance(place, beats))


def _beats(request: MotionRequest) -> tuple[float, ...]:
    """Seconds from the start of the dance."""
    if request.file is not None:
        return read_beats(request.file)
    return even_beats(request.asked["tempo"], request.asked["first"], int(request.asked["beats"]))


def _path(request: MotionRequest) -> np.ndarray:
    assert request.file is not None
    return read_path(request.file)


def _way(points: np.ndarray) -> float:
    """Body heights from the start past ``points`` (n, 2), with what turns on the spot take."""
    steps = np.diff(np.concatenate([np.zeros((1, 2)), points]), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum()) + _ROUND


def _frames_of_walk(way: float, request: MotionRequest) -> int:
    """Frames at 60 Hz within which a ``way`` of so many body heights is walked."""
    return 170 + int(np.ceil(36 * way / _SHORTEST / request.asked["speed"]))


def _drives(request: MotionRequest, height: float) -> list[MotionTask]:
    plan = _commands(request)
    asked = {"commands": float(len(plan.commands)), "duration": plan.seconds}
    return _repeated(request, asked, lambda place: ScriptedDrive(place, plan))


def _commands(request: MotionRequest) -> DrivePlan:
    if request.drive is not None:
        return request.drive
    assert request.file is not None
    return read_drive(request.file)


def _follows(request: MotionRequest, height: float) -> list[MotionTask]:
    keys = _keys(request)
    asked = {"keys": float(len(keys)), "duration": max(key.time for key in keys)}
    return _repeated(request, asked, lambda place: Follow(place, keys))


def _keys(request: MotionRequest) -> tuple[Key, ...]:
    assert request.file is not None
    return read_keyframes(request.file)


_SPEED = Value("speed", 1.0, 0.3, 1.6, "times the usual")
_STEP_LENGTH = Value("step_length", _PACE, 0.0, LARGEST_TARGET, "body heights", is_exclusive=True)
_ROUND = 2.5
"""Body heights of way that take as long as a turn on the spot all the way round."""
_LONG_TURN = 10.0
"""The same where nothing but a turn is asked: what crawls takes four times as long."""
_SHORTEST = 0.02
"""Body heights: the pace of a narrow base; so many fill the frames of a walk."""


def _length(name: str, default: float, *, above: bool = False) -> Value:
    return Value(name, default, 0.0, LARGEST_TARGET, "body heights", is_exclusive=above)


MOTIONS: Mapping[str, MotionKind] = {
    "jump": MotionKind(
        (_length("distance", 0.5), _length("height", 0.2, above=True)), _jumps, lambda request: 120, jumps=True
    ),
    "hop": MotionKind(
        (_length("distance", 0.7, above=True), _length("height", 0.3, above=True)),
        _hops,
        lambda request: 150,
        jumps=True,
    ),
    "twist": MotionKind(
        (
            Value("heading_degrees", 180.0, -LARGEST_TURN, LARGEST_TURN, "degrees"),
            _length("distance", 0.0),
            _length("height", 0.2, above=True),
        ),
        _turns,
        lambda request: 480,
        jumps=True,
    ),
    "walk": MotionKind(
        (
            Value("distance", 0.4, -LARGEST_TARGET, LARGEST_TARGET, "body heights"),
            _STEP_LENGTH,
            _SPEED,
        ),
        _walks,
        lambda request: _frames_of_walk(abs(request.asked["distance"]), request),
    ),
    "walk to": MotionKind(
        (
            Value("ahead", 0.4, -LARGEST_TARGET, LARGEST_TARGET, "body heights"),
            Value("left", 0.0, -LARGEST_TARGET, LARGEST_TARGET, "body heights"),
            _STEP_LENGTH,
            _SPEED,
        ),
        _walks_to,
        lambda request: _frames_of_walk(_way(np.array([[request.asked["ahead"], request.asked["left"]]])), request),
    ),
    "walk along": MotionKind(
        (_STEP_LENGTH, _SPEED),
        _walks_along,
        lambda request: _frames_of_walk(_way(_path(request)) + 2.0 * _ROUND, request),
        file="a file of points, as walk along way.csv",
    ),
    "run": MotionKind(
        (Value("distance", 1.0, -LARGEST_TARGET, LARGEST_TARGET, "body heights"),),
        _runs,
        lambda request: 170 + int(np.ceil(36 * abs(request.asked["distance"]) / _SHORTEST)),
    ),
    "turn": MotionKind(
        (Value("heading_degrees", 90.0, -LARGEST_TURN, LARGEST_TURN, "degrees"), _SPEED),
        _turns_on_the_spot,
        lambda request: _frames_of_walk(_LONG_TURN * abs(request.asked["heading_degrees"]) / 360.0, request),
    ),
    "drive": MotionKind(
        (),
        _drives,
        lambda request: int(np.ceil(60.0 * _commands(request).seconds)) + _CLOSING,
        file="a file of speeds, as drive speeds.csv",
    ),
    "stand": MotionKind(
        (Value("seconds", 2.0, 0.0, 60.0, "seconds", is_exclusive=True),),
        _stands,
        lambda request: int(np.ceil(60.0 * request.asked["seconds"])) + _CALMING,
    ),
    "get up": MotionKind((), _gets_up, lambda request: 900),
    "dance": MotionKind(
        (
            Value("tempo", 90.0, 10.0, 400.0, "beats a minute"),
            Value("first", 1.0, 0.0, LATEST, "seconds"),
            Value("beats", 16.0, 2.0, MOST_BEATS, "beats", is_integer=True),
        ),
        _dances,
        lambda request: int(np.ceil(60.0 * _beats(request)[-1])) + _CALMING,
        jumps=True,
        beats=True,
    ),
    "trajectory": MotionKind(
        (),
        _follows,
        lambda request: int(np.ceil(60.0 * max(key.time for key in _keys(request)))) + TRAJECTORY_TAIL,
        file="a file of key frames, as trajectory keys.json",
    ),
}


def parts_of(request: MotionRequest, height: float) -> list[MotionTask]:
    """What ``request``, all of its repeats, comes to for a body of ``height`` metres, in its own style where it has
    one."""
    parts, style = MOTIONS[request.name].build_tasks(request, height), request.style
    if style is None:
        return parts
    return [replace(part, begin=partial(_begun_in, style, part.begin)) for part in parts]


def _begun_in(style: Style, begin: Callable[[Stance], BodyMotion], place: Stance) -> BodyMotion:
    return begin(replace(place, style=style))
