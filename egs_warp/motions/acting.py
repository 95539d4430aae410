"""Registry of expressive motions: gestures, and jumps and walks with a character (docs/motions/gestures.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from egs_warp.motions.act import Act
from egs_warp.motions.flip import Flip
from egs_warp.motions.gestures import Gesture, bow, groove, look_around, nod, shake, watch, wave
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.land_and_pose import LandAndPose
from egs_warp.motions.request import MAX_TARGET
from egs_warp.motions.retake import HIGH_FLIPS, PATH_RETAKES, STEP_FRACTION, Retake
from egs_warp.motions.route import straight_route
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.skip import Skip
from egs_warp.motions.swing import MAX_ANGLE
from egs_warp.motions.turn import Turn
from egs_warp.motions.values import Value
from egs_warp.motions.walk import Walk
from egs_warp.motions.walk_posture import LeggedPosture, select_posture

_SNEAK_SPEED, _SNEAK_HEIGHT, _SNEAK_STEP = 0.6, 0.92, 0.1
"""Parameters of a sneak: speed relative to a normal walk, height of the centre of mass of a body on a single base
relative to standing, and step length in body heights."""


@dataclass(frozen=True)
class ActingKind:
    """Kind of an expressive motion."""

    parameters: tuple[Value, ...]
    """Parameters, in the order in which numbers without names are read."""
    frames: Callable[[Mapping[str, float]], float]
    """Number of frames at 60 Hz within which a body of 1 m comes to rest."""
    gesture: Callable[[Stance, Mapping[str, float]], Gesture] | None = None
    """Function that builds the gesture of a motion that may run on top of another one; None for other motions."""
    begin: Callable[[Stance, Mapping[str, float]], BodyMotion] | None = None
    """Function that creates a motion that is not a gesture; None for gestures."""
    jumps: bool = False
    """True if the motion consists of jumps, which have a style."""
    retakes: tuple[Retake, ...] = ()
    """Gentler forms of the motion, in the order in which they are tried after falls. Jumps without their own have
    those of ``jump``."""

    def task(self, stance: Stance, values: Mapping[str, float]) -> BodyMotion:
        """Return the motion of the body that stands at ``stance``. Raises ``UserError`` if the body cannot perform
        it."""
        if self.gesture is not None:
            return Act(stance, [(0.0, self.gesture(stance, values))])
        assert self.begin is not None
        return self.begin(stance, values)


def _sneak(stance: Stance, values: Mapping[str, float]) -> BodyMotion:
    height = stance.body.height
    route = straight_route(values["distance"] * height)
    # A body on legs does not crouch, because bent legs slide when they swing.
    crouch = 1.0 if select_posture(stance)[1] is LeggedPosture else _SNEAK_HEIGHT
    fraction = values.get(STEP_FRACTION, 1.0)
    walk = Walk(stance, route, _SNEAK_STEP * height, speed=_SNEAK_SPEED, step_fraction=fraction, crouch=crouch)
    return Act(stance, [(0.0, watch(stance, walk.expected_time))], walk)


def _skip(stance: Stance, values: Mapping[str, float]) -> BodyMotion:
    height = stance.body.height
    return Skip(stance, values["distance"] * height, values["height"] * height)


def _spin(stance: Stance, values: Mapping[str, float]) -> BodyMotion:
    return Turn(stance, JumpTarget(0.0, values["height"] * stance.body.height), 2.0 * np.pi * values["turns"])


def _land_and_pose(stance: Stance, values: Mapping[str, float]) -> BodyMotion:
    height = stance.body.height
    target = JumpTarget(values["distance"] * height, values["height"] * height)
    return LandAndPose(stance, target, values["seconds"])


def _flip(side: float, stance: Stance, values: Mapping[str, float]) -> BodyMotion:
    """Return a somersault forward (``side`` = 1) or backward (-1)."""
    return Flip(stance.with_forward(side * stance.ground.axes[0]), values["height"] * stance.body.height)


def _degrees(default: float, largest: float) -> Value:
    return Value("degrees", default, 2.0, largest, "degrees")


def _count(default: float) -> Value:
    return Value("count", default, 1.0, 20.0, "times", is_integer=True)


def _height(default: float) -> Value:
    return Value("height", default, 0.0, MAX_TARGET, "body heights", is_exclusive=True)


def _distance(default: float) -> Value:
    return Value("distance", default, 0.0, MAX_TARGET, "body heights", is_exclusive=True)


def _lasting(seconds: float, each: float, values: Mapping[str, float]) -> float:
    """Return the number of frames of a gesture that takes ``seconds`` s, plus ``each`` s per repetition."""
    return 60.0 * (seconds + each * values.get("count", 0.0))


def _flip_kind(side: float) -> ActingKind:
    """Return the kind of a somersault forward (``side`` = 1) or backward (-1)."""
    return ActingKind(
        (_height(1.0),), lambda values: 480.0, begin=partial(_flip, side), jumps=True, retakes=(HIGH_FLIPS,)
    )


_BRANCH = Value("branch", 0.0, 0.0, 99.0, "branches", is_integer=True)
"""Number of the branch that moves; 0 is the head, or for a wave the branch that is chosen for it."""

ACTING: Mapping[str, ActingKind] = {
    "nod": ActingKind(
        (Value("degrees", 0.0, 0.0, 45.0, "degrees"), _count(2), _BRANCH), partial(_lasting, 4.0, 1.0), nod
    ),
    "shake": ActingKind((_degrees(25.0, 60.0), _count(2), _BRANCH), partial(_lasting, 4.0, 1.0), shake),
    "look around": ActingKind((_degrees(35.0, 75.0), _BRANCH), partial(_lasting, 6.0, 0.0), look_around),
    "wave": ActingKind(
        (
            Value("degrees", 0.0, 0.0, MAX_ANGLE, "degrees"),
            Value("count", 0.0, 0.0, 20.0, "times", is_integer=True),
            _BRANCH,
        ),
        partial(_lasting, 7.0, 1.0),
        wave,
    ),
    "bow": ActingKind((_degrees(30.0, 50.0), _BRANCH), partial(_lasting, 6.0, 0.0), bow),
    "groove": ActingKind(
        (
            Value("tempo", 100.0, 40.0, 200.0, "beats a minute"),
            Value("beats", 8.0, 2.0, 1000.0, "beats", is_integer=True),
            Value("sway", 0.05, 0.01, 0.15, "body heights"),
        ),
        lambda values: 180.0 + 3600.0 * values["beats"] / values["tempo"],
        groove,
    ),
    "sneak": ActingKind(
        (Value("distance", 0.4, 0.0, MAX_TARGET, "body heights", is_exclusive=True),),
        lambda values: 300.0 + 2700.0 * values["distance"],
        begin=_sneak,
        retakes=PATH_RETAKES,
    ),
    "skip": ActingKind(
        (_distance(0.9), _height(0.12)),
        lambda values: 150.0 * (2.0 + np.ceil(4.0 * values["distance"])),
        begin=_skip,
        jumps=True,
    ),
    "spin": ActingKind(
        (Value("turns", 1.0, -2.0, 2.0, "turns"), _height(0.2)),
        lambda values: 960.0,
        begin=_spin,
        jumps=True,
    ),
    "backflip": _flip_kind(-1.0),
    "front flip": _flip_kind(1.0),
    "land and pose": ActingKind(
        (_distance(0.4), _height(0.25), Value("seconds", 1.5, 0.0, 60.0, "seconds", is_exclusive=True)),
        lambda values: 400.0 + 60.0 * values["seconds"],
        begin=_land_and_pose,
        jumps=True,
    ),
}
"""Expressive motions by name."""
