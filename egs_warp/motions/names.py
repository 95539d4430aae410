"""Names of the motions, and how a line of text is split into them, in a module that imports no mechanics: a misspelt
name is reported before the modules of the motions are imported, which takes seconds."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from egs_warp.errors import UserError, did_you_mean

NAMES = (
    *("jump", "hop", "twist", "walk", "walk to", "walk along", "run", "turn", "drive", "stand", "get up", "dance"),
    *("trajectory", "nod", "shake", "look around", "wave", "bow", "groove", "sneak", "skip", "spin", "backflip"),
    *("front flip", "land and pose"),
)
"""Keys of ``egs_warp.motions.repertoire.MOTIONS``, in their order."""
NAME_LIST = ", ".join(f"'{name}'" if " and " in name else name for name in NAMES)
"""All names, for messages; names that contain "and" are in quotes."""


def check_names(text: str) -> None:
    """Raise ``UserError`` for the first unknown motion of a line of text; any other mistake is left to ``motion``."""
    if is_script_file(text):
        return
    for where, piece in numbered_pieces(text):
        for part in gestures_of(piece):
            if words := part.replace(",", " ").split():
                check_name(leading_name(words)[0], where)


def check_name(name: str, where: str) -> None:
    """Raise ``UserError``, whose message begins with ``where``, if no motion is called ``name``."""
    if name not in NAMES:
        raise UserError(f"{where}: unknown motion {name!r}{did_you_mean(name, NAMES)}; known motions are: {NAME_LIST}")


def is_script_file(text: str) -> bool:
    """Return True if ``text`` names a JSON file instead of motions."""
    return text.strip().lower().endswith(".json") and "," not in text and len(text.split()) == 1


def numbered_pieces(text: str) -> Iterator[tuple[str, str]]:
    """Yield each motion of a line of text, with the gestures on top of it, after its number for messages."""
    # A comma before a number separates two numbers, as in walk to 1,2.
    for number, piece in enumerate(re.split(r",(?!\s*[-+.]?\d)", text), start=1):
        yield f"motion {number}", piece.strip()


def gestures_of(piece: str) -> list[str]:
    """Return the texts of a motion and of the gestures on top of it; ``+`` before a number is its sign."""
    return re.split(r"\+(?!\s*[.\d])", piece)


def leading_name(words: Sequence[str]) -> tuple[str, list[str]]:
    """Return the name at the beginning of ``words``, which may be unknown, and the words after it."""
    count = next((count for count in (3, 2) if " ".join(words[:count]).lower() in NAMES), 1)
    return " ".join(words[:count]).lower(), list(words[count:])
