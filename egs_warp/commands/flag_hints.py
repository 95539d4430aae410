"""Hints for flags and words that a command does not take: which of its flags, or which command, is meant."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Mapping, Sequence

from egs_warp.commands import COMMANDS
from egs_warp.errors import nearest_name

_OUTPUTS = ("--out", "--export", "--plot")
"""Flags that name what a command writes; each command has at most one of them."""
_SYNONYMS = {
    "--out": (
        "-o",
        "--output",
        "--outdir",
        "--output-dir",
        "--output-folder",
        "--folder",
        "--dir",
        "--save",
        *_OUTPUTS,
    ),
    "--device": ("--gpu", "--cuda", "--cpu"),
    "--size": ("--resolution", "--width"),
    "--overwrite": ("--force", "-f"),
    "--no-browser": ("--headless",),
    "--to": ("--format", "--type"),
    "--iterations": ("--steps", "--epochs"),
    "--steps": ("--iterations", "--epochs"),
    "--object": ("--point", "--click", "--box", "--mask", "--select"),
    "--frames": ("--duration", "--seconds", "--length"),
    "--heading-degrees": ("--direction", "--angle"),
}
"""Flags of this program, each with names that other programs give to such a flag."""
_OTHER_MEANINGS = ("--speed", "--name")
"""Names that are similar to a flag, here ``--seed`` and ``--frame``, but mean something else."""
_SIMILAR = 0.65
"""Smallest similarity (``nearest_name``) of a flag that is suggested; a less similar one means something else."""
_NO = "--no-"
"""Beginning of the flags that turn something off that is on without them."""
_MAX_LISTED = 12
"""Maximum number of flags that a hint lists; a command with more flags has its ``--help`` for that."""
_MAX_OWNERS = 4
"""Maximum number of commands that a hint names as those that have a flag."""


def check_flags(
    words: Sequence[str], command: argparse.ArgumentParser, commands: Mapping[str, argparse.ArgumentParser]
) -> None:
    """Exit with an error for the first flag in ``words`` that is unknown to ``command``.

    Without this check, argparse would first report a missing required flag, which may just be misspelt in ``words``.

    Args:
        words: arguments of ``command``.
        command: parser of the command, or the top-level parser.
        commands: parsers of all commands by name.
    """
    known = command._option_string_actions
    for flag in _flags_of(words):
        short = not flag.startswith("--")
        if any(name.startswith(flag[:2] if short else flag) for name in known):
            continue
        command.error(f"unrecognized arguments: {flag}{_hint(flag, command, commands)}")


def check_surplus(surplus: Sequence[str], words: Sequence[str], command: argparse.ArgumentParser) -> None:
    """Exit with an error if ``command`` could not use the words ``surplus`` among its arguments ``words``."""
    if not surplus:
        return
    output = _output_of(command)
    is_free = output is not None and not any(word.startswith(output) or word.startswith("-o") for word in words)
    hint = f" (did you mean {output} {surplus[0]}?)" if is_free else ""
    command.error(f"unrecognized arguments: {' '.join(surplus)}{hint}")


def _flags_of(words: Sequence[str]) -> Iterator[str]:
    """Yield the flags among ``words``, without a short one in the position of a value, as in ``--up -w``."""
    before = ""
    for word in words:
        if word == "--":
            return
        if word.startswith("--") or (re.match("-[A-Za-z]", word) and not re.match("--[^=]+$", before)):
            yield word.partition("=")[0]
        before = word


def _hint(flag: str, command: argparse.ArgumentParser, commands: Mapping[str, argparse.ArgumentParser]) -> str:
    """Return a text in brackets about ``flag``, which is unknown to ``command``."""
    known = _long_flags(command)
    listed = [each for each in known if each != "--help"]
    name = flag.lstrip("-")
    if name in COMMANDS:
        return f" (did you mean the command egs-warp {name}?)"
    meant = next(
        (own for own, others in _SYNONYMS.items() if flag in others and (own in known or own == "--out")), None
    )
    if meant == "--out" and (output := _output_of(command)) is not None:
        return f" ({command.prog} writes to {output})"
    if meant == "--out" and (last := _positional_output_of(command)) is not None:
        return f" ({command.prog} takes the output as its last argument, {last})"
    if f"{_NO}{name}" in known:
        return f" (it is on by default; {_NO}{name} turns it off)"
    if meant == "--frames" and meant in known:
        # The other programs count seconds.
        described = re.split(r", | \(", command._option_string_actions[meant].help or "")[0]
        return f" (did you mean {meant!r}: {described}?)"
    if meant in known:
        return f" (did you mean {meant!r}?)"
    near = _nearest(flag, known)
    others = [each for each, parser in commands.items() if parser is not command and flag in _long_flags(parser)]
    owners = ", ".join(others) if len(others) <= _MAX_OWNERS else "other commands"
    parts = [f"a flag of {owners}"] if others else [f"did you mean {near!r}?"] if near else []
    if 0 < len(listed) <= _MAX_LISTED and not (near and not others):
        parts.append(f"{command.prog} takes {', '.join(listed)}")
    return f" ({'; '.join(parts)})" if parts else ""


def _nearest(flag: str, known: Sequence[str]) -> str | None:
    """Return the flag in ``known`` of which ``flag`` is a part, the beginning or a misspelling, or None. A flag
    ``--no-X`` is never suggested for ``--X``, nor ``--X`` for ``--no-X``."""
    if flag in _OTHER_MEANINGS:
        return None
    written = flag.lstrip("-").lower()
    names = [each[2:] for each in known if each.startswith(_NO) == flag.lower().startswith(_NO)]
    near = next((name for name in names if written in name.split("-")), None) or nearest_name(
        written, names, similarity=_SIMILAR
    )
    return None if near is None else f"--{near}"


def _long_flags(command: argparse.ArgumentParser) -> list[str]:
    return [name for name in command._option_string_actions if name.startswith("--")]


def _output_of(command: argparse.ArgumentParser) -> str | None:
    """Return the flag that names what ``command`` writes, or None."""
    return next((name for name in _OUTPUTS if name in command._option_string_actions), None)


def _positional_output_of(command: argparse.ArgumentParser) -> str | None:
    """Return the name, in capitals, of the positional argument that names what ``command`` writes, or None."""
    outputs = [action.dest for action in command._get_positional_actions() if f"--{action.dest}" in _OUTPUTS]
    return outputs[-1].upper() if outputs else None
