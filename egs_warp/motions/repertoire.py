"""Registry of the motions by name, with their parameters, construction and time limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from egs_warp.errors import UserError
from egs_warp.motions.act import Act
from egs_warp.motions.acting import ACTING, ActingKind
from egs_warp.motions.beats import MAX_BEAT_TIME, MAX_BEATS, even_beats, read_beats
from egs_warp.motions.command import DrivePlan, read_drive
from egs_warp.motions.dance import Dance
from egs_warp.motions.drive import ScriptedDrive
from egs_warp.motions.follow import Follow
from egs_warp.motions.gait_selection import jumping_reason, move_along, turn_in_place, unstable_reason
from egs_warp.motions.gestures import Gesture
from egs_warp.motions.get_up import GetUp
from egs_warp.motions.hop import HopTargets
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.keyframes import Key, read_keyframes
from egs_warp.motions.landing import landing_of
from egs_warp.motions.request import MAX_TARGET, MAX_TURN, MotionRequest
from egs_warp.motions.retake import PATH_RETAKES, SHORT_STEPS, SOFT_JUMPS, STEP_FRACTION, Retake
from egs_warp.motions.route import Route, path_route, read_path, straight_route
from egs_warp.motions.sequence import BodyMotion, MotionTask, Stance
from egs_warp.motions.skip import TURN_HEIGHT, Skip, SkipTo
from egs_warp.motions.stand import StandFor
from egs_warp.motions.style import Style
from egs_warp.motions.turn import Turn
from egs_warp.motions.values import Value

_STEP = 0.1
"""Default length of a step, in body heights."""
_IN_JUMPS = "in_jumps"
"""Name of a value that a retake sets: 1 if the body moves in jumps instead of steps."""
_JUMP_HEIGHT = 0.1
"""Height, in body heights, of the jumps that replace the steps of a walk."""
_REST_FRAMES = 120
"""Number of frames after the requested time within which a pushed standing body must come to rest."""
_CLOSING_FRAMES = 300
"""Number of frames after the last command of a drive within which the body must bring its feet together and come to
rest."""
TRAJECTORY_TAIL = 200
"""Number of frames after the last key of a trajectory within which the body must come to rest."""


@dataclass(frozen=True)
class MotionKind:
    """Kind of motion to which a script can refer by name."""

    parameters: tuple[Value, ...]
    """Parameters, in the order in which numbers without names are read."""
    build_tasks: Callable[[MotionRequest, float], list[MotionTask]]
    """Function that builds the tasks of a request, with all repeats, for a body of the given height in metres. It
    raises ``UserError`` for an invalid file."""
    frames: Callable[[MotionRequest], int]
    """Function that returns the number of frames at 60 Hz after which one repeat is cut off."""
    file: str | None = None
    """Description of the file that the motion needs, for messages; None if it needs none."""
    required: tuple[str, str] | None = None
    """Parameter that a script must give, and what to give, for messages; None if all have default values, which
    otherwise only serve to test whether a body can perform the motion."""
    jumps: bool = False
    """True if the motion consists of jumps, which have a style."""
    beats: bool = False
    """True if the motion accepts a file of beats instead of the values of its parameters."""
    retakes: tuple[Retake, ...] = ()
    """Gentler forms of the motion, in the order in which they are tried after falls."""
    gesture: Callable[[Stance, Mapping[str, float]], Gesture] | None = None
    """Function that builds the gesture of a motion that may run on top of another one; None for other motions."""

    def usage(self, name: str) -> str:
        """Describe the parameters of the motion called ``name``, for messages."""
        names = ", ".join(value.name for value in self.parameters)
        takes = f"{name} takes {names or ('a file' if self.file else 'no numbers')}"
        return f"{takes} or a file of beats" if self.beats else takes


def _target(values: Mapping[str, float], height: float) -> JumpTarget:
    return JumpTarget(values["distance"] * height, values["height"] * height)


def _repeat_task(
    request: MotionRequest, values: Mapping[str, float], begin: Callable[[Stance], BodyMotion]
) -> list[MotionTask]:
    return [MotionTask(request.name, values, begin)] * request.repeat


def _jump_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    target = _target(request.asked, height)
    return _repeat_task(request, request.asked, lambda stance: Jump(stance, landing_of(stance, target)))


def _hop_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    target = _target(request.asked, height)
    # A gesture may last until after the landing; the body waits for it at rest.
    row = HopTargets(target.distance, target.height, request.repeat, request.asked, pauses=bool(request.layers))
    return row.parts()


def _twist_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    target, turn = _target(request.asked, height), float(np.radians(request.asked["heading_degrees"]))
    return _repeat_task(request, request.asked, lambda stance: Turn(stance, target, turn))


def _steps_or_jumps(
    values: Mapping[str, float],
    steps: Callable[[Stance], BodyMotion],
    jumps: Callable[[Stance, str], BodyMotion],
    reason_for_jumps: Callable[[Stance], str | None],
    stance: Stance,
) -> BodyMotion:
    """Begin a motion in ``steps`` or in ``jumps``, whose second argument is a message for the user.

    A retake sets which of them is used. Otherwise, the body jumps if there is a ``reason_for_jumps``.
    """
    if values.get(_IN_JUMPS):
        return jumps(stance, "")
    reason = None if STEP_FRACTION in values else reason_for_jumps(stance)
    return steps(stance) if reason is None else jumps(stance, f"the body moves in jumps: {reason}")


def _route_tasks(
    request: MotionRequest,
    values: Mapping[str, float],
    route: Route,
    height: float,
    *,
    jumps: Callable[[Stance, str], BodyMotion] | None = None,
) -> list[MotionTask]:
    """Return the tasks of a motion along ``route``, which may consist of ``jumps`` instead of steps; see
    ``_steps_or_jumps``."""
    length, fraction = values.get("step_length", _STEP) * height, values.get(STEP_FRACTION, 1.0)

    def steps(stance: Stance) -> BodyMotion:
        return move_along(stance, route, length, speed=values["speed"], step_fraction=fraction)

    if jumps is None:
        return _repeat_task(request, values, steps)
    return _repeat_task(request, values, partial(_steps_or_jumps, values, steps, jumps, jumping_reason))


def _walk_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    distance = request.asked["distance"] * height

    def jumps(stance: Stance, message: str) -> BodyMotion:
        forward = stance.with_forward(float(np.sign(distance)) * stance.ground.axes[0])
        return Skip(forward, abs(distance), _JUMP_HEIGHT * height, message=message)

    return _route_tasks(request, request.asked, straight_route(distance), height, jumps=jumps)


def _walk_to_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    goal = np.array([request.asked["ahead"], request.asked["left"]])
    values = {**request.asked, "distance": float(np.linalg.norm(goal))}

    def jumps(stance: Stance, message: str) -> BodyMotion:
        return SkipTo(stance, goal * height, _JUMP_HEIGHT * height, message=message)

    return _route_tasks(request, values, path_route(goal[None] * height), height, jumps=jumps)


def _walk_along_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    points = _path(request)
    values = {**request.asked, "distance": float(np.linalg.norm(points[-1]))}
    return _route_tasks(request, values, path_route(points * height), height)


def _turn_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    angle = float(np.radians(request.asked["heading_degrees"]))
    values, length = {**request.asked, "distance": 0.0}, _STEP * height
    fraction = values.get(STEP_FRACTION, 1.0)
    target = JumpTarget(0.0, TURN_HEIGHT * height)

    def steps(stance: Stance) -> BodyMotion:
        return turn_in_place(stance, angle, length, speed=values["speed"], step_fraction=fraction)

    def jumps(stance: Stance, message: str) -> BodyMotion:
        return Turn(stance, target, angle, message=message)

    return _repeat_task(request, values, partial(_steps_or_jumps, values, steps, jumps, unstable_reason))


def _stand_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    seconds = request.asked["seconds"]
    return _repeat_task(request, request.asked, lambda stance: StandFor(stance, seconds))


def _get_up_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    return _repeat_task(request, request.asked, GetUp)


def _run_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    asked, route = request.asked, straight_route(request.asked["distance"] * height)
    speed, fraction = asked.get("speed", _SPEED.maximum), asked.get(STEP_FRACTION, 1.0)
    return _repeat_task(
        request,
        asked,
        lambda stance: move_along(stance, route, np.inf, speed=speed, step_fraction=fraction),
    )


def _dance_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    beats = _beats(request)
    values = request.asked if request.file is None else {"beats": float(len(beats)), "duration": beats[-1]}
    return _repeat_task(request, values, lambda stance: Dance(stance, beats))


def _beats(request: MotionRequest) -> tuple[float, ...]:
    """Return the beats in seconds from the start of the dance."""
    if request.file is not None:
        return read_beats(request.file)
    return even_beats(request.asked["tempo"], request.asked["first"], int(request.asked["beats"]))


def _path(request: MotionRequest) -> np.ndarray:
    assert request.file is not None
    return read_path(request.file)


def _path_length(points: np.ndarray) -> float:
    """Return the length in body heights of the path from the start through ``points`` (n, 2), including an allowance
    for turns on the spot."""
    steps = np.diff(np.concatenate([np.zeros((1, 2)), points]), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum()) + _TURN_PATH


def _frames_of_walk(path_length: float, request: MotionRequest) -> int:
    """Return the number of frames at 60 Hz within which a path of ``path_length`` body heights must be walked."""
    return 170 + int(np.ceil(36 * path_length / _MIN_STEP / request.asked["speed"]))


def _drive_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    plan = _commands(request)
    values = {"commands": float(len(plan.commands)), "duration": plan.seconds}
    return _repeat_task(request, values, lambda stance: ScriptedDrive(stance, plan))


def _commands(request: MotionRequest) -> DrivePlan:
    if request.drive is not None:
        return request.drive
    assert request.file is not None
    return read_drive(request.file)


def _trajectory_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    keys = _keys(request)
    values = {"keys": float(len(keys)), "duration": max(key.time for key in keys)}
    return _repeat_task(request, values, lambda stance: Follow(stance, keys))


def _keys(request: MotionRequest) -> tuple[Key, ...]:
    if request.keys is not None:
        return request.keys
    assert request.file is not None
    return read_keyframes(request.file)


_SPEED = Value("speed", 1.0, 0.3, 1.6, "times the usual")
_STEP_LENGTH = Value("step_length", _STEP, 0.0, MAX_TARGET, "body heights", is_exclusive=True)
_TURN_PATH = 2.5
"""Path length in body heights that takes as long as a full turn on the spot."""
_FULL_TURN_PATH = 10.0
"""Path length in body heights that takes as long as a full turn in a motion that only turns. It is four times
``_TURN_PATH``, because turns of a crawl take longer."""
_MIN_STEP = 0.02
"""Step length of a narrow base, in body heights, from which the time limit of a walk is computed."""


def _length(name: str, default: float, *, is_exclusive: bool = False) -> Value:
    return Value(name, default, 0.0, MAX_TARGET, "body heights", is_exclusive=is_exclusive)


_JUMP_RETAKES = (
    SOFT_JUMPS,
    replace(
        SOFT_JUMPS,
        change="slower, softer, lower and shorter",
        factors={"distance": 0.6, "height": 0.6, "heading_degrees": 0.6},
    ),
)
_WALK_RETAKES = (SHORT_STEPS, replace(SOFT_JUMPS, change="in slow, soft jumps", replacements={_IN_JUMPS: 1.0}))
_RUN_RETAKES = tuple(
    replace(
        retake, change=f"at the speed of a walk, {retake.change}", replacements={**retake.replacements, "speed": 1.0}
    )
    for retake in PATH_RETAKES
)


def _acting_kind(kind: ActingKind) -> MotionKind:
    return MotionKind(
        kind.parameters,
        lambda request, height: _repeat_task(
            request, _acting_values(request), lambda stance: kind.task(stance, request.asked)
        ),
        lambda request: int(np.ceil(kind.frames(request.asked))),
        jumps=kind.jumps,
        retakes=kind.retakes or (_JUMP_RETAKES if kind.jumps else ()),
        gesture=kind.gesture,
    )


def _acting_values(request: MotionRequest) -> Mapping[str, float]:
    """Return the requested values for the report. A turn is also reported as a heading, which is compared with the
    reached heading."""
    turns = request.asked.get("turns")
    return request.asked if turns is None else {**request.asked, "heading_degrees": 360.0 * turns}


MOTIONS: Mapping[str, MotionKind] = {
    "jump": MotionKind(
        (_length("distance", 0.5), _length("height", 0.2, is_exclusive=True)),
        _jump_tasks,
        lambda request: 150,
        jumps=True,
        retakes=_JUMP_RETAKES,
    ),
    "hop": MotionKind(
        (_length("distance", 0.7, is_exclusive=True), _length("height", 0.3, is_exclusive=True)),
        _hop_tasks,
        lambda request: 180,
        jumps=True,
        retakes=_JUMP_RETAKES,
    ),
    "twist": MotionKind(
        (
            Value("heading_degrees", 180.0, -MAX_TURN, MAX_TURN, "degrees"),
            _length("distance", 0.0),
            _length("height", 0.2, is_exclusive=True),
        ),
        _twist_tasks,
        lambda request: 480,
        jumps=True,
        retakes=_JUMP_RETAKES,
    ),
    "walk": MotionKind(
        (
            Value("distance", 0.4, -MAX_TARGET, MAX_TARGET, "body heights"),
            _STEP_LENGTH,
            _SPEED,
        ),
        _walk_tasks,
        lambda request: _frames_of_walk(abs(request.asked["distance"]), request),
        retakes=_WALK_RETAKES,
    ),
    "walk to": MotionKind(
        (
            Value("ahead", 0.4, -MAX_TARGET, MAX_TARGET, "body heights"),
            Value("left", 0.0, -MAX_TARGET, MAX_TARGET, "body heights"),
            _STEP_LENGTH,
            _SPEED,
        ),
        _walk_to_tasks,
        lambda request: _frames_of_walk(
            _path_length(np.array([[request.asked["ahead"], request.asked["left"]]])), request
        ),
        required=("ahead", "a target in body heights ahead and to the left, as in walk to 1,0.5"),
        retakes=_WALK_RETAKES,
    ),
    "walk along": MotionKind(
        (_STEP_LENGTH, _SPEED),
        _walk_along_tasks,
        lambda request: _frames_of_walk(_path_length(_path(request)) + 2.0 * _TURN_PATH, request),
        file="a file of points, as in walk along way.csv",
        retakes=PATH_RETAKES,
    ),
    "run": MotionKind(
        (Value("distance", 1.0, -MAX_TARGET, MAX_TARGET, "body heights"),),
        _run_tasks,
        lambda request: 170 + int(np.ceil(36 * abs(request.asked["distance"]) / _MIN_STEP)),
        retakes=_RUN_RETAKES,
    ),
    "turn": MotionKind(
        (Value("heading_degrees", 90.0, -MAX_TURN, MAX_TURN, "degrees"), _SPEED),
        _turn_tasks,
        lambda request: _frames_of_walk(_FULL_TURN_PATH * abs(request.asked["heading_degrees"]) / 360.0, request),
        retakes=_WALK_RETAKES,
    ),
    "drive": MotionKind(
        (),
        _drive_tasks,
        lambda request: int(np.ceil(60.0 * _commands(request).seconds)) + _CLOSING_FRAMES,
        file="a file of speeds, as in drive speeds.csv",
    ),
    "stand": MotionKind(
        (Value("seconds", 2.0, 0.0, 60.0, "seconds", is_exclusive=True),),
        _stand_tasks,
        lambda request: int(np.ceil(60.0 * request.asked["seconds"])) + _REST_FRAMES,
    ),
    "get up": MotionKind((), _get_up_tasks, lambda request: 900),
    "dance": MotionKind(
        (
            Value("tempo", 90.0, 10.0, 400.0, "beats a minute"),
            Value("first", 1.0, 0.0, MAX_BEAT_TIME, "seconds"),
            Value("beats", 16.0, 2.0, MAX_BEATS, "beats", is_integer=True),
        ),
        _dance_tasks,
        lambda request: int(np.ceil(60.0 * _beats(request)[-1])) + _REST_FRAMES,
        jumps=True,
        beats=True,
    ),
    "trajectory": MotionKind(
        (),
        _trajectory_tasks,
        lambda request: int(np.ceil(60.0 * max(key.time for key in _keys(request)))) + TRAJECTORY_TAIL,
        file="a file of key frames, as in trajectory keys.json",
    ),
    **{name: _acting_kind(kind) for name, kind in ACTING.items()},
}


def parameter_names() -> set[str]:
    """Return the names of the parameters of all motions."""
    return {value.name for kind in MOTIONS.values() for value in kind.parameters}


def _own_tasks(request: MotionRequest, height: float) -> list[MotionTask]:
    def begin(stance: Stance) -> BodyMotion:
        assert request.begin is not None
        motion = request.begin(stance)
        needed = sorted(name for name in vars(BodyMotion) if not name.startswith("_"))
        missing = [name for name in needed if not hasattr(motion, name)]
        if missing:
            raise UserError(
                f"{request.name}: begin returned {type(motion).__name__}, which has no {', '.join(missing)}; return an"
                " object with the attributes of BodyMotion"
            )
        return motion

    return _repeat_task(request, request.asked, begin)


_OWN = MotionKind((), _own_tasks, lambda request: int(np.ceil(60.0 * request.seconds)), jumps=True)
"""Motion of a class of the user's own; it may contain jumps."""


