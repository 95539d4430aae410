"""Flags in place of the arguments of the library."""

from __future__ import annotations

from egs_warp.commands.flags import with_flags


def test_notes_of_the_library_advise_flags() -> None:
    """Only the advice at the end of a line is replaced, and not other mentions of the front or the up direction."""
    notes = (
        "up is taken to be 0,0,1 (guessed: the up direction is level); if that is wrong, give the up direction\n"
        "front is taken to be 1,0,0; if that is wrong, give the front\n"
        "the front is hidden; if that is wrong, give the front of the body"
    )
    assert with_flags(notes) == (
        "up is taken to be 0,0,1 (guessed: the up direction is level); if that is wrong, give --up\n"
        "front is taken to be 1,0,0; if that is wrong, give --front\n"
        "the front is hidden; if that is wrong, give the front of the body"
    )
