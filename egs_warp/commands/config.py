"""``--config run.yaml``: the flags of a run, as a file that each run writes and another begins with."""

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
from egs_warp.errors import UserError

NAME = "run.yaml"
_CHECKSUM = "capture_sha256"
_PATHS = ("capture", "object", "plane", "cameras", "background", "terrain", "muscles", "inpainter", "camera", "beats")
"""Flags that may name files: in the file these are relative to its own folder."""
_WORDS = ("fixed", "follow", "orbit", "patch", "telea", "ns", TRANSPARENT)
"""Values of such flags that are no files."""
_IN_MOTION = re.compile(r"\S+\.(?:json|csv)", re.IGNORECASE)
_NEVER = ("help", "out", "overwrite", "config", "trust")
"""Not kept: where a run goes is its own, and whether a file may run programs is not for another file to say."""


def add_config_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag that ``with_config`` reads."""
    parser.add_argument(
        "--config", help="run.yaml of an earlier run, or your own: flags as keys; flags given beside it go before it"
    )


def with_config(arguments: Sequence[str], parser: argparse.ArgumentParser) -> list[str]:
    """``arguments`` of ``parser`` behind those of the file that they name by ``--config``; without it as they are.

    Raises ``UserError`` for a file that is none, unknown keys, and values that are no text, number or yes and no.
    """
    found = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    found.add_argument("--config")
    try:
        named, rest = found.parse_known_args(list(arguments))
    # The command's own parser says what is wrong.
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
            near = ", ".join(sorted(actions))
            raise UserError(f"{path}: unknown key {_shown(key)}; give some of {near}")
        if value is None or value is False:
            continue
        action = actions[name]
        if isinstance(action, argparse._AppendAction):
            option, texts = action.option_strings[0], value if isinstance(value, list) else [value]
            if not all(isinstance(one, str | int | float) for one in texts):
                raise UserError(f"{path}: {key} is {_shown(value)}; give a text or a list of texts")
            # Given beside it, none of the file's: they would mean both.
            if not any(argument == option or argument.startswith(f"{option}=") for argument in rest):
                flags += [f"{option}={_from_file(name, str(one), path.parent)}" for one in texts]
            continue
        if (value is True) != (action.nargs == 0) or not isinstance(value, bool | int | float | str):
            wanted = "true" if action.nargs == 0 else "a text or a number"
            raise UserError(f"{path}: {key} is {_shown(value)}; give {wanted}")
        text = _from_file(name, str(value), path.parent)
        if not action.option_strings:
            positional.append(text)
        else:
            flags.append(action.option_strings[0] if value is True else f"{action.option_strings[0]}={text}")
    # A capture given beside the file goes before that in it; both would be one too many.
    left = parser.parse_known_args([*positional, *flags, *rest, "--out=x"])[1] if positional else []
    if any(not argument.startswith("-") for argument in left):
        positional = []
    return [*flags, *positional, *rest, f"--config={path}"]


def changed_capture(config: str, capture: str) -> bool:
    """Whether ``capture`` is another file than that which the run of the file ``config`` had."""
    wanted = _read(Path(config)).get(_CHECKSUM)
    return wanted is not None and wanted != _checksum(Path(capture))


def write_config(path: Path, chosen: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Write what was chosen, defaults among it, such that a run with it has the same bits."""
    import yaml

    from egs_warp.io.atomic import atomic_write
    from egs_warp.version import __version__

    kept: dict[str, Any] = {}
    for name in _actions(parser):
        value = getattr(chosen, name)
        if value is None or value is False:
            continue
        if isinstance(value, list):
            texts = [_for_file(name, str(one), path.parent) for one in value]
            kept[name] = texts if len(texts) > 1 else texts[0]
            continue
        kept[name] = _for_file(name, str(value), path.parent) if isinstance(value, str | Path) else value
    kept[_CHECKSUM] = _checksum(Path(chosen.capture))
    lines = f"# egs-warp {__version__}; again: egs-warp {chosen.command} --config {NAME} --out OTHER\n"
    with atomic_write(path) as temporary:
        temporary.write_text(lines + yaml.safe_dump(kept, sort_keys=False, allow_unicode=True), encoding="utf-8")


def _actions(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    return {action.dest: action for action in parser._actions if action.dest not in _NEVER}


def _read(path: Path) -> dict[Any, Any]:
    import yaml

    from egs_warp.io.text import read_text

    class Plain(yaml.SafeLoader):
        """Without aliases: a few lines of them stand for more than fits into any memory."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                where = self.peek_event().start_mark
                raise yaml.MarkedYAMLError(problem="an alias, *name; write out what it stands for", problem_mark=where)
            return super().compose_node(parent, index)

    try:
        tree = yaml.load(read_text(path), Plain)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: not YAML ({' '.join(str(error).split())}); correct it") from error
    if not isinstance(tree, dict):
        raise UserError(f"{path}: no keys and values; write one flag a line, as motion: jump")
    return tree


def _shown(value: Any) -> str:
    """For a message, not in full where it is long."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    return short.repr(value)


def _from_file(name: str, value: str, folder: Path) -> str:
    """A path of the file as one from here; what is no file is left as it is."""
    if name == "motion":
        return _IN_MOTION.sub(lambda found: str(folder / found[0]), value)
    is_file = name in _PATHS and value not in _WORDS and os.path.lexists(folder / value)
    return str(folder / value) if is_file else value


def _for_file(name: str, value: str, folder: Path) -> str:
    def relative(text: str) -> str:
        return os.path.relpath(text, folder) if os.path.lexists(text) else text

    if name == "motion":
        return _IN_MOTION.sub(lambda found: relative(found[0]), value)
    return relative(value) if name in _PATHS and value not in _WORDS else value


def _checksum(path: Path) -> str | None:
    """None of a folder."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