def motion_names() -> list[str]:
    """Return the names of all motions, for help texts: names that contain "and" are in quotes, and the names of motions
    that need a file are followed by FILE."""
    return [f"'{name}'" if " and " in name else name + " FILE" * bool(kind.file) for name, kind in MOTIONS.items()]


def kind_of_request(request: MotionRequest) -> MotionKind:
    """Return the kind of the motion of ``request``."""
    return MOTIONS[request.name] if request.begin is None else _OWN


def tasks_of_request(request: MotionRequest, height: float) -> list[MotionTask]:
    """Return the tasks of ``request``, with all repeats, its style and its gestures, for a body of ``height`` metres.

    The tasks of a retake are gentler, but are judged by the requested values.
    """
    kind = kind_of_request(request)
    factors: Mapping[str, float] = {}
    parts = gentler = kind.build_tasks(request, height)
    if request.retake > 0:
        change = kind.retakes[request.retake - 1]
        gentler, factors = kind.build_tasks(replace(request, asked=change.values(request.asked)), height), change.style
    begins = [task.begin for task in gentler]
    if request.layers:
        begins = [partial(_begin_with_layers, request, begin) for begin in begins]
    if request.style is not None or factors:
        begins = [partial(_begin_in_style, request.style, factors, begin) for begin in begins]
    return [replace(part, begin=begin) for part, begin in zip(parts, begins, strict=True)]


def _begin_in_style(
    style: Style | None, factors: Mapping[str, float], begin: Callable[[Stance], BodyMotion], stance: Stance
) -> BodyMotion:
    """Begin a motion in ``style``, or in the style of the run if it is None, scaled by ``factors``."""
    return begin(replace(stance, style=(style or stance.style).scaled(factors)))


def _begin_with_layers(request: MotionRequest, begin: Callable[[Stance], BodyMotion], stance: Stance) -> BodyMotion:
    """Begin the motion of ``request`` together with its gestures; ``begin`` starts the motion alone."""
    gestures = []
    for layer in request.layers:
        build = MOTIONS[layer.request.name].gesture
        assert build is not None
        gestures.append((layer.begin, build(stance, layer.request.asked)))
    own = kind_of_request(request).gesture
    if own is not None:
        return Act(stance, [(0.0, own(stance, request.asked)), *gestures])
    return Act(stance, gestures, begin(stance))


def frames_of_request(request: MotionRequest) -> int:
    """Return the number of frames at 60 Hz after which one repeat, with its gestures, is cut off."""
    layers = [60.0 * layer.begin + frames_of_request(layer.request) for layer in request.layers]
    return max(kind_of_request(request).frames(request), *map(round, layers), 0)
