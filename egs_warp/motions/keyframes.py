"""Key frames from JSON or CSV files: target values over time for parts of the body.

See docs/concepts/motions.md.

JSON: a list of keys, ``[{"time": 0.5, "part": "head", "quantity": "position", "value": [0.1, 0, 0]}]``. CSV: a header
``time,part,quantity,x,y,z`` and one key per row. Keys in both formats may have a ``weight``.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from egs_warp.checked_calls import Finite, Range, checked_constructor
from egs_warp.errors import UserError, did_you_mean
from egs_warp.io.text import json_excerpt, parse_json, read_text
from egs_warp.short_repr import short_repr


class Quantity(Enum):
    """Quantity that a key sets. Its components are forward, left and up relative to the body at the start."""

    POSITION = "position"
    """Displacement from the start, body heights."""
    VELOCITY = "velocity"
    """Velocity, body heights per second."""
    ORIENTATION = "orientation"
    """Rotation vector relative to the start, degrees. Full turns are distinguished: 270 differs from -90."""
    ANGULAR_MOMENTUM = "angular_momentum"
    """Angular momentum about the centre of the part, body mass times body height squared per second."""


PARTS = ("body", "base", "head", "foot")
"""Parts to which a key may refer: the whole body, whose position is its centre of mass; the base on the ground; the
head at the top; and the foot of a body with one foot. Several feet and branches are numbered, as in ``foot 2``."""
_NUMBERED_PART = re.compile(r"(?:foot|branch) [1-9]\d?")
MAX_TIME = 60.0
"""Maximum time of a key, s."""
MAX_WEIGHT = 1000.0
"""Maximum weight of a key."""
MIN_GAP = 0.001
"""Minimum time in seconds between two keys of a channel, and before its first key."""
MAX_LENGTH: Mapping[Quantity, float] = {
    Quantity.POSITION: 10.0,
    Quantity.VELOCITY: 20.0,
    Quantity.ORIENTATION: 360.0,
    Quantity.ANGULAR_MOMENTUM: 10.0,
}
"""Maximum length of a value, in the unit of its quantity; larger values are rejected as typing errors."""
_FIELDS = ("time", "part", "quantity", "value", "weight")


@checked_constructor
@dataclass(frozen=True)
class Key:
    """One key frame."""

    __repr__ = short_repr

    time: Annotated[float, Range(0.0, MAX_TIME, "seconds", above=True)]
    """Time from the start of the motion, s."""
    part: str
    quantity: Quantity
    value: tuple[Finite, Finite, Finite]
    weight: Annotated[float, Range(0.0, MAX_WEIGHT, above=True)] = 1.0
    """Factor on the weight of the motion, in the interval that ends at this key."""
    where: str = ""
    """File that contains the key, and position of the key in the file, for messages."""

    def __post_init__(self) -> None:
        where = self.where or "Key"
        if self.part not in PARTS and not _NUMBERED_PART.fullmatch(self.part):
            raise UserError(
                f"{where}: part {self.part!r} is unknown{did_you_mean(self.part, PARTS)}; give one of"
                f" {', '.join(PARTS)}, or a numbered part: foot 1, foot 2, ... if there are several feet, or branch 1,"
                " branch 2, ..."
            )
        length, max_length = math.hypot(*self.value), MAX_LENGTH[self.quantity]
        if length > max_length:
            value = ", ".join(f"{x:g}" for x in self.value)
            raise UserError(f"{where}: value [{value}] has the length {length:g}; at most {max_length:g} is allowed")


@dataclass(frozen=True)
class Channel:
    """All keys of one part and quantity, interpolated by a monotone cubic spline that starts at zero at time 0. After
    the last key, the value is constant."""

    __repr__ = short_repr

    part: str
    quantity: Quantity
    times: np.ndarray
    """(k+1,) s, starting with 0."""
    values: np.ndarray
    """(k+1, 3) values in the unit of the quantity, starting with zero."""
    weights: np.ndarray
    """(k,) weights of the keys."""

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the value (3,) and its rate (3,) per second at ``time`` s."""
        inside = min(time, float(self.times[-1]))
        curve = PchipInterpolator(self.times, self.values, axis=0)
        return curve(inside), curve(inside, 1) * (time < self.times[-1])

    def second_rate(self, time: float) -> np.ndarray:
        """Return the second derivative (3,) per square second at ``time`` s; zero after the last key."""
        if time >= self.times[-1]:
            return np.zeros(3)
        return PchipInterpolator(self.times, self.values, axis=0)(time, 2)

    def weight_at(self, time: float) -> float:
        """Return the weight of the first key after ``time`` s; after the last key, the weight of that key."""
        return float(self.weights[min(np.searchsorted(self.times[1:], time), len(self.weights) - 1)])


def read_keyframes(path: Path) -> tuple[Key, ...]:
    """Read the keys of a ``.json`` or ``.csv`` file.

    Raises:
        UserError: for the first malformed key, with its position.
    """
    path = Path(path)
    if path.suffix.lower() not in (".json", ".csv"):
        raise UserError(f"{path}: key frames are read from .json or .csv; give one of these")
    text = read_text(path)
    keys = _from_json(text, path) if path.suffix.lower() == ".json" else _from_csv(text, path)
    if not keys:
        raise UserError(f"{path}: it has no key frames; give at least one")
    channels(keys)
    return tuple(keys)


