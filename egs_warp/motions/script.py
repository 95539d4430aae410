"""Scripts of one or several motions, from a line of text or a JSON file.

A line lists motions, separated by commas. Each motion has its numbers in order or by name, and ``xN`` for N repeats:
``hop x3, twist 180, walk 2``, ``jump 0.5 height=0.3``, ``walk to 1,0.5``. ``+`` adds a gesture on top of a motion, and
``at`` is the time in seconds from the start of the motion to the gesture: ``walk 1 + wave at=0.5``. A JSON file
contains a list of objects: ``[{"motion": "hop", "repeat": 3}, {"motion": "twist", "heading_degrees": 180}]``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.io.text import json_excerpt, parse_json, read_text, whole_number
from egs_warp.motions.beats import parse_beats
from egs_warp.motions.command import Drive, DrivePlan
from egs_warp.motions.keyframes import Key, checked_keys
from egs_warp.motions.names import (
    NAME_LIST,
    check_name,
    gestures_of,
    is_script_file,
    leading_name,
    numbered_pieces,
)
from egs_warp.motions.repertoire import (
    MOTIONS,
    MotionKind,
    frames_of_request,
    kind_of_request,
    tasks_of_request,
)
from egs_warp.motions.request import LayerRequest, MotionRequest
from egs_warp.motions.sequence import BodyMotion, MotionTask, Stance, TargetError
from egs_warp.motions.style import Style, read_style
from egs_warp.motions.values import Value

MotionFactory: TypeAlias = "Callable[[Stance], BodyMotion]"
"""Function that creates a motion from the stance of a body."""
MAX_MOTIONS = 100
_MAX_SECONDS = 3600.0
"""Largest time limit of a motion of the user's own class, s."""
_JUMPS = tuple(name for name, kind in MOTIONS.items() if kind.jumps)
_GESTURES = tuple(name for name, kind in MOTIONS.items() if kind.gesture is not None)
_CONJUNCTIONS = ("and", "then", "while", "with", "&")
"""Words between two motions that stand for a separator, in lower case."""
_SEPARATORS = "separate motions by commas, and add a gesture on top of a motion by +, as in 'jump, walk 1 + nod'"
_AT = Value("at", 0.0, 0.0, 60.0, "seconds")
"""Parameter of a gesture on top of a motion: its start, in seconds after the start of the motion."""
_BEATS_FILE = "file of beats"
"""Key under which the default values of a script contain the path of the file of beats."""


@dataclass(frozen=True)
class Script:
    """Sequence of motions; the operator ``+`` appends another sequence."""

    requests: tuple[MotionRequest, ...]

    def __repr__(self) -> str:
        return f"Script({', '.join(map(str, self.requests))})"

    def __add__(self, other: Script) -> Script:
        if not isinstance(other, Script):
            raise UserError(f"motion + {other!r}: give another motion, such as egs.motion('nod')")
        return Script((*self.requests, *other.requests))

    @property
    def name(self) -> str:
        """Common name of the motions, or "motions" if their names differ."""
        names = {request.name for request in self.requests}
        return names.pop() if len(names) == 1 else "motions"

    @property
    def file_stem(self) -> str:
        """Name of files that are named after the script, without the ending and without spaces."""
        return self.name.replace(" ", "-")

    def frames(self, height: float = 1.0) -> int:
        """Return the number of frames at 60 Hz after which the script is cut off. Durations scale with the square root
        of the body ``height``, in metres.

        Raises:
            UserError: for an invalid file.
        """
        frames = sum(request.repeat * frames_of_request(request) for request in self.requests)
        return round(frames * max(1.0, height**0.5))

    def style(self, text: str | None) -> Style:
        """Return the style of the script's jumps from ``text`` (``read_style``); None uses the default style.

        Raises:
            UserError: for an invalid text, and if no motion jumps.
        """
        style = None if text is None else read_style(text)
        check_style(style, [self])
        return style or Style()

    def parts(self, height: float) -> list[MotionTask]:
        """Return the tasks of all motions in order, for a body of ``height`` metres."""
        return [part for request in self.requests for part in tasks_of_request(request, height)]

    def retake(self, number: int) -> tuple[Script, str] | None:
        """Return the script for a retake after a fall in motion ``number``, counted from 0, and a description of the
        change for messages; None if the motion has no gentler form."""
        ends = np.cumsum([request.repeat for request in self.requests])
        index = int(np.searchsorted(ends, number, side="right"))
        request = self.requests[index]
        retakes = kind_of_request(request).retakes
        if request.retake == len(retakes):
            return None
        gentler = replace(request, retake=request.retake + 1)
        change = f"{request.name} {retakes[request.retake].change}"
        return Script((*self.requests[:index], gentler, *self.requests[index + 1 :])), change

    def check_shape(self, stance: Stance, style: Style | None = None) -> None:
        """Check that a body of this shape can perform the motions, before its weight deforms it: that it has the parts
        that move, and a base that the motions can use. Targets are not checked.

        Args:
            stance: stance of the captured shape.
            style: style of the jumps; None uses that of the stance.

        Raises:
            UserError: if the body cannot perform some of the motions; the message contains the reason for each of them.
        """
        stance = stance if style is None else replace(stance, style=style)
        errors: list[UserError] = []
        for request in self.requests:
            if request.begin is not None:
                continue
            try:
                tasks_of_request(request, stance.body.height)[0].begin(stance)
            except TargetError:
                pass
            except UserError as error:
                errors.append(error)
        reasons = list(dict.fromkeys(map(str, errors)))
        if len(reasons) > 1:
            raise UserError("; ".join(reasons)) from errors[0]
        if errors:
            raise errors[0]

    def check(self, stance: Stance) -> list[float]:
        """Return the expected duration in seconds of each motion, for a body that stands at ``stance``; 0 for a motion
        whose duration can only be computed from the stance at its start.

        Raises:
            UserError: if one of the motions cannot start. A target of a later motion that is out of reach from
                ``stance`` is no error, because the earlier motions move the body.
        """
        expected = []
        for number, part in enumerate(self.parts(stance.body.height)):
            try:
                expected.append(part.begin(stance).expected_time)
            except TargetError:
                if number == 0:
                    raise
                expected.append(0.0)
        return expected


