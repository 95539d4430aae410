"""Muscle fibres as geometry: named polylines in the rest body, before they are attached to nodes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np


class FibreKind(Enum):
    """How a fibre runs about its branch of the body, and so what it does."""

    LONGITUDINAL = "longitudinal"
    """Along the branch: shortens it; on one side alone, bends it."""
    RADIAL = "radial"
    """Across the branch: thins it and so lengthens it."""
    CIRCULAR = "circular"
    """A hoop around the branch: squeezes it; makes no axial torque."""
    OBLIQUE_LEFT = "oblique_left"
    """A left-handed helix around the branch: twists it one way."""
    OBLIQUE_RIGHT = "oblique_right"
    """A right-handed helix: twists it the other way."""
    USER = "user"
    """A free polyline of the user's."""


@dataclass(frozen=True)
class Fibre:
    """One polyline of muscle segments in the rest body."""

    name: str
    kind: FibreKind
    points: np.ndarray
    """(K, 3) float64, metres, K >= 2; a closed hoop repeats its first point at its end."""
    max_force: float | np.ndarray
    """Strength F_max of its segments, newtons: one number, or (K-1,)."""
    group: int = 0
    """Fibres of one group belong together (one branch, or the user's choice)."""
    partner: str | None = None
    """Name of the mirror-image fibre, if the body has one."""
