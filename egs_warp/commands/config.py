"""``--config run.yaml``: the flags of a run as a YAML file. Every run writes one, and another run can read it."""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from egs_warp.commands.camera_flags import TRANSPARENT
from egs_warp.commands.flags import NAMED_VALUE
from egs_warp.errors import UserError, did_you_mean

NAME = "run.yaml"
"""Name of the file in the run folder, as in ``egs_warp.io.run_folder``, which is slow to import."""
_CHECKSUM = "capture_sha256"
_PATHS = (
    *("capture", "object", "plane", "cameras", "background", "terrain", "cage", "muscles"),
    *("inpainter", "camera", "beats", "mask_model", "collision_mesh"),
)
"""Flags that may name files. In the YAML file, these paths are relative to its folder."""
_WRITTEN = ("save_collision_mesh",)
"""Flags that name files written by the run, so that they need not exist. Their paths are relative to the folder,
too."""
_WORDS = ("auto", "fixed", "follow", "orbit", "patch", "telea", "ns", TRANSPARENT)
"""Values of these flags that are words, not names of files."""
_IN_MOTION = re.compile(r"\S+\.(?:json|csv)", re.IGNORECASE)
"""Pattern of file names in the value of ``--motion``."""
_NEVER = ("help", "out", "overwrite", "config", "trust")
"""Flags that the file does not store: each run has its own output folder, and only the user may set ``--trust``."""


def add_config_flag(parser: argparse._ActionsContainer) -> None:
    """Add the flag that ``with_config`` reads."""
    parser.add_argument(
        "--config",
        help="run.yaml of an earlier run, or your own YAML file with flags as keys; flags on the command line take "
        "precedence",
    )


def with_config(arguments: Sequence[str], parser: argparse.ArgumentParser) -> list[str]:
    """Return ``arguments`` of ``parser``, preceded by the arguments in the file of ``--config``, if any.

    Raises ``UserError`` for an unreadable file, unknown keys, and values that are not a string, number or boolean.
    """
    config_parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    config_parser.add_argument("--config")
    try:
        named, rest = config_parser.parse_known_args(list(arguments))
    # The parser of the command reports this error.
    except argparse.ArgumentError:
        return list(arguments)
    if named.config is None:
        return list(arguments)
    path = Path(named.config)
    actions = _actions(parser)
    flags, positional = [], []
    for key, value in _read(path).items():
        name = str(key).replace("-", "_")
        if name == _CHECKSUM:
            continue
        if name not in actions:
            near, known = did_you_mean(name, actions), ", ".join(sorted(actions))
            raise UserError(f"{path}: unknown key {_short(key)}{near}; known keys are {known}")
        if value is None or value is False:
            continue
        action = actions[name]
        if isinstance(action, argparse._AppendAction):
            option, texts = action.option_strings[0], value if isinstance(value, list) else [value]
            if not all(isinstance(one, str | int | float) for one in texts):
                raise UserError(f"{path}: {key} is {_short(value)}; give a string or a list of strings")
            # Values on the command line replace the values of the file, to which argparse would append them.
            if not any(argument == option or argument.startswith(f"{option}=") for argument in rest):
                flags += [f"{option}={_from_file(name, str(one), path.parent)}" for one in texts]
            continue
        if (value is True) != (action.nargs == 0) or not isinstance(value, bool | int | float | str):
            expected = "true" if action.nargs == 0 else "a string or a number"
            raise UserError(f"{path}: {key} is {_short(value)}; give {expected}")
        text = _from_file(name, str(value), path.parent)
        if not action.option_strings:
            positional.append(text)
        else:
            flags.append(action.option_strings[0] if value is True else f"{action.option_strings[0]}={text}")
    # A capture on the command line replaces the capture in the file; argparse would reject two captures.
    surplus = parser.parse_known_args([*positional, *flags, *rest, "--out=x"])[1] if positional else []
    if any(not argument.startswith("-") for argument in surplus):
        positional = []
    return [*flags, *positional, *rest, f"--config={path}"]


