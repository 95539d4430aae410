"""What the page asks of a live session: small JSON objects, checked before anything is done with them.

Each has a ``type``; docs/guide/live.md lists them all.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

from egs_warp.motions.command import FASTEST, Drive
from egs_warp.motions.push import MAX_IMPULSE
from egs_warp.motions.script import Script, motion
from egs_warp.motions.style import LEAST, MOST, Style

MAX_TEXT_LENGTH = 200
"""Characters of motions asked for at once."""
MAX_DISTANCE = 100.0
"""Body heights from the start: nothing goes, or is pulled, further."""
MIN_SAG, MAX_SAG = 0.01, 0.1
"""rho g H / E of a column: stiff and soft."""
MAX_FRICTION = 2.0
STYLE_NAMES = tuple(field.name for field in fields(Style))
_MOTIONS = re.compile(r"[A-Za-z0-9_=+\-., ]+")


@dataclass(frozen=True)
class PlayScript:
    """Do these motions next, in place of what was to come."""

    script: Script


@dataclass(frozen=True)
class GoTo:
    """Go to a point of the ground, in place of what was to come."""

    point: tuple[float, float]
    """Metres, frame of the body."""


@dataclass(frozen=True)
class Steer:
    """Go so until told otherwise, in place of what was to come; told to stand, it stops."""

    command: Drive


@dataclass(frozen=True)
class Pull:
    """Pull at a node by a spring, until ``Release``."""

    node: int
    target: tuple[float, float, float]
    """Metres, frame of the body."""


@dataclass(frozen=True)
class Release:
    """Let go of what is pulled."""


@dataclass(frozen=True)
class PushOnce:
    """Push the body in the next step."""

    impulse: tuple[float, float, float]
    """m sqrt(g H), frame of the body."""
    height: float | None = None
    """Body heights over the sole of the standing body, around which nodes take it; None: all alike."""


@dataclass(frozen=True)
class Change:
    """Another friction or stiffness; None: as it is."""

    friction: float | None = None
    """Coulomb coefficient."""
    sag: float | None = None
    """rho g H / E of a column."""


@dataclass(frozen=True)
class Restyle:
    """Jump so from the next motion on."""

    style: Style


@dataclass(frozen=True)
class Pause:
    """Hold still, or go on."""

    on: bool


@dataclass(frozen=True)
class Step:
    """One solver step, while it holds still."""


@dataclass(frozen=True)
class Cancel:
    """Drop what was to come; what is being done is done to its end."""


@dataclass(frozen=True)
class StandUp:
    """Put it back where it stood at first."""


@dataclass(frozen=True)
class Record:
    """Begin a take, or end it and write it."""

    on: bool


@dataclass(frozen=True)
class RequestScript:
    """Say what it has done, as a script."""


Message: TypeAlias = (
    PlayScript
    | GoTo
    | Steer
    | Pull
    | Release
    | PushOnce
    | Change
    | Restyle
    | Pause
    | Step
    | Cancel
    | StandUp
    | Record
    | RequestScript
)


def read_message(message: Mapping[str, Any], *, height: float, node_count: int) -> Message:
    """The record of a JSON object, for a body of ``height`` metres. Raises ``ValueError`` for what makes no sense."""
    kind = message.get("type")
    if not isinstance(kind, str) or kind not in _READERS:
        raise ValueError(f"type {str(kind)[:40]!r}; known are {', '.join(_READERS)}")
    fields, read = _READERS[kind]
    unknown = [name for name in message if name != "type" and name not in fields]
    if unknown:
        raise ValueError(f"{kind} has no {unknown[0][:40]!r}")
    return read(message, MAX_DISTANCE * height, node_count)


def _read_script(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    text = message.get("text")
    if not isinstance(text, str) or len(text) > MAX_TEXT_LENGTH:
        raise ValueError(f"text: give motions in at most {MAX_TEXT_LENGTH} characters, as jump 0.5 0.2")
    # A script or key frames would be files of this machine.
    if not _MOTIONS.fullmatch(text) or re.search(r"\.(json|csv)", text, re.IGNORECASE):
        raise ValueError("text: give motions by name and number, as hop x3, twist 90")
    script = motion(text)
    if any(request.file is not None for request in script.requests):
        raise ValueError("text: motions that need a file are for egs-warp animate")
    return PlayScript(script)


def _read_go(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    return GoTo((_read_number(message, "x", -reach, reach), _read_number(message, "y", -reach, reach)))


def _read_steer(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    names = ("forward", "sideways", "turn")
    return Steer(Drive(*(_read_number(message, name, -FASTEST, FASTEST) if name in message else 0.0 for name in names)))


def _read_pull(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    node = message.get("node")
    if not isinstance(node, int) or isinstance(node, bool) or not 0 <= node < node_count:
        raise ValueError(f"node: give a whole number from 0 to {node_count - 1}")
    x, y, z = (_read_number(message, name, -reach, reach) for name in "xyz")
    return Pull(node, (x, y, z))


def _read_push(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    x, y, z = (_read_number(message, name, -MAX_IMPULSE, MAX_IMPULSE) for name in "xyz")
    if math.hypot(x, y, z) > MAX_IMPULSE:
        raise ValueError(f"push: give at most {MAX_IMPULSE:g} m sqrt(g H)")
    return PushOnce((x, y, z), _read_number(message, "height", 0.0, 1.0) if "height" in message else None)


def _read_change(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    given = [name for name in ("friction", "sag") if name in message]
    if not given:
        raise ValueError("set: give friction or sag")
    spans = {"friction": (0.0, MAX_FRICTION), "sag": (MIN_SAG, MAX_SAG)}
    return Change(**{name: _read_number(message, name, *spans[name]) for name in given})


def _read_style(message: Mapping[str, Any], reach: float, node_count: int) -> Message:
    return Restyle(Style(**{name: _read_number(message, name, LEAST, MOST) for name in STYLE_NAMES if name in message}))


def _read_on(message: Mapping[str, Any]) -> bool:
    on = message.get("on")
    if not isinstance(on, bool):
        raise ValueError("on: give true or false")
    return on


def _read_number(message: Mapping[str, Any], name: str, minimum: float, maximum: float) -> float:
    value = message.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: give a number")
    if not minimum <= value <= maximum or not math.isfinite(value):
        raise ValueError(f"{name}: give a number from {minimum:g} to {maximum:g}")
    return float(value)


_Reader: TypeAlias = Callable[[Mapping[str, Any], float, int], Message]
_READERS: dict[str, tuple[tuple[str, ...], _Reader]] = {
    "motion": (("text",), _read_script),
    "go": (("x", "y"), _read_go),
    "drive": (("forward", "sideways", "turn"), _read_steer),
    "pull": (("node", "x", "y", "z"), _read_pull),
    "release": ((), lambda *_: Release()),
    "push": (("x", "y", "z", "height"), _read_push),
    "set": (("friction", "sag"), _read_change),
    "style": (STYLE_NAMES, _read_style),
    "pause": (("on",), lambda message, *_: Pause(_read_on(message))),
    "step": ((), lambda *_: Step()),
    "cancel": ((), lambda *_: Cancel()),
    "stand": ((), lambda *_: StandUp()),
    "record": (("on",), lambda message, *_: Record(_read_on(message))),
    "script": ((), lambda *_: RequestScript()),
}
