"""Camera and video flags, shared by ``animate`` and ``render``."""

from __future__ import annotations

import argparse
import os
import re
from typing import TYPE_CHECKING

from egs_warp.errors import UserError, did_you_mean

if TYPE_CHECKING:
    from egs_warp.pipelines.shot import Shot

TRANSPARENT = "transparent"
"""Value of ``--background`` for a transparent video."""
COLOURS = "r,g,b from 0 to 1, #rrggbb, or a name"
"""Accepted forms of a colour, for messages."""


def add_camera_flags(
    parser: argparse._ActionsContainer, *, size: str, common: argparse._ActionsContainer | None = None
) -> None:
    """Add the flags that ``shot_of`` reads.

    Args:
        parser: parser or group that gets the flags.
        size: the default video size, for the help.
        common: parser or group that gets ``--camera`` and ``--size``; default ``parser``.
    """
    first = common or parser
    first.add_argument(
        "--camera",
        default="auto",
        help="auto (default: follows a creature that travels, unless it is in a scene), fixed, follow, orbit, or a "
        "path.json with key cameras",
    )
    first.add_argument("--size", help=f"size of the video in pixels, for example 512 or 640x360 ({size})")
    parser.add_argument("--fps", type=float, default=60.0, help="video frames per second of motion (60)")
    parser.add_argument(
        "--background",
        help="background of the creature: a capture, a colour (r,g,b from 0 to 1, #rrggbb or a CSS name), or "
        "transparent (the shadow stays)",
    )


def shot_of(args: argparse.Namespace) -> tuple[Shot, str | None]:
    """Return the shot that the flags describe, and the background capture that ``--background`` names, or None."""
    from egs_warp.pipelines.shot import Shot

    colour = parse_colour(args.background) if args.background is not None else None
    transparent = args.background == TRANSPARENT
    background_path = None if colour is not None or transparent else args.background
    if background_path is not None and not os.path.lexists(background_path):
        near = did_you_mean(background_path, [TRANSPARENT, *_colour_names()])
        raise UserError(
            f"--background {background_path}: no such file{near}; give a capture, transparent, or a colour: {COLOURS}"
        )
    size = parse_size(args.size) if args.size is not None else None
    shot = Shot(args.camera, size, args.fps, colour, transparent)
    shot.check()
    return shot, background_path


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) from ``512`` or ``640x360``. Raises ``UserError`` for other texts."""
    match = re.fullmatch(r"(\d{1,6})(?:x(\d{1,6}))?", text.strip().lower())
    if match is None:
        raise UserError(f"--size {text}: give a side or WIDTHxHEIGHT in pixels, such as 512 or 640x360")
    return int(match[1]), int(match[2] or match[1])


def parse_colour(text: str) -> tuple[float, float, float] | None:
    """Return (r, g, b), each 0 to 1, from ``r,g,b``, ``#rrggbb`` or the name of a CSS colour; None for other texts and
    for a colour name that is also the name of a file.

    Raises ``UserError`` for numbers outside the range 0 to 1.
    """
    if text.isalpha() and not os.path.lexists(text):
        text = _colour_names().get(text.lower(), text)
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        red, green, blue = (int(text[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
        return red, green, blue
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        return None
    if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
        raise UserError(f"--background {text}: give a colour: {COLOURS}")
    return red, green, blue


def _colour_names() -> dict[str, str]:
    """Return ``#rrggbb`` of each CSS colour."""
    from PIL.ImageColor import colormap

    return {name: value for name, value in colormap.items() if isinstance(value, str)}
