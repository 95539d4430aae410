"""Messages from the page of ``egs-warp pick``: JSON objects that are validated and converted to records.

Each message has a ``type``; docs/guide/pick.md lists all types. Lengths are in the frame of the page.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.plane import Plane
from egs_warp.io.picked import MAX_NAME_LENGTH
from egs_warp.web.messages import read_message

MAX_STROKE_PIXELS = 24
"""Maximum number of points of a stroke."""
MAX_OBJECTS = 20
"""Maximum number of objects."""
_MAX_LENGTH = 1e4
"""Maximum absolute value of a coordinate."""
_MAX_SIDE = 8192
"""Maximum side of the page's picture, pixels."""


@dataclass(frozen=True)
class Mark:
    """A click or a stroke on the object, or beside it."""

    inside: bool
    """True to add, False to remove."""
    camera: Camera
    """Camera of the page."""
    pixels: tuple[tuple[float, float], ...]
    """Positions in the camera's picture, in pixels from its top left corner; at least one."""


@dataclass(frozen=True)
class MovePlane:
    """Move the ground of the active object to a plane."""

    plane: Plane


@dataclass(frozen=True)
class TurnFront:
    """Set the front of the active object."""

    direction: np.ndarray
    """(3,) unit vector of the front."""


@dataclass(frozen=True)
class AddObject:
    """Start another object."""


@dataclass(frozen=True)
class SelectObject:
    """Make another object the active one."""

    index: int


@dataclass(frozen=True)
class RemoveObject:
    """Remove the active object."""


@dataclass(frozen=True)
class RenameObject:
    """Rename the active object."""

    name: str


@dataclass(frozen=True)
class Undo:
    """Undo the last change, or redo it."""

    redo: bool = False


@dataclass(frozen=True)
class Save:
    """Write the file of the picked objects."""


@dataclass(frozen=True)
class RunAnimate:
    """Write the file of the picked objects, and make a film of the active one."""

    motion: str


@dataclass(frozen=True)
class RunLive:
    """Write the file of the picked objects, and simulate the active one live."""


PickMessage: TypeAlias = (
    Mark
    | MovePlane
    | TurnFront
    | AddObject
    | SelectObject
    | RemoveObject
    | RenameObject
    | Undo
    | Save
    | RunAnimate
    | RunLive
)
"""Any validated message."""


def read_pick_message(message: Mapping[str, Any]) -> PickMessage:
    """Validate a JSON object and return its record.

    Raises ``ValueError`` for an unknown type or field, and for values that are missing or out of range.
    """
    kind = message.get("type")
    if not isinstance(kind, str) or kind not in _READERS:
        raise ValueError(f"type {str(kind)[:40]!r} is unknown; known types are {', '.join(_READERS)}")
    fields, read = _READERS[kind]
    unknown = [name for name in message if name != "type" and name not in fields]
    if unknown:
        raise ValueError(f"{kind} has no field {unknown[0][:40]!r}")
    return read(message)


def _read_mark(message: Mapping[str, Any]) -> Mark:
    inside = message.get("inside")
    if not isinstance(inside, bool):
        raise ValueError("inside: give true or false")
    eye, target = (_read_vector(message, name) for name in ("eye", "target"))
    width, height = (round(_read_number(message, name, 1.0, _MAX_SIDE)) for name in ("width", "height"))
    fov = _read_number(message, "fov", 1.0, 170.0)
    up = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(target - eye, up)) < 1e-6 * max(float(np.linalg.norm(target - eye)), 1e-6):
        raise ValueError("target: give a point that is not straight above or below the eye")
    pixels = message.get("pixels")
    if not isinstance(pixels, list) or not 0 < len(pixels) <= MAX_STROKE_PIXELS:
        raise ValueError(f"pixels: give 1 to {MAX_STROKE_PIXELS} pairs of numbers")
    places = []
    for pair in pixels:
        if not isinstance(pair, list) or len(pair) != 2:
            raise ValueError("pixels: give pairs of numbers")
        u, v = (_checked(value, "pixels", -1.0, _MAX_SIDE) for value in pair)
        places.append((min(max(u, 0.0), width - 1e-3), min(max(v, 0.0), height - 1e-3)))
    near = 1e-3 * float(np.linalg.norm(target - eye))
    camera = Camera.look_at(eye, target, up, width=width, height=height, vertical_fov_degrees=fov, near=near)
    return Mark(inside, camera, tuple(places))


def _read_plane(message: Mapping[str, Any]) -> MovePlane:
    normal = _read_vector(message, "normal")
    offset = _read_number(message, "offset", -_MAX_LENGTH, _MAX_LENGTH)
    try:
        return MovePlane(Plane.from_coefficients(normal[0], normal[1], normal[2], offset))
    except UserError:
        raise ValueError("normal: give three numbers, not all zero") from None


def _read_front(message: Mapping[str, Any]) -> TurnFront:
    direction = _read_vector(message, "direction")
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        raise ValueError("direction: give three numbers, not all zero")
    return TurnFront(direction / length)


def _read_select(message: Mapping[str, Any]) -> SelectObject:
    return SelectObject(round(_read_number(message, "index", 0.0, MAX_OBJECTS - 1.0)))


def _read_name(message: Mapping[str, Any]) -> RenameObject:
    name = message.get("name")
    if not isinstance(name, str) or not 0 < len(name.strip()) <= MAX_NAME_LENGTH or not name.isprintable():
        raise ValueError(f"name: give 1 to {MAX_NAME_LENGTH} printable characters")
    return RenameObject(name.strip())


def _read_animate(message: Mapping[str, Any]) -> RunAnimate:
    # Motions have the same limits as in a live session, because a page must not name files of this machine.
    read_message({"type": "motion", "text": message.get("motion")}, height=1.0, node_count=1)
    return RunAnimate(str(message["motion"]))


def _read_vector(message: Mapping[str, Any], name: str) -> np.ndarray:
    values = message.get(name)
    if not isinstance(values, list) or len(values) != 3:
        raise ValueError(f"{name}: give three numbers")
    return np.array([_checked(value, name, -_MAX_LENGTH, _MAX_LENGTH) for value in values])


def _read_number(message: Mapping[str, Any], name: str, minimum: float, maximum: float) -> float:
    return _checked(message.get(name), name, minimum, maximum)


def _checked(value: Any, name: str, minimum: float, maximum: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: give a number")
    if not minimum <= value <= maximum or not math.isfinite(value):
        raise ValueError(f"{name}: give a number from {minimum:g} to {maximum:g}")
    return float(value)


_READERS: dict[str, tuple[tuple[str, ...], Callable[[Mapping[str, Any]], PickMessage]]] = {
    "mark": (("inside", "eye", "target", "fov", "width", "height", "pixels"), _read_mark),
    "plane": (("normal", "offset"), _read_plane),
    "front": (("direction",), _read_front),
    "add": ((), lambda message: AddObject()),
    "select": (("index",), _read_select),
    "remove": ((), lambda message: RemoveObject()),
    "rename": (("name",), _read_name),
    "undo": ((), lambda message: Undo()),
    "redo": ((), lambda message: Undo(redo=True)),
    "save": ((), lambda message: Save()),
    "animate": (("motion",), _read_animate),
    "live": ((), lambda message: RunLive()),
}
"""Allowed fields and reader of each ``type``."""
