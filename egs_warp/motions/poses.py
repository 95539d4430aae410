"""Gestures of several parts of a body that belong to another motion: the pose after a landing, and the accents of a
dance (docs/motions/gestures.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.locomotion.objectives import BodyPart
from egs_warp.motions.body_parts import FreeBranch, protruding_part
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.follow import shape_parts
from egs_warp.motions.gestures import Gesture, GestureBuilder
from egs_warp.motions.keyframes import Quantity
from egs_warp.motions.sequence import Stance
from egs_warp.motions.swing import find_swing

_POSE_LEAN, _POSE_HEAD, _POSE_TIME = 8.0, 25.0, 1.2
"""Angles in degrees by which a body in the pose after a landing leans forward and raises its head, and time in
sqrt(H / g) in which it takes the pose."""
_ACCENT_TILT, _LIGHT_HEAD = 15.0, 0.1
"""Tilt of the head on the beats of a dance, degrees, and mass relative to the body mass above which it is smaller."""
_ACCENT_FRACTION, _MIN_ACCENT_TIME = 0.6, 1.0
"""Angle of a branch that is raised on a beat of a dance, as a fraction of the upper end of its wave; and minimum time
between two such beats, and time from the last one until the body is in its initial pose, sqrt(H / g)."""


def landed_pose(stance: Stance, depth: float, seconds: float) -> Gesture:
    """Return the gesture after a landing in a crouch of ``depth`` metres: the body leans forward and
    raises its head, holds this pose for ``seconds``, and then stands up."""
    built = GestureBuilder("pose", stance)
    hold = _POSE_TIME + built.beats(seconds)
    end = hold + 2.5
    low = (0.0, 0.0, -depth / stance.body.height)
    built.add(built.whole(), Quantity.POSITION, [hold, end], [low, (0.0, 0.0, 0.0)], start=low)
    built.turn(built.whole(), (0.0, 1.0, 0.0), [_POSE_TIME, hold, end], [_POSE_LEAN, _POSE_LEAN, 0.0])
    built.turn(built.head(), (0.0, 1.0, 0.0), [_POSE_TIME, hold, end], [-_POSE_HEAD, -_POSE_HEAD, 0.0])
    return built.gesture("depth")


def beat_accents(stance: Stance, beats: Sequence[float]) -> Gesture | None:
    """Return the gesture of a dancing body: on each of the ``beats`` (s), the head tilts to the other side and one half
    of the free branches is raised while the other one is lowered. Return None if the body has neither.

    A heavy head tilts less, because its momentum would move the body. Beats that are too close to the previous one are
    skipped.
    """
    built = GestureBuilder("accents", stance)
    times: list[float] = []
    for time in (built.beats(beat) for beat in beats):
        if time - (times[-1] if times else 0.0) >= _MIN_ACCENT_TIME:
            times.append(time)
    if not times:
        return None
    times.append(times[-1] + _MIN_ACCENT_TIME)
    sides = np.array([*((-1.0) ** k for k in range(len(times) - 1)), 0.0])
    if stance.base() not in (SupportKind.LYING, SupportKind.ROUND_BASE):
        head = built.head()
        share = float(head.masses.sum()) / stance.body.mass
        tilt = _ACCENT_TILT * min(1.0, _LIGHT_HEAD / share)
        built.turn(head, (1.0, 0.0, 0.0), times, (tilt * sides).tolist())
    for number, (part, branch) in enumerate(_free_parts(stance)):
        swing = find_swing(stance, branch, 0.0)
        raised = np.where(sides == 0.0, 0.0, 0.5 + 0.5 * sides * (-1.0) ** number)
        built.turn(part, swing.axis.tolist(), times, (_ACCENT_FRACTION * swing.degrees * raised).tolist())
    built.notes.clear()
    return built.gesture() if built.is_filled else None


def _free_parts(stance: Stance) -> list[tuple[BodyPart, FreeBranch]]:
    """Return the branches of the trunk, such as arms and a tail; without any, the part that sticks out, if there is
    one."""
    body, shape = stance.body, shape_parts(stance)
    found = [(f"branch {k + 1}", branch) for k, branch in enumerate(shape.branches) if branch.is_on_trunk]
    if not shape.branches:
        protruding = protruding_part(body.mesh, stance.ground.surface_normal, shape.head)
        found = [] if protruding is None else [("protruding part", protruding)]
    return [(BodyPart.of(body, name, branch.nodes), branch) for name, branch in found]