def motion(text: str, *, beats: str | None = None, **values: float | None) -> Script:
    """Parse motions into a script.

    Args:
        text: one motion by name (``jump``, ``hop``, ``twist``, ``walk``, ``walk to``, ``turn`` ...), several as a line
            of text, or the path of a JSON file.
        beats: beats of dances without their own: a tempo such as ``90``, optionally followed by the time of the first
            beat in seconds, or the path of a file.
        values: default values by name, lengths in body heights, for motions that have this parameter and do not set it;
            None sets no default.

    Raises:
        UserError: for the first mistake.
    """
    if not text.strip():
        raise ArgumentError("motion", f"the text is empty; name a motion: {NAME_LIST}")
    defaults: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    if beats is not None:
        beats_default = parse_beats(beats)
        defaults |= {_BEATS_FILE: beats_default} if isinstance(beats_default, Path) else beats_default
    if is_script_file(text):
        requests = _from_json(Path(text.strip()), defaults)
    else:
        requests = [_from_piece(piece, defaults, where) for where, piece in numbered_pieces(text)]
    count = sum(request.repeat for request in requests)
    if count > MAX_MOTIONS:
        raise ArgumentError("motion", f"{count} motions are given; at most {MAX_MOTIONS} are allowed")
    if beats is not None and not any(MOTIONS[request.name].beats for request in requests):
        raise ArgumentError("beats", f"no motion of {text.strip()!r} takes beats; add a dance")
    for name in values.keys() & defaults.keys():
        if not any(name in request.asked for request in requests):
            kinds = {request.name: MOTIONS[request.name] for request in requests}
            known = {value.name for kind in kinds.values() for value in kind.parameters}
            usage = "; ".join(kind.usage(motion_name) for motion_name, kind in kinds.items())
            near = did_you_mean(name, sorted(known))
            raise ArgumentError(name, f"no motion of {text.strip()!r} takes this number{near}; {usage}")
    return Script(tuple(requests))


def drive_script(*steps: tuple[float, Drive]) -> Script:
    """Return a script of ``Drive`` commands. Each element of ``steps`` is a time in seconds from the start, and the
    command that is valid from then on; the last command must be zero.

    Raises:
        ArgumentError: for times that do not increase, and for a last command that is not zero.
    """
    plan = DrivePlan(tuple(time for time, _ in steps), tuple(command for _, command in steps))
    return Script((MotionRequest("drive", {}, drive=plan),))


def keyframe_script(*keys: Key) -> Script:
    """Return a script of one ``trajectory`` through ``keys``, in the order of their times.

    Raises:
        UserError: for the first malformed key; the message contains its number.
    """
    return Script((MotionRequest("trajectory", {}, keys=checked_keys(keys)),))


