"""One motion that is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from egs_warp.motions.command import DrivePlan
from egs_warp.motions.style import Style

LARGEST_TARGET = 10.0
"""Body heights; a larger target is refused as a slip of the pen."""
LARGEST_TURN = 720.0
"""Degrees."""


@dataclass(frozen=True)
class MotionRequest:
    """One motion of a script, with every value known."""

    name: str
    asked: Mapping[str, float]
    """Values by name, lengths in body heights, as reports give them."""
    repeat: int = 1
    file: Path | None = None
    """Key frames of a trajectory, points of a path, speeds of a drive."""
    drive: DrivePlan | None = None
    """Speeds that come from no file."""
    style: Style | None = None
    """How it jumps, where that is not as the rest of the run."""