def changed_capture(config: str, capture: str) -> bool:
    """Return True if the checksum of ``capture`` differs from the one in the file ``config``; False if the file has
    none."""
    expected = _read(Path(config)).get(_CHECKSUM)
    return expected is not None and expected != _checksum(Path(capture))


def write_config(path: Path, args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Write all flags of a run, including defaults, to ``path``; a run with this file gives bitwise equal results."""
    from egs_warp.io.atomic import atomic_write
    from egs_warp.io.yaml_file import yaml_text
    from egs_warp.version import __version__

    values: dict[str, Any] = {}
    for name in _actions(parser):
        value = getattr(args, name)
        if value is None or value is False:
            continue
        if isinstance(value, list):
            texts = [_for_file(name, str(one), path.parent) for one in value]
            values[name] = texts if len(texts) > 1 else texts[0]
            continue
        values[name] = _for_file(name, str(value), path.parent) if isinstance(value, str | Path) else value
    values[_CHECKSUM] = _checksum(Path(args.capture))
    header = f"# egs-warp {__version__}; to repeat: egs-warp {args.command} --config {NAME} --out OTHER\n"
    with atomic_write(path) as temporary:
        temporary.write_text(header + yaml_text(values), encoding="utf-8")


def _actions(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    return {action.dest: action for action in parser._actions if action.dest not in _NEVER}


def _read(path: Path) -> dict[Any, Any]:
    from egs_warp.io.yaml_file import read_yaml

    tree, _ = read_yaml(path)
    if not isinstance(tree, dict):
        raise UserError(f"{path}: the file has no keys and values; write one flag per line, such as motion: jump")
    return tree


def _short(value: Any) -> str:
    """Return ``value`` as text for a message, shortened if it is long."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    return short.repr(value)


def _from_file(name: str, value: str, folder: Path) -> str:
    """Return a ``value`` of the YAML file in ``folder``, with a path in it made relative to the working folder."""
    if name == "motion":
        return _IN_MOTION.sub(lambda match: str(folder / match[0]), value)
    if name in _WRITTEN:
        return str(folder / value)
    if name == "object":
        before, file, after = _parts_of_object(value, folder)
        return f"{before}{folder / file}{after}" if os.path.lexists(folder / file) else value
    is_file = name in _PATHS and value not in _WORDS and os.path.lexists(folder / value)
    return str(folder / value) if is_file else value


def _for_file(name: str, value: str, folder: Path) -> str:
    """Return ``value`` for a YAML file in ``folder``, with a path in it made relative to that folder."""

    def relative(text: str) -> str:
        return os.path.relpath(text, folder) if os.path.lexists(text) else text

    if name == "motion":
        return _IN_MOTION.sub(lambda match: relative(match[0]), value)
    if name in _WRITTEN:
        return os.path.relpath(value, folder)
    if name == "object":
        before, file, after = _parts_of_object(value, Path())
        return f"{before}{relative(file)}{after}"
    return relative(value) if name in _PATHS and value not in _WORDS else value


def _parts_of_object(value: str, folder: Path) -> tuple[str, str, str]:
    """Split a value of ``--object`` into ``NAME=``, the path of a file in ``folder``, and ``:RECORD``, a record of that
    file. The first and the last may be empty; the middle may also be another value, such as a point ``0,0,1``."""
    if os.path.lexists(folder / value):
        return "", value, ""
    named = NAMED_VALUE.fullmatch(value)
    before, rest = (f"{named[1]}=", named[2]) if named else ("", value)
    file, colon, record = rest.partition(".json:")
    return (before, f"{file}.json", f":{record}") if colon else (before, rest, "")


def _checksum(path: Path) -> str | None:
    """Return the SHA-256 checksum of a file; None if it cannot be read, for example because it is a folder."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
