"""Flags that say how a run is filmed, shared by ``animate`` and ``render``."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.pipelines.shot import Shot

TRANSPARENT = "transparent"
COLOURS = "give three numbers r,g,b from 0 to 1, or #rrggbb"


def add_camera_flags(parser: argparse._ActionsContainer, *, size: str) -> None:
    """Add the flags that ``shot_of`` reads; ``size`` says what the film is like without ``--size``."""
    parser.add_argument(
        "--camera", default="fixed", help="fixed (default), follow, orbit, or a path.json of key cameras"
    )
    parser.add_argument("--size", help=f"pixels, as 512 or 640x360 ({size})")
    parser.add_argument("--fps", type=float, default=60.0, help="frames for one second of motion (60)")
    parser.add_argument(
        "--background",
        help="behind the creature: a capture, a colour r,g,b from 0 to 1 or #rrggbb, or transparent (but the shadow)",
    )


def shot_of(chosen: argparse.Namespace) -> tuple[Shot, str | None]:
    """What the flags say, and the capture that is behind, if ``--background`` names one."""
    from egs_warp.pipelines.shot import Shot

    colour = parse_colour(chosen.background) if chosen.background is not None else None
    transparent = chosen.background == TRANSPARENT
    size = parse_size(chosen.size) if chosen.size is not None else None
    shot = Shot(chosen.camera, size, chosen.fps, colour, transparent)
    shot.check()
    return shot, None if colour is not None or transparent else chosen.background


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of ``512`` or ``640x360``. Raises ``UserError`` otherwise."""
    found = re.fullmatch(r"(\d{1,6})(?:x(\d{1,6}))?", text.strip().lower())
    if found is None:
        raise UserError(f"--size {text}: give pixels, as 512 or 640x360")
    return int(found[1]), int(found[2] or found[1])


def parse_colour(text: str) -> tuple[float, float, float] | None:
    """0 to 1 each, of ``r,g,b`` or ``#rrggbb``; None where ``text`` is neither. Raises ``UserError`` beyond 0 to 1."""
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        red, green, blue = (int(text[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
        return red, green, blue
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        return None
    if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
        raise UserError(f"--background {text}: {COLOURS}")
    return red, green, blue
