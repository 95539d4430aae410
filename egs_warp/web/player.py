"""The player of bundles for other pages (``egs_warp/web/player``), as built by npm."""

from __future__ import annotations

from pathlib import Path

from egs_warp.errors import UserError

PLAYER = Path(__file__).parent / "player" / "dist" / "egs-player.js"
"""File of the JavaScript module that defines the element ``<egs-player>``; it needs no other file."""


def player_script() -> str:
    """Return the source text of the JavaScript module that defines ``<egs-player>``.

    Raises ``UserError`` if it has not been built.
    """
    try:
        return PLAYER.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError(
            f"{PLAYER}: the player is not built; run make web in the source tree (needs node 20 or newer), or install"
            " the egs-warp wheel, which contains it"
        ) from error
