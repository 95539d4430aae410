"""What a user asks for: one motion or several in a row, as a line of text or a JSON file.

A line names motions, separated by commas, each with its numbers in their order, or by name, and ``xN`` for N times:
``hop x3, twist 180, walk 2``, ``jump 0.5 height=0.3``. A JSON file holds a list of objects:
``[{"motion": "hop", "repeat": 3}, {"motion": "twist", "heading_degrees": 180}]``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.io.text import parse_json, read_text, whole_number

LARGEST_TARGET = 10.0
"""Body heights; a larger target is refused as a slip of the pen."""
LARGEST_TURN = 720.0
"""Degrees."""
MOST_MOTIONS = 100


@dataclass(frozen=True)
class Value:
    """One number that a motion takes."""

    name: str
    default: float
    least: float
    most: float
    unit: str
    whole: bool = False
    above: bool = False
    """Whether ``least`` itself is too little."""


def _length(name: str, default: float, *, above: bool = False) -> Value:
    return Value(name, default, 0.0, LARGEST_TARGET, "body heights", above=above)


VALUES: Mapping[str, tuple[Value, ...]] = {
    "jump": (_length("distance", 0.5), _length("height", 0.2, above=True)),
    "hop": (_length("distance", 0.7, above=True), _length("height", 0.3, above=True)),
    "twist": (
        Value("heading_degrees", 180.0, -LARGEST_TURN, LARGEST_TURN, "degrees"),
        _length("distance", 0.0),
        _length("height", 0.3, above=True),
    ),
    "walk": (Value("steps", 4, 1, 50, "steps", whole=True), _length("step_length", 0.1, above=True)),
    "trajectory": (),
}
"""What each motion takes, in the order in which bare numbers are read."""
MOTIONS = tuple(VALUES)


@dataclass(frozen=True)
class MotionRequest:
    """One motion of a script, with every value known."""

    name: str
    asked: dict[str, float]
    """Values by name, lengths in body heights, as reports give them."""
    repeat: int = 1
    file: Path | None = None
    """Key frames of a trajectory."""


def parse_script(text: str, *, defaults: Mapping[str, float | None] | None = None) -> tuple[MotionRequest, ...]:
    """Read a line of motions, or the JSON file that it names.

    ``defaults``: values (a command's flags) for motions that take them and do not say them. Raises ``UserError``.
    """
    given = {name: value for name, value in (defaults or {}).items() if value is not None}
    if text.strip().lower().endswith(".json") and "," not in text and len(text.split()) == 1:
        requests = _from_json(Path(text.strip()), given)
    else:
        pieces = [piece.strip() for piece in text.split(",")]
        requests = [
            _from_words(piece, given, f"--motion, motion {number}") for number, piece in enumerate(pieces, start=1)
        ]
    count = sum(request.repeat for request in requests)
    if count > MOST_MOTIONS:
        raise UserError(f"--motion asks for {count} motions; at most {MOST_MOTIONS} are done in a row")
    for name in given:
        if not any(name in request.asked for request in requests):
            flag = name.replace("_", "-")
            raise UserError(f"--{flag}: no motion of {text.strip()!r} takes it")
    return tuple(requests)


def _from_words(piece: str, defaults: Mapping[str, float], where: str) -> MotionRequest:
    words = piece.split()
    if not words:
        raise UserError(f"{where}: nothing between two commas; name a motion: {', '.join(MOTIONS)}")
    name, repeat, values, file = words[0].lower(), None, {}, None
    known = _values_of(name, where)
    order = [value.name for value in known]
    for word in words[1:]:
        if re.fullmatch(r"[xX]\d+", word):
            if repeat is not None:
                raise UserError(f"{where} ({piece!r}): {word!r} is a second number of repeats; give one")
            repeat = whole_number(word[1:])
        elif "=" in word:
            key, _, number = word.partition("=")
            if key in values:
                raise UserError(f"{where} ({piece!r}): {key} is given twice; give it once")
            values[key] = number
        elif name == "trajectory" and file is None:
            file = Path(word)
        else:
            free = [key for key in order if key not in values]
            if not free:
                raise UserError(f"{where} ({piece!r}): {word!r} is one value too many; {_takes(name)}")
            values[free[0]] = word
    return _request(name, values, 1 if repeat is None else repeat, file, defaults, f"{where} ({piece!r})")


def _from_json(path: Path, defaults: Mapping[str, float]) -> list[MotionRequest]:
    entries = parse_json(read_text(path), path)
    if not isinstance(entries, list) or not entries:
        raise UserError(f'{path}: give a list of motions, as [{{"motion": "jump"}}]')
    requests = []
    for number, entry in enumerate(entries, start=1):
        where = f"{path}, motion {number}"
        if not isinstance(entry, dict) or not isinstance(entry.get("motion"), str):
            raise UserError(f'{where}: give an object with a "motion", one of {", ".join(MOTIONS)}')
        values = dict(entry)
        name = values.pop("motion")
        repeat = values.pop("repeat", 1)
        file = values.pop("file", None)
        if not isinstance(repeat, int) or isinstance(repeat, bool):
            raise UserError(f'{where}: "repeat" is {repeat!r}; give a whole number')
        if file is not None and not isinstance(file, str):
            raise UserError(f'{where}: "file" is {file!r}; give the name of a file')
        for key, value in values.items():
            if isinstance(value, str):
                raise UserError(f'{where}: "{key}" is the text {json.dumps(value)}; give a number without quotes')
        keyframes = path.parent / file if file is not None else None
        requests.append(_request(name, values, repeat, keyframes, defaults, where))
    return requests


def _values_of(name: str, where: str) -> tuple[Value, ...]:
    if name not in VALUES:
        raise UserError(f"{where}: unknown motion {name!r}; known motions are: {', '.join(MOTIONS)}")
    return VALUES[name]


def _takes(name: str) -> str:
    names = ", ".join(value.name for value in VALUES[name])
    return f"{name} takes {names}" if names else f"{name} takes a file"


def _request(
    name: str, values: Mapping[str, Any], repeat: float, file: Path | None, defaults: Mapping[str, float], where: str
) -> MotionRequest:
    known = {value.name: value for value in _values_of(name, where)}
    for key in values:
        if key not in known:
            raise UserError(f"{where}: {key!r} is unknown; {_takes(name)}")
    if not 1 <= repeat <= MOST_MOTIONS:
        raise UserError(f"{where}: repeat {repeat}; give a whole number from 1 to {MOST_MOTIONS}")
    if (file is None) == (name == "trajectory"):
        say = "trajectory needs a file of key frames, as trajectory keys.json" if file is None else _takes(name)
        raise UserError(f"{where}: {say}")
    asked = {
        key: _number(values.get(key, defaults.get(key, value.default)), value, where) for key, value in known.items()
    }
    return MotionRequest(name, asked, int(repeat), file)


def _number(given: Any, value: Value, where: str) -> float:
    kind = "a whole number" if value.whole else "a number"
    span = (
        f"{kind} of {value.unit} {'above' if value.above else 'from'} {value.least:g} {'up ' if value.above else ''}to "
    )
    try:
        if isinstance(given, bool):
            raise TypeError
        number = float(given)
    except (TypeError, ValueError):
        number = math.nan
    fits = value.least <= number <= value.most and not (value.above and number == value.least)
    if not fits or (value.whole and number != int(number)):
        raise UserError(f"{where}: {value.name} {given}: give {span}{value.most:g}")
    return number
