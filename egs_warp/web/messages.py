"""Messages from the page to a live session: JSON objects that are validated and converted to records.

Each message has a ``type``; docs/guide/live.md lists all types.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

from egs_warp.motions.command import MAX_SPEED, Drive
from egs_warp.motions.push import MAX_IMPULSE
from egs_warp.motions.script import Script, motion
from egs_warp.motions.style import MAX_FACTOR, MIN_FACTOR, Style

MAX_TEXT_LENGTH = 200
"""Maximum number of characters of the motions in one message."""
MAX_DISTANCE = 100.0
"""Maximum distance of goals and pull targets from the start, body heights."""
MIN_SAG, MAX_SAG = 0.01, 0.1
"""Limits of the sag rho g H / E of a column: the stiffest and the softest body."""
MAX_FRICTION = 2.0
"""Maximum Coulomb coefficient."""
STYLE_NAMES = tuple(field.name for field in fields(Style) if field.name != "overlap")
"""Names of the style factors that can be set; the overlap of the body does not change during a session."""
_MOTIONS = re.compile(r"[A-Za-z0-9_=+\-., ]+")
"""Pattern of the text of motions: its allowed characters."""


@dataclass(frozen=True)
class PlayScript:
    """Perform the given motions next; they replace the queued motions."""

    script: Script
    """The motions to perform."""


@dataclass(frozen=True)
class GoTo:
    """Go to a point on the ground; this replaces the queued motions."""

    point: tuple[float, float]
    """(x, y) m, frame of the body."""


@dataclass(frozen=True)
class Steer:
    """Move at the given speeds until the next command; this replaces the queued motions. Zero speeds stop the body."""

    command: Drive
    """Requested speeds of the body."""


@dataclass(frozen=True)
class Pull:
    """Pull a node with a spring until a ``Release``."""

    node: int
    """Index of the cage node."""
    target: tuple[float, float, float]
    """(x, y, z) m, frame of the body: point to which the spring pulls the node."""


@dataclass(frozen=True)
class Release:
    """Release the pull."""


@dataclass(frozen=True)
class PushOnce:
    """Push the body in the next step."""

    impulse: tuple[float, float, float]
    """(x, y, z) impulse, in units of body mass x sqrt(g H), frame of the body."""
    height: float | None = None
    """Height around which the push acts, in body heights above the standing body's sole; None pushes all nodes
    equally."""


@dataclass(frozen=True)
class Change:
    """Change friction or stiffness; None leaves a property unchanged."""

    friction: float | None = None
    """Coulomb coefficient."""
    sag: float | None = None
    """Sag rho g H / E of a column."""


@dataclass(frozen=True)
class Restyle:
    """Set the style of all later jumps."""

    style: Style
    """Factors of the style's parameters."""


@dataclass(frozen=True)
class Pause:
    """Pause or continue the simulation."""

    on: bool
    """True to pause, False to continue."""


@dataclass(frozen=True)
class Step:
    """Compute one solver step while the simulation is paused."""


@dataclass(frozen=True)
class Cancel:
    """Cancel the queued motions; the active motion is completed."""


@dataclass(frozen=True)
class StandUp:
    """Put the body back to its upright start."""


@dataclass(frozen=True)
class Record:
    """Start a take, or end a take and write it."""

    on: bool
    """True to start, False to end."""


@dataclass(frozen=True)
class RequestScript:
    """Request the script of the motions so far."""


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
"""Any validated message."""


def read_message(message: Mapping[str, Any], *, height: float, node_count: int) -> Message:
    """Validate a JSON object and return its record.

    Args:
        message: the object.
        height: height of the body, m.
        node_count: number of cage nodes.

    Raises:
        ValueError: for an unknown type or field, and for values that are missing or out of range.
    """
    kind = message.get("type")
    if not isinstance(kind, str) or kind not in _READERS:
        raise ValueError(f"type {str(kind)[:40]!r} is unknown; known types are {', '.join(_READERS)}")
    fields, read = _READERS[kind]
    unknown = [name for name in message if name != "type" and name not in fields]
    if unknown:
        raise ValueError(f"{kind} has no field {unknown[0][:40]!r}")
    return read(message, MAX_DISTANCE * height, node_count)


def _read_script(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    text = message.get("text")
    if not isinstance(text, str) or len(text) > MAX_TEXT_LENGTH:
        raise ValueError(f"text: give motions in at most {MAX_TEXT_LENGTH} characters, such as jump 0.5 0.2")
    # Only motions without files are allowed: scripts and key frames would be files on this machine, which a page must
    # not read.
    if not _MOTIONS.fullmatch(text) or re.search(r"\.(json|csv)", text, re.IGNORECASE):
        raise ValueError("text: give motions by name and number, such as hop x3, twist 90")
    script = motion(text)
    if any(request.file is not None for request in script.requests):
        raise ValueError("text: motions that need a file are not available here; use egs-warp animate")
    return PlayScript(script)


def _read_go(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    return GoTo(
        (
            _read_number(message, "x", -max_distance, max_distance),
            _read_number(message, "y", -max_distance, max_distance),
        )
    )


def _read_steer(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    names = ("forward", "sideways", "turn")
    return Steer(
        Drive(*(_read_number(message, name, -MAX_SPEED, MAX_SPEED) if name in message else 0.0 for name in names))
    )


def _read_pull(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    node = message.get("node")
    if not isinstance(node, int) or isinstance(node, bool) or not 0 <= node < node_count:
        raise ValueError(f"node: give a whole number from 0 to {node_count - 1}")
    x, y, z = (_read_number(message, name, -max_distance, max_distance) for name in "xyz")
    return Pull(node, (x, y, z))


def _read_push(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    x, y, z = (_read_number(message, name, -MAX_IMPULSE, MAX_IMPULSE) for name in "xyz")
    if math.hypot(x, y, z) > MAX_IMPULSE:
        raise ValueError(f"push: give at most {MAX_IMPULSE:g} m sqrt(g H)")
    return PushOnce((x, y, z), _read_number(message, "height", 0.0, 1.0) if "height" in message else None)


def _read_change(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    names = [name for name in ("friction", "sag") if name in message]
    if not names:
        raise ValueError("set: give friction or sag")
    spans = {"friction": (0.0, MAX_FRICTION), "sag": (MIN_SAG, MAX_SAG)}
    return Change(**{name: _read_number(message, name, *spans[name]) for name in names})


def _read_style(message: Mapping[str, Any], max_distance: float, node_count: int) -> Message:
    return Restyle(
        Style(**{name: _read_number(message, name, MIN_FACTOR, MAX_FACTOR) for name in STYLE_NAMES if name in message})
    )


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
"""Function that converts one type of message; it also receives the maximum distance, m, and the number of nodes."""
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
"""Allowed fields and reader of each ``type``."""
