"""Camera and video flags, shared by ``animate`` and ``render``."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.pipelines.shot import Shot

TRANSPARENT = "transparent"
"""Value of ``--background`` for a transparent video."""
COLOURS = "give three numbers r,g,b from 0 to 1, or #rrggbb"
"""Advice of the messages about colours."""


def add_camera_flags(
    parser: argparse._ActionsContainer, *, size: str, common: argparse._ActionsContainer | None = None
) -> None:
    """Add the flags that ``shot_of`` reads.

    Args:
        parser: parser or group that gets the flags.
        size: the video size without ``--size``, for the help.
        common: parser or group that gets ``--camera`` and ``--size``; default ``parser``.
    """
    first = common or parser
    first.add_argument(
        "--camera", default="fixed", help="fixed (default), follow, orbit, or a path.json with key cameras"
    )
    first.add_argument("--size", help=f"size of the video in pixels, for example 512 or 640x360 ({size})")
    parser.add_argument("--fps", type=float, default=60.0, help="video frames per second of motion (60)")
    parser.add_argument(
        "--background",
        help="background of the creature: a capture, a colour r,g,b from 0 to 1 or #rrggbb, or transparent (the shadow "
        "stays)",
    )


def shot_of(args: argparse.Namespace) -> tuple[Shot, str | None]:
    """Return the shot that the flags describe, and the background capture if ``--background`` names one, else None."""
    from egs_warp.pipelines.shot import Shot

    colour = parse_colour(args.background) if args.background is not None else None
    transparent = args.background == TRANSPARENT
    size = parse_size(args.size) if args.size is not None else None
    shot = Shot(args.camera, size, args.fps, colour, transparent)
    shot.check()
    return shot, None if colour is not None or transparent else args.background


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) from ``512`` or ``640x360``. Raises ``UserError`` for other texts."""
    match = re.fullmatch(r"(\d{1,6})(?:x(\d{1,6}))?", text.strip().lower())
    if match is None:
        raise UserError(f"--size {text}: give pixels, as 512 or 640x360")
    return int(match[1]), int(match[2] or match[1])


def parse_colour(text: str) -> tuple[float, float, float] | None:
    """Return (r, g, b), each 0 to 1, from ``r,g,b`` or ``#rrggbb``; None if ``text`` is neither.

    Raises ``UserError`` for numbers outside of 0 to 1.
    """
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