def checked_keys(keys: Sequence[Key]) -> tuple[Key, ...]:
    """Return ``keys`` after the same checks as for the keys of a file.

    Raises:
        UserError: for the first malformed key, by its number.
    """
    if not keys:
        raise UserError("keys: the list is empty; give at least one key frame")
    checked = []
    for number, key in enumerate(keys, start=1):
        quantity = key.quantity.value if isinstance(key.quantity, Quantity) else key.quantity
        entry = {"time": key.time, "part": key.part, "quantity": quantity, "value": list(key.value)}
        checked.append(_key({**entry, "weight": key.weight}, f"key {number}"))
    channels(checked)
    return tuple(checked)


def channels(keys: Sequence[Key]) -> tuple[Channel, ...]:
    """Group keys by part and quantity.

    Raises:
        UserError: if times of a channel do not increase by at least ``MIN_GAP``.
    """
    groups: dict[tuple[str, Quantity], list[Key]] = {}
    for key in keys:
        group = groups.setdefault((key.part, key.quantity), [])
        before, what = (group[-1].time, "the previous key") if group else (0.0, "the start")
        if round(key.time - before, 9) < MIN_GAP:
            raise UserError(
                f"{key.where} ({key.part} {key.quantity.value}): time {key.time:g} s is less than {MIN_GAP:g} s after"
                f" {what} at {before:g} s; sort the keys by time and leave at least {MIN_GAP:g} s between them"
            )
        group.append(key)
    return tuple(
        Channel(
            part,
            quantity,
            np.array([0.0, *(key.time for key in group)]),
            np.array([(0.0, 0.0, 0.0), *(key.value for key in group)]),
            np.array([key.weight for key in group]),
        )
        for (part, quantity), group in groups.items()
    )


def _from_json(text: str, path: Path) -> list[Key]:
    entries = parse_json(text, path)
    if not isinstance(entries, list):
        found = json_excerpt(entries)
        raise UserError(
            f"{path}: it contains {found}; give a list of keys, each an object with {', '.join(_FIELDS[:4])}"
        )
    keys = []
    for number, entry in enumerate(entries, start=1):
        where = f"{path}, key {number}"
        if not isinstance(entry, dict):
            raise UserError(f"{where} is {json_excerpt(entry)}; give an object with {', '.join(_FIELDS[:4])}")
        keys.append(_key(entry, where))
    return keys


def _from_csv(text: str, path: Path) -> list[Key]:
    try:
        rows = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise UserError(f"{path}: not CSV ({error}); correct the file") from None
    if not rows:
        return []
    header = [name.strip().lower() for name in rows[0]]
    needed = ["time", "part", "quantity", "x", "y", "z"]
    if sorted(set(header) - {"weight"}) != sorted(needed) or len(set(header)) != len(header):
        raise UserError(
            f"{path}, line 1: the columns are {','.join(header)}; give {','.join(needed)} and optionally weight"
        )
    keys = []
    for line, row in enumerate(rows[1:], start=2):
        where = f"{path}, line {line}"
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise UserError(f"{where}: {len(row)} values for {len(header)} columns; give one for each column")
        cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
        entry: dict[str, Any] = {"part": cells["part"], "quantity": cells["quantity"]}
        entry["time"] = _parse_cell(cells["time"])
        entry["value"] = [_parse_cell(cells[axis]) for axis in "xyz"]
        if cells.get("weight"):
            entry["weight"] = _parse_cell(cells["weight"])
        keys.append(_key(entry, where))
    return keys


def _parse_cell(cell: str) -> float | str:
    try:
        return float(cell)
    except ValueError:
        return cell


def _key(entry: Mapping[str, Any], where: str) -> Key:
    for name in _FIELDS[:4]:
        if name not in entry:
            raise UserError(f'{where}: "{name}" is missing; a key has {", ".join(_FIELDS[:4])}')
    for name in entry:
        if name not in _FIELDS:
            raise UserError(
                f'{where}: "{name}" is unknown{did_you_mean(name, _FIELDS)}; a key has {", ".join(_FIELDS)}'
            )
    part, quantity, value = entry["part"], entry["quantity"], entry["value"]
    if not isinstance(part, str):
        raise UserError(f"{where}: part {part!r} is unknown; give one of {', '.join(PARTS)}")
    names = [member.value for member in Quantity]
    if quantity not in names:
        near = did_you_mean(quantity, names)
        raise UserError(f"{where}: quantity {quantity!r} is unknown{near}; give one of {', '.join(names)}")
    time = _number(entry["time"])
    if not 0.0 < time <= MAX_TIME:
        raise UserError(f"{where}: time {entry['time']!r}: give seconds above 0, at most {MAX_TIME:g}")
    if not isinstance(value, list) or len(value) != 3 or not all(math.isfinite(_number(item)) for item in value):
        raise UserError(f"{where}: value {value!r}: give three numbers: forward, left, up")
    weight = _number(entry.get("weight", 1.0))
    if not 0.0 < weight <= MAX_WEIGHT:
        raise UserError(f"{where}: weight {entry['weight']!r}: give a number above 0, at most {MAX_WEIGHT:g}")
    return Key(time, part, Quantity(quantity), (float(value[0]), float(value[1]), float(value[2])), weight, where)


def _number(value: Any) -> float:
    """Return the value as a number; NaN if it is not a number."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