def own_script(name: str, begin: MotionFactory, *, seconds: float) -> Script:
    """Return a script of one motion of your own class.

    Args:
        name: name of the motion in reports and of the video file; it must differ from the names of built-in motions.
        begin: function that returns the motion of a body from its stance; the motion has the attributes of
            ``BodyMotion``.
        seconds: time limit for a body of 1 m, s; the motion is cut off after it.

    Raises:
        ArgumentError: for a name that exists or is unsuitable for a file, and for a time limit that is not positive or
            is too long.
    """
    if not re.fullmatch(r"[\w -]{1,60}", name) or name in MOTIONS:
        raise ArgumentError(
            "name",
            "give at most 60 letters, digits, spaces, hyphens and underscores, and not the name of a built-in motion",
            value=name,
        )
    if not 0.0 < seconds <= _MAX_SECONDS:
        raise ArgumentError("seconds", f"give a time above 0, at most {_MAX_SECONDS:g} s", value=seconds)
    return Script((MotionRequest(name, {}, begin=begin, seconds=seconds),))


def refusal(name: str, stance: Stance) -> str | None:
    """Return the reason why a body that stands at ``stance`` cannot perform the motion ``name`` with its default
    values; None if it can, or if the motion needs a file."""
    kind = MOTIONS[name]
    if kind.file is not None:
        return None
    try:
        Script((MotionRequest(name, {value.name: value.default for value in kind.parameters}),)).check(stance)
    except UserError as error:
        return str(error).removeprefix(f"{name}: ")
    return None


def check_style(style: Style | None, scripts: Sequence[Script]) -> None:
    """Raise ``ArgumentError`` for a style of a run in which no motion of the ``scripts`` jumps; None and the default
    style have no effect and are accepted."""
    if style in (None, Style()) or any(kind_of_request(one).jumps for script in scripts for one in script.requests):
        return
    names = " and ".join(dict.fromkeys(repr(script.name) for script in scripts)) or "the run"
    raise ArgumentError("style", f"no motion of {names} jumps; these have a style: {', '.join(_JUMPS)}")


def _from_piece(piece: str, defaults: Mapping[str, Any], where: str) -> MotionRequest:
    """Parse a motion with the gestures on top of it."""
    first, *others = gestures_of(piece)
    layers = []
    for text in others:
        words = text.split()
        if not words:
            raise UserError(f"{where} ({piece!r}): nothing after +; name a gesture: {', '.join(_GESTURES)}")
        starts = [word.partition("=")[2] for word in words if word.startswith("at=")]
        if len(starts) > 1:
            raise UserError(f"{where} ({piece!r}): at= is given twice; give it once")
        rest = " ".join(word for word in words if not word.startswith("at="))
        layers.append(_layer(_from_words(rest, {}, where), starts[0] if starts else 0.0, f"{where} ({piece!r})"))
    return replace(_from_words(first.strip(), defaults, where), layers=tuple(layers))


def _layer(request: MotionRequest, begin: Any, where: str) -> LayerRequest:
    """Return a gesture on top of a motion, ``begin`` seconds after its start."""
    if MOTIONS[request.name].gesture is None:
        raise UserError(f"{where}: {request.name} is not a gesture; gestures are: {', '.join(_GESTURES)}")
    if request.repeat != 1:
        raise UserError(f"{where}: {request.name} on top of a motion cannot be repeated; add it once more, later")
    return LayerRequest(_AT.parse(begin, where), request)


def _from_words(piece: str, defaults: Mapping[str, Any], where: str) -> MotionRequest:
    words = piece.replace(",", " ").split()
    if not words:
        raise UserError(f"{where}: it is empty; remove a comma, or name a motion: {NAME_LIST}")
    name, words = leading_name(words)
    repeat, values, file = None, {}, None
    kind = _kind(name, where)
    order = [value.name for value in kind.parameters]
    for word in words:
        if re.fullmatch(r"[xX]\d+", word):
            if repeat is not None:
                raise UserError(f"{where} ({piece!r}): {word!r} is a second number of repeats; give one")
            repeat = whole_number(word[1:])
        elif "=" in word:
            key, _, number = word.partition("=")
            if key in values:
                raise UserError(f"{where} ({piece!r}): {key} is given twice; give it once")
            values[key] = number
        elif file is None and (kind.file is not None or (kind.beats and not _is_number(word))):
            file = Path(word)
        else:
            free = [key for key in order if key not in values]
            if not _is_number(word) and word.lower() in (*MOTIONS, *_CONJUNCTIONS):
                raise UserError(f"{where} ({piece!r}): {word!r} is not a number; {_SEPARATORS}")
            if not free:
                raise UserError(f"{where} ({piece!r}): {word!r} is one value too many; {kind.usage(name)}")
            values[free[0]] = word
    return _request(name, values, 1 if repeat is None else repeat, file, defaults, f"{where} ({piece!r})")


