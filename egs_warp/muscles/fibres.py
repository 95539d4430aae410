"""Geometry of muscle fibres: named polylines in the body at rest, before their attachment to nodes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np


class FibreKind(Enum):
    """Kind of a fibre: its course in a branch of the body, which determines its effect on the branch."""

    LONGITUDINAL = "longitudinal"
    """Along the branch; shortens it, or bends it if only one side contracts."""
    RADIAL = "radial"
    """Across the branch; makes it thinner and thereby longer."""
    CIRCULAR = "circular"
    """Closed hoop around the branch; constricts it without an axial torque."""
    OBLIQUE_LEFT = "oblique_left"
    """Left-handed helix around the branch; twists the branch."""
    OBLIQUE_RIGHT = "oblique_right"
    """Right-handed helix; twists the branch in the opposite direction."""
    USER = "user"
    """Polyline from the user's file."""


@dataclass(frozen=True)
class Fibre:
    """Polyline of muscle segments in the body at rest."""

    name: str
    """Unique name."""
    kind: FibreKind
    """Kind of the fibre."""
    points: np.ndarray
    """(K, 3) float64, m, K >= 2; a closed hoop repeats its first point at its end."""
    max_force: float | np.ndarray
    """Strength F_max of the segments, N: one number, or (K-1,)."""
    group: int = 0
    """Group of the fibre: a branch, or a group named in the user's file."""
    partner: str | None = None
    """Name of the mirror-image fibre, or None."""
