"""Tags in the comments of a .ply header, which state training with antialiasing and the vertical axis.

Tags in use are ``SplatRenderMode: mip`` (Brush, gsplat, splat-transform), ``antialiased 1`` (Postshot),
``Vertical Axis: z`` (nerfstudio) and ``Vertical axis: 0 -1 0`` (Brush), in any letter case. The last of several tags
applies.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

ANTIALIASED_LINE = "comment SplatRenderMode: mip\n"
"""Header line of a capture that was trained with antialiasing."""
_MODE = re.compile(r"(?:splat\s*)?(?:render|rasteri[sz]e)[ _]*mode\s*[:=]?\s*(\w+)", re.IGNORECASE)
_FLAG = re.compile(r"(?:train_flags\b.*\b)?anti[- _]?alias(?:ed|ing)?\s*[:=]?\s*(\w*)\s*$", re.IGNORECASE)
_MIP_MODES = ("mip", "antialiased")
_FLAG_VALUES = {"": True, "1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False}
_FLAG_VALUES |= {"off": False}
_AXIS = re.compile(r"(?:vertical|up)[ _-]*axis\s*[:=]?\s*(.*)", re.IGNORECASE)
_LETTER = re.compile(r"([+-]?)\s*([xyz])\b", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?", re.IGNORECASE)
_BRUSH = re.compile(r"\bbrush\b", re.IGNORECASE)


def antialiased_of(comments: Sequence[str]) -> bool:
    """Return True if ``comments`` state that the capture was trained with antialiasing."""
    antialiased = False
    for comment in comments:
        if mode := _MODE.match(comment):
            antialiased = mode[1].lower() in _MIP_MODES
        elif flag := _FLAG.match(comment):
            antialiased = _FLAG_VALUES.get(flag[1].lower(), antialiased)
    return antialiased


def up_of(comments: Sequence[str]) -> tuple[np.ndarray | None, int | None]:
    """Return the up direction in ``comments``, a unit vector (3,) or None, and the index of the vertical axis if its
    sign is not reliable, otherwise None.

    Brush writes ``Vertical axis: y`` into every file whose axis is unknown, even if -y is up.
    """
    up, axis = None, None
    for comment in comments:
        named = _AXIS.match(comment)
        if named is None:
            continue
        letter, numbers = _LETTER.match(named[1].strip()), _NUMBER.findall(named[1])
        if letter:
            axis = "xyz".index(letter[2].lower())
            up = np.zeros(3)
            up[axis] = -1.0 if letter[1] == "-" else 1.0
            if letter[1] or not any(map(_BRUSH.search, comments)):
                axis = None
            else:
                up = None
        elif len(numbers) == 3:
            direction = np.array(numbers, float)
            # Divide first, so that the squares neither overflow nor underflow.
            largest = np.abs(direction).max()
            if 0.0 < largest < np.inf:
                direction /= largest
                up, axis = direction / np.linalg.norm(direction), None
    return up, axis