def _from_json(path: Path, defaults: Mapping[str, Any]) -> list[MotionRequest]:
    entries = parse_json(read_text(path), path)
    if not isinstance(entries, list) or not entries:
        found = json_excerpt(entries)
        raise UserError(f'{path}: it contains {found}; give a list of motions, such as [{{"motion": "jump"}}]')
    requests = []
    for number, entry in enumerate(entries, start=1):
        where = f"{path}, motion {number}"
        if not isinstance(entry, dict) or not isinstance(entry.get("motion"), str):
            found = json_excerpt(entry)
            raise UserError(f'{where} is {found}; give an object with a "motion", one of {NAME_LIST}')
        values = dict(entry)
        name = values.pop("motion")
        repeat = values.pop("repeat", 1)
        file = values.pop("file", None)
        layers = _layers_from_json(values.pop("with", []), where)
        style = _own_style(values.pop("style", None), name, where)
        if not isinstance(repeat, int) or isinstance(repeat, bool):
            raise UserError(f'{where}: "repeat" is {repeat!r}; give a whole number')
        if file is not None and not isinstance(file, str):
            raise UserError(f'{where}: "file" is {json_excerpt(file)}; give the name of a file')
        for key, value in values.items():
            if isinstance(value, str):
                raise UserError(f'{where}: "{key}" is the text {json_excerpt(value)}; give a number without quotes')
        keyframes = path.parent / file if file is not None else None
        request = _request(name, values, repeat, keyframes, defaults, where)
        requests.append(replace(request, style=style, layers=layers))
    return requests


def _layers_from_json(entries: Any, where: str) -> tuple[LayerRequest, ...]:
    if not isinstance(entries, list):
        raise UserError(f'{where}: "with" is {json_excerpt(entries)}; give a list of gestures')
    layers = []
    for entry in entries:
        if not isinstance(entry, dict) or not isinstance(entry.get("motion"), str):
            raise UserError(
                f'{where}: "with" contains {json_excerpt(entry)}; give a "motion" for each gesture, one of'
                f" {', '.join(_GESTURES)}"
            )
        values = dict(entry)
        name, begin = values.pop("motion"), values.pop("at", 0.0)
        layers.append(_layer(_request(name, values, 1, None, {}, where), begin, where))
    return tuple(layers)


def _own_style(text: Any, name: str, where: str) -> Style | None:
    if text is None:
        return None
    if not isinstance(text, str):
        raise UserError(f'{where}: "style" is {json_excerpt(text)}; give a string, such as "heavy" or "squash=1.2"')
    if not _kind(name, where).jumps:
        raise UserError(f"{where}: {name} does not jump, so it has no style; these have one: {', '.join(_JUMPS)}")
    if "overlap" in text:
        raise UserError(f"{where}: overlap is a property of the whole run; give it in the style of the run")
    try:
        return read_style(text)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _kind(name: str, where: str) -> MotionKind:
    check_name(name, where)
    return MOTIONS[name]


def _request(
    name: str, values: Mapping[str, Any], repeat: float, file: Path | None, defaults: Mapping[str, Any], where: str
) -> MotionRequest:
    kind = _kind(name, where)
    known = {value.name: value for value in kind.parameters}
    for key in values:
        if key not in known:
            raise UserError(f"{where}: {key!r} is unknown{did_you_mean(key, known)}; {kind.usage(name)}")
    if not 1 <= repeat <= MAX_MOTIONS:
        raise UserError(f"{where}: repeat {repeat}; give a whole number from 1 to {MAX_MOTIONS}")
    if file is None and kind.file is not None:
        raise UserError(f"{where}: {name} needs {kind.file}")
    if kind.required is not None and kind.required[0] not in values.keys() | defaults.keys():
        raise UserError(f"{where}: {name} needs {kind.required[1]}")
    if file is not None and kind.file is None and not kind.beats:
        raise UserError(f"{where}: {kind.usage(name)}")
    if kind.beats and file is None and not values.keys() & known.keys():
        file = defaults.get(_BEATS_FILE)
    if kind.beats and file is not None and values:
        raise UserError(f"{where}: {', '.join(values)} and the beats of {file} are both given; give one of them")
    resolved = {
        key: value.parse(values.get(key, defaults.get(key, value.default)), where) for key, value in known.items()
    }
    return MotionRequest(name, resolved, int(repeat), file)
