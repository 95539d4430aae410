"""Request for one motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from egs_warp.motions.command import DrivePlan
from egs_warp.motions.keyframes import Key
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.style import Style

MAX_TARGET = 10.0
"""Largest target, in body heights; larger values are rejected as typing errors."""
MAX_TURN = 720.0
"""Largest turn, in degrees."""


@dataclass(frozen=True)
class MotionRequest:
    """One motion of a script, with all values resolved."""

    name: str
    asked: Mapping[str, float]
    """Requested values by name; lengths are in body heights, as in reports."""
    repeat: int = 1
    file: Path | None = None
    """File: key frames of a trajectory, points of a path, speeds of a drive, or beats of a dance."""
    drive: DrivePlan | None = None
    """Commands of a drive that has no file."""
    keys: tuple[Key, ...] | None = None
    """Key frames of a trajectory that has no file."""
    begin: Callable[[Stance], BodyMotion] | None = None
    """Function that creates a motion that is not in the registry."""
    seconds: float = 0.0
    """Time limit of a motion that is not in the registry, s."""
    style: Style | None = None
    """Style of the jumps of this motion; None uses the style of the run."""
    retake: int = 0
    """Number of the retake (``egs_warp.motions.retake``); 0 is the motion as requested."""
    layers: tuple[LayerRequest, ...] = ()
    """Gestures on top of the motion."""

    def __str__(self) -> str:
        """Return a description such as ``hop x3 distance=0.5 + nod at=0.2``."""
        values = " ".join(f"{name}={value:g}" for name, value in self.asked.items())
        text = " ".join(filter(None, (self.name, f"x{self.repeat}" if self.repeat > 1 else "", values)))
        return " + ".join([text, *(f"{layer.request} at={layer.begin:g}" for layer in self.layers)])


@dataclass(frozen=True)
class LayerRequest:
    """Request for a gesture on top of a motion."""

    begin: float
    """Start in seconds after the start of the motion."""
    request: MotionRequest
