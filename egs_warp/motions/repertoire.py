"""From what a user asks for to motions that a body can do: the one list of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict

import numpy as np

from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.follow import Follow
from egs_warp.motions.hop import Hop, Squares
from egs_warp.motions.jump import JumpTarget
from egs_warp.motions.keyframes import read_keyframes
from egs_warp.motions.leap import Leap
from egs_warp.motions.script import MotionRequest
from egs_warp.motions.sequence import BodyMotion, Part, Place
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk

FRAMES: Mapping[str, int] = {"jump": 120, "hop": 150, "twist": 480, "walk": 170}
"""Frames at 60 Hz within which a motion of each kind comes to rest; one that takes longer is cut off."""
STEP_FRAMES = 36
"""Frames of each step of a walk, on top."""
TRAJECTORY_TAIL = 200
"""Frames after the last key of a trajectory within which the body is at rest."""


def _jump(asked: Mapping[str, float], place: Place) -> BodyMotion:
    height = place.body.height
    return Leap(place, JumpTarget(asked["distance"] * height, asked["height"] * height))


def _twist(asked: Mapping[str, float], place: Place) -> BodyMotion:
    height = place.body.height
    target = JumpTarget(asked["distance"] * height, asked["height"] * height)
    return Turn(place, target, float(np.radians(asked["heading_degrees"])))


def _walk(asked: Mapping[str, float], place: Place) -> BodyMotion:
    return Walk(place, int(asked["steps"]), asked["step_length"] * place.body.height)


_BEGIN: Mapping[str, Callable[[Mapping[str, float], Place], BodyMotion]] = {
    "jump": _jump,
    "twist": _twist,
    "walk": _walk,
}


def parts_of(requests: Sequence[MotionRequest], height: float) -> list[Part]:
    """The motions of a script, for a body of ``height`` metres, in their order."""
    parts: list[Part] = []
    for request in requests:
        asked = request.asked
        if request.name == "hop":
            row = Squares(asked["distance"] * height, asked["height"] * height, request.repeat, asked)
            parts += row.parts()
        elif request.file is not None:
            keys = read_keyframes(request.file)
            asked = {"keys": float(len(keys)), "duration": max(key.time for key in keys)}
            parts += [Part(request.name, asked, lambda place, keys=keys: Follow(place, keys))] * request.repeat
        else:
            begin = _BEGIN[request.name]
            if request.name == "walk":
                asked = {**asked, "distance": asked["steps"] * asked["step_length"]}
            for _ in range(request.repeat):
                parts.append(Part(request.name, asked, lambda place, asked=asked, begin=begin: begin(asked, place)))
    return parts


def check_possible(parts: Sequence[Part], place: Place) -> None:
    """Raises the ``UserError`` that a later motion would raise when its turn comes,
    for a body that stands at ``place``.
    """
    for part in parts:
        if part.name != "hop":  # a row of hops remembers where it began
            part.begin(place)


def also_reached(motion: BodyMotion, trajectory: Trajectory, first: int, last: int) -> dict[str, float]:
    """What a report says of a motion beside the measures that all have;
    ``first`` and ``last`` are indices into ``time``.
    """
    if isinstance(motion, Hop):
        return {"square_miss": motion.miss(trajectory.positions[last]) / motion.target.distance}
    if isinstance(motion, Walk):
        return asdict(motion.footfalls(trajectory, first, last))
    if isinstance(motion, Follow):
        return {"worst_miss": motion.planned()["worst_miss"]}
    return {}


def longest(requests: Sequence[MotionRequest]) -> int:
    """Frames after which a script is cut off."""
    total = 0
    for request in requests:
        if request.file is not None:
            seconds = max(key.time for key in read_keyframes(request.file))
            total += request.repeat * (int(np.ceil(60.0 * seconds)) + TRAJECTORY_TAIL)
        else:
            steps = int(request.asked.get("steps", 0))
            total += request.repeat * (FRAMES[request.name] + STEP_FRAMES * steps)
    return total
