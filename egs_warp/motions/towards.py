"""Motions towards other bodies of a world: ``face NAME``, ``walk to NAME`` and ``jump to NAME``.

They are a turn, a walk and a jump of the registry. Their targets are computed from the position of the other body when
the motion starts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.motions.repertoire import frames_of_request, tasks_of_request
from egs_warp.motions.request import MAX_TARGET, MotionRequest
from egs_warp.motions.script import Script
from egs_warp.motions.script import motion as script
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.stand import StandFor

TOWARDS = {"face": "turn 90", "walk to": "walk to 1,0", "jump to": "jump 1"}
"""Motion of the registry on which each motion towards a body is based."""
_CLEARANCE = 0.1
"""Gap to the other body at which a walk ends, in body heights."""
_MIN_TURN = np.radians(3.0)
"""Angle to the other body, in radians, below which ``face`` is a stand instead of a turn."""
_NO_TURN_TIME = 0.1
"""Duration of this stand, s."""
_TIME_FACTOR = 2.0
"""Ratio of the time limit to the limit that the motion would have at the start of the run. It exceeds 1 because the
other body may move away."""


@dataclass(frozen=True)
class OtherBody:
    """Another body of the world. A motion measures its position at the time at which it starts."""

    body: SoftBody
    state: Callable[[], BodyState]
    """Function that returns its current state."""

    def place(self, stance: Stance) -> tuple[np.ndarray, float]:
        """Return the centre of mass (2,) m in the ground frame of ``stance``, and the approximate distance, in metres,
        between the centres of the two bodies at which they touch."""
        positions = self.state().positions
        local = stance.ground.local(positions)
        return self.body.centre_of_mass(local)[:2], _radius(stance.ground.local(stance.standing)) + _radius(local)


def _radius(local: np.ndarray) -> float:
    """Return half of the mean horizontal extent of nodes (N, 3) m."""
    return 0.25 * float(np.ptp(local[:, :2], axis=0).sum())


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
    for number, piece in enumerate(_pieces(text), start=1):
        kind, name, rest = _split(piece)
        if kind is None:
            requests += script(piece).requests
            continue
        if name not in others:
            known = f"give one of {', '.join(others)}" if others else "the world has no other body"
            raise UserError(f"motion {number} ({piece!r}): no body {name!r}{did_you_mean(name, others)}; {known}")
        (base,) = script(f"{TOWARDS[kind]} {rest}").requests
        if base.repeat != 1:
            raise UserError(f"motion {number} ({piece!r}): it cannot be repeated; write it once more")
        asked: dict[str, float] = {}
        begin = partial(_begin, kind, base, others[name], asked)
        nearest = _with_target(kind, base, *others[name].place(stance), stance.body.height)
        seconds = _TIME_FACTOR * frames_of_request(nearest) / 60.0
        requests.append(MotionRequest(f"{kind} {name}", asked, begin=begin, seconds=seconds, layers=base.layers))
    return Script(tuple(requests))


def check_motion(text: str) -> None:
    """Raise ``UserError`` for a mistake in motions that does not depend on the names of other bodies."""
    for piece in _pieces(text):
        kind, _, rest = _split(piece)
        script(piece if kind is None else f"{TOWARDS[kind]} {rest}").frames()


def _pieces(text: str) -> list[str]:
    """Split a line at the commas between motions; a comma before a number separates two numbers."""
    return [piece.strip() for piece in re.split(r",(?!\s*[-+.]?\d)", text)]


def _split(piece: str) -> tuple[str | None, str, str]:
    """Return the kind, the name of the other body and the remaining text of a motion towards a body; the kind of other
    motions is None."""
    for kind in TOWARDS:
        match = re.fullmatch(rf"{kind}\s+([A-Za-z_][\w-]*)(?![\w=-])\s*(.*)", piece, re.IGNORECASE)
        if match is not None and not match[2].startswith("="):
            return kind, match[1], match[2]
    return None, "", ""


def _with_target(kind: str, base: MotionRequest, target: np.ndarray, touching: float, height: float) -> MotionRequest:
    """Return the request for the motion of ``kind`` towards a body ``target`` (2,) m ahead and to the left."""
    distance = float(np.linalg.norm(target))
    if kind == "face":
        values = {"heading_degrees": float(np.degrees(np.arctan2(target[1], target[0])))}
    elif kind == "jump to":
        values = {"distance": min(distance / height, MAX_TARGET)}
    else:
        left = max(distance - touching - _CLEARANCE * height, 0.0) / max(distance, 1e-9)
        ahead, aside = np.clip(left * target / height, -MAX_TARGET, MAX_TARGET).tolist()
        values = {"ahead": ahead, "left": aside}
    return replace(base, asked={**base.asked, **values}, layers=())


def _begin(kind: str, base: MotionRequest, other: OtherBody, asked: dict[str, float], stance: Stance) -> BodyMotion:
    """Begin the motion of ``kind`` towards ``other`` and store its target in ``asked``, by which the result is
    judged. A jump has no such target, because the other body may stop it."""
    target, touching = other.place(stance)
    height = stance.body.height
    request = _with_target(kind, base, target, touching, height)
    if kind == "jump to":
        direction = target @ stance.ground.axes[:2]
        stance = stance.with_forward(direction / np.linalg.norm(direction))
    elif kind == "face":
        asked["heading_degrees"] = request.asked["heading_degrees"]
        if abs(np.radians(asked["heading_degrees"])) < _MIN_TURN:
            return StandFor(stance, _NO_TURN_TIME)
    else:
        asked["distance"] = float(np.hypot(request.asked["ahead"], request.asked["left"]))
    (task,) = tasks_of_request(request, height)
    return task.begin(stance)
