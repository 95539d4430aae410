"""Motions towards other bodies of a world, such as ``face NAME``, ``kick NAME`` and ``push NAME to X,Y``.

``face``, ``jump to`` and ``kick`` are planned from the position of the other body at their start. Walks are steered
while they run: they follow a moving body, and avoid other bodies and obstacles.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.fem.body import GRAVITY
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.kick import Kick
from egs_warp.motions.other_body import OtherBody, radius_of
from egs_warp.motions.repertoire import MOTIONS, frames_of_request, tasks_of_request
from egs_warp.motions.request import MAX_TARGET, MotionRequest
from egs_warp.motions.script import Script
from egs_warp.motions.script import motion as script
from egs_warp.motions.sequence import BodyMotion, Stance, TargetError
from egs_warp.motions.stand import StandFor
from egs_warp.motions.steering import Policy, Steered, is_blocked
from egs_warp.motions.steering_targets import AvoidBody, FollowBody, PushTo, WalkToBody, WalkToPoint
from egs_warp.motions.values import Value

_MIN_TURN = np.radians(3.0)
"""Angle to the other body, in radians, below which ``face`` stands instead of turning."""
_NO_TURN_TIME = 0.1
"""Duration of this stand, s."""
_TIME_FACTOR = 2.0
"""Ratio of the time limit of a motion to the limit that it would have at the start of the run. The ratio exceeds 1
because the other body may move away."""
_MIN_SPEED, _EXTRA_TIME = 0.04, 12.0
"""Assumed speed in sqrt(g H), a third of the commanded one, and assumed time in seconds for turning; from both, the
time limit of a steered walk is computed."""
_TIME_PER_OTHER = 3.0
"""Time in seconds that is added to this limit for each other body, which may block the way or require a detour. Eight
discs that cross a circle of 3 m at 0.4 of the commanded speed need 50 s."""
_MAX_PLACE = 1e4
"""Largest coordinate of a target of ``push``, m."""


def _gap(default: float) -> Value:
    return Value("gap", default, 0.0, MAX_TARGET, "body heights")


_SECONDS = Value("seconds", 5.0, 0.0, 60.0, "seconds", is_exclusive=True)
TOWARDS: Mapping[str, tuple[Value, ...]] = {
    "face": MOTIONS["turn"].parameters[1:],
    "walk to": (_gap(0.1),),
    "stop before": (_gap(0.5),),
    "jump to": MOTIONS["jump"].parameters[1:],
    "kick": (
        Value("distance", 1.2, 0.0, MAX_TARGET, "body heights", is_exclusive=True),
        Value("height", 0.45, 0.0, MAX_TARGET, "body heights", is_exclusive=True),
    ),
    "follow": (_SECONDS, _gap(0.2)),
    "avoid": (_SECONDS, _gap(0.5)),
    "push": (),
}
"""Parameters of each motion towards a body, in the order in which numbers without names are read."""


@dataclass(frozen=True)
class _Piece:
    """Motion towards a body, as parsed from text."""

    kind: str
    name: str
    values: Mapping[str, float]
    place: np.ndarray | None = None
    """(2,) m, target of a push in the frame of the world."""


def script_among(text: str, others: Mapping[str, OtherBody], stance: Stance) -> Script:
    """Parse motions, including those towards ``others``, into a script; see ``script.motion``.

    Args:
        text: the motions.
        others: the other bodies of the world by their names.
        stance: stance of the body at the start, from which the time limits are computed.

    Raises:
        UserError: for the first mistake.
    """
    requests: list[MotionRequest] = []
    for number, text_of_piece in enumerate(_pieces(text), start=1):
        where = f"motion {number} ({text_of_piece!r})"
        piece = _parse(text_of_piece, where)
        if piece is None:
            requests += _among(script(text_of_piece).requests, others, stance)
            continue
        _check_name(piece, others, where)
        asked: dict[str, float] = {}
        seconds = _time_limit(piece, others, stance)
        begin = partial(_begin, piece, others, asked)
        requests.append(MotionRequest(f"{piece.kind} {piece.name}", asked, begin=begin, seconds=seconds))
    return Script(tuple(requests))


def script_without_others(text: str) -> Script:
    """Parse motions into a script, without those towards other bodies. Raises ``UserError`` for the first mistake."""
    numbered = enumerate(_pieces(text), start=1)
    own = [piece for number, piece in numbered if _parse(piece, f"motion {number} ({piece!r})") is None]
    return Script(tuple(request for piece in own for request in script(piece).requests))


def check_motion(text: str, others: Collection[str]) -> None:
    """Raise ``UserError`` if the text of a creature's motions has a mistake; ``others`` are the names of the other
    bodies."""
    for number, text_of_piece in enumerate(_pieces(text), start=1):
        where = f"motion {number} ({text_of_piece!r})"
        piece = _parse(text_of_piece, where)
        if piece is None:
            script(text_of_piece).frames()
        else:
            _check_name(piece, others, where)


def _check_name(piece: _Piece, others: Collection[str], where: str) -> None:
    """Raise ``UserError`` if the body of a motion is not among ``others``."""
    if piece.name not in others:
        known = f"give one of {', '.join(others)}" if others else "the world has no other body"
        raise UserError(f"{where}: no body {piece.name!r}{did_you_mean(piece.name, others)}; {known}")


def _pieces(text: str) -> list[str]:
    """Split a line at the commas between motions; a comma before a number separates two numbers."""
    return [piece.strip() for piece in re.split(r",(?!\s*[-+.]?\d)", text)]


def _parse(piece: str, where: str) -> _Piece | None:
    """Parse a motion towards a body; None for other motions."""
    for kind, parameters in TOWARDS.items():
        match = re.fullmatch(rf"{kind}\s+([A-Za-z_][\w-]*)(?![\w=-])\s*(.*)", piece, re.IGNORECASE)
        if match is None or match[2].startswith("="):
            continue
        name, words = match[1], match[2].split()
        if kind == "push":
            return _Piece(kind, name, {}, _place(match[2], where))
        return _Piece(kind, name, _values(kind, parameters, words, where))
    word = piece.split(maxsplit=1)[0].lower() if piece else ""
    kinds = [kind for kind in TOWARDS if " " not in kind]
    if word and word not in {name.split()[0] for name in MOTIONS} and not did_you_mean(word, MOTIONS):
        if word in kinds:
            raise UserError(f"{where}: name a body of the world after {word}")
        if meant := did_you_mean(word, kinds):
            raise UserError(f"{where}: unknown motion {word!r}{meant}")
    return None


def _place(text: str, where: str) -> np.ndarray:
    """Parse the target ``to X,Y`` of a push."""
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
    match = re.fullmatch(rf"to\s+({number})(?:\s*,\s*|\s+)({number})", text.strip(), re.IGNORECASE)
    if match is None or max(abs(float(match[1])), abs(float(match[2]))) > _MAX_PLACE:
        raise UserError(f"{where}: give a position in the world in metres, as in push box to 1,0.5")
    return np.array([float(match[1]), float(match[2])])


def _values(kind: str, parameters: tuple[Value, ...], words: list[str], where: str) -> dict[str, float]:
    """Parse the numbers of a motion, in order or by name."""
    known = {value.name: value for value in parameters}
    given: dict[str, float] = {}
    for word in words:
        if re.fullmatch(r"[xX]\d+", word):
            raise UserError(f"{where}: {kind} cannot be repeated with {word}; write the motion again")
        key, equals, number = word.partition("=")
        free = [name for name in known if name not in given]
        key, number = (key, number) if equals else (free[0] if free else "", word)
        if key not in known or key in given:
            names = " and ".join(known)
            raise UserError(f"{where}: {word!r}{did_you_mean(key, known)}: {kind} takes the numbers {names}")
        given[key] = known[key].parse(number, where)
    return {name: given.get(name, value.default) for name, value in known.items()}


def _time_limit(piece: _Piece, others: Mapping[str, OtherBody], stance: Stance) -> float:
    """Return the time limit of a motion in seconds, for a body of 1 m."""
    centre = others[piece.name].centre(stance)
    if piece.kind in ("follow", "avoid"):
        return piece.values["seconds"] + 5.0
    if piece.kind in ("jump to", "kick"):
        (base,) = script("jump").requests
    elif piece.kind == "face":
        angle = float(np.degrees(np.arctan2(centre[1], centre[0])))
        (base,) = script(f"turn {angle:.6f}").requests
    else:
        length = float(np.linalg.norm(centre))
        if piece.place is not None:
            length += float(np.linalg.norm(_in_frame(piece.place, stance) - centre))
        return _walk_limit(length / stance.body.height, others)
    return _TIME_FACTOR * frames_of_request(base) / 60.0


def _walk_limit(length: float, others: Mapping[str, OtherBody]) -> float:
    """Return the time limit of a steered walk of ``length`` body heights among ``others`` in seconds, for a body of
    1 m."""
    return _EXTRA_TIME + _TIME_PER_OTHER * len(others) + length / (_MIN_SPEED * GRAVITY**0.5)


def _in_frame(place: np.ndarray, stance: Stance) -> np.ndarray:
    """Transform a point (2,) m on the ground of the world to the ground frame of ``stance``."""
    return stance.ground.local(np.array([*place, 0.0]))[:2]


def _among(
    requests: tuple[MotionRequest, ...], others: Mapping[str, OtherBody], stance: Stance
) -> tuple[MotionRequest, ...]:
    """Return the requests of a creature that shares its world with ``others``: a walk to a point is steered around
    them."""
    if not others:
        return requests
    return tuple(
        replace(
            request,
            begin=partial(_begin_walk, request, others),
            seconds=_walk_limit(float(np.hypot(request.asked["ahead"], request.asked["left"])), others),
        )
        if request.name == "walk to" and not request.layers
        else request
        for request in requests
    )


def _begin_walk(request: MotionRequest, others: Mapping[str, OtherBody], stance: Stance) -> BodyMotion:
    """Begin a walk to a point, given in body heights ahead and to the left."""
    point = stance.body.height * np.array([request.asked["ahead"], request.asked["left"]])
    return _steered(WalkToPoint(stance, point), others, stance, "walk to", goal=point)


def _begin(piece: _Piece, others: Mapping[str, OtherBody], asked: dict[str, float], stance: Stance) -> BodyMotion:
    """Begin a motion towards a body. The target heading of ``face`` is stored in ``asked``, so that the result is
    judged by it. A ``jump to`` has no such target, because the other body may stop the jump."""
    other, values = others[piece.name], piece.values
    height, name = stance.body.height, piece.name
    centre, _ = other.place(stance)
    if piece.kind == "face":
        asked["heading_degrees"] = float(np.degrees(np.arctan2(centre[1], centre[0])))
        if abs(np.radians(asked["heading_degrees"])) < _MIN_TURN:
            return StandFor(stance, _NO_TURN_TIME)
        return _of_registry("turn", {**asked, **values}, stance)
    if piece.kind == "jump to":
        distance = float(np.linalg.norm(centre))
        forward = stance.with_forward(centre @ stance.ground.axes[:2] / distance)
        return _of_registry("jump", {"distance": min(distance / height, MAX_TARGET), **values}, forward)
    if piece.kind == "kick":
        return Kick(stance, other, name, JumpTarget(values["distance"] * height, values["height"] * height))
    if piece.kind == "push":
        assert piece.place is not None
        place = _in_frame(piece.place, stance)
        return _steered(PushTo(stance, other, name, place), others, stance, f"push {name}")
    gap = values["gap"] * height
    if piece.kind == "follow":
        return _steered(FollowBody(stance, other, name, gap, values["seconds"]), others, stance, f"follow {name}")
    if piece.kind == "avoid":
        return _steered(AvoidBody(stance, other, name, gap, values["seconds"]), others, stance, f"avoid {name}")
    return _steered(WalkToBody(stance, other, name, gap), others, stance, f"{piece.kind} {name}")


def _of_registry(name: str, values: Mapping[str, float], stance: Stance) -> BodyMotion:
    """Begin a motion of the registry."""
    (base,) = script(name).requests
    (task,) = tasks_of_request(replace(base, asked={**base.asked, **values}), stance.body.height)
    return task.begin(stance)


def _steered(
    policy: Policy, others: Mapping[str, OtherBody], stance: Stance, what: str, *, goal: np.ndarray | None = None
) -> Steered:
    """Return a steered walk. Raises ``TargetError`` if its ``goal`` (2,) m is in an obstacle or in a body."""
    height = stance.body.height
    if goal is not None:
        where = f"{goal[0] / height:.2f} body heights ahead and {goal[1] / height:.2f} to the left"
        if is_blocked(stance, goal, radius_of(stance.ground.local(stance.standing))):
            raise TargetError(f"{what}: there is an obstacle at the target, {where}; give a target beside it")
        # Check only props, because other creatures may move away.
        for name, other in others.items():
            centre, touching = other.place(stance)
            if other.body.mesh.tets.shape[0] == 1 and np.linalg.norm(centre - goal) < touching:
                raise TargetError(f"{what}: {name} is at the target, {where}; give a target beside it")
    expected = 10.0 * stance.body.time_unit
    return Steered(stance, others, policy, expected_time=expected)
