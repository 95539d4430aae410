"""Kinds of notes for the user. A plain text is a note that every user should read.

Both kinds are texts: reports and pages contain them as they are. Only the terminal distinguishes them
(``egs_warp.commands.scene_flags.print_notes``).
"""

from __future__ import annotations


class Detail(str):
    """Note with numbers for experts: it is in the report, and the terminal does not show it if there is a report."""


class Problem(str):
    """Note about what is probably wrong with the input or the result: the terminal shows it last, with ``warning:``."""


def prefixed(name: str, note: str) -> str:
    """Return ``note`` after ``name`` and a colon, as a note of the same kind."""
    return type(note)(f"{name}: {note}")
