"""Linear inverted pendulum model of the centre of mass of a walking body: c'' = w^2 (c - p), p the centre of pressure.

The divergent component of its motion is x = c + c' / w, with x' = w (x - p) (the instantaneous capture point; Pratt et
al. 2006; as a plan: Englsberger et al. 2015, "Three-dimensional bipedal walking control based on divergent component of
motion").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

_LINE_TOLERANCE = 1e-6
"""Largest ratio of width to length of collinear points."""


@dataclass(frozen=True)
class PendulumPlan:
    """Centre of pressure and divergent component over time, every ``step`` seconds."""

    step: float
    pressure: np.ndarray
    """(n, 2) m, centre of pressure during each interval."""
    divergent: np.ndarray
    """(n+1, 2) m, divergent component at the ends of the intervals."""

    @classmethod
    def from_pressure(cls, pressure: np.ndarray, step: float, rate: float) -> PendulumPlan:
        """Return the motion under the centre of pressure ``pressure`` (n, 2) that does not diverge after its end; it is
        unique. ``rate`` is w, 1/s."""
        divergent = np.empty((len(pressure) + 1, 2))
        divergent[-1] = pressure[-1]
        shrink = np.exp(-rate * step)
        for k in reversed(range(len(pressure))):
            divergent[k] = pressure[k] + shrink * (divergent[k + 1] - pressure[k])
        return cls(step, pressure, divergent)

    def at(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Return centre of pressure and divergent component (2,) ``elapsed`` seconds after the start."""
        k = min(int(elapsed / self.step), len(self.pressure) - 1)
        part = min(elapsed / self.step - k, 1.0)
        return self.pressure[k], (1.0 - part) * self.divergent[k] + part * self.divergent[k + 1]


def drift(off: np.ndarray, push: np.ndarray, growth: float) -> np.ndarray:
    """Predict the error (2,) of the divergent component.

    Args:
        off: (2,) m, present error.
        push: (2,) m, constant error of the centre of pressure.
        growth: exp(w t) for the time t of the prediction.
    """
    return off * growth - push * (growth - 1.0)


def nearest_in_hull(points: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the point (2,) of the convex hull of ``points`` (k, 2) nearest to ``point`` (2,). The points may be
    collinear."""
    if is_line(points):
        middle = points.mean(axis=0)
        along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
        coordinates = (points - middle) @ along
        return middle + np.clip((point - middle) @ along, coordinates.min(), coordinates.max()) * along
    hull = ConvexHull(points)
    if np.all(hull.equations[:, :2] @ point + hull.equations[:, 2] <= 0.0):
        return point
    corners = points[hull.vertices]
    sides = np.roll(corners, -1, axis=0) - corners
    along = np.einsum("ki,ki->k", point - corners, sides) / np.einsum("ki,ki->k", sides, sides)
    candidates = corners + np.clip(along, 0.0, 1.0)[:, None] * sides
    return candidates[np.argmin(np.linalg.norm(candidates - point, axis=1))]


def is_line(points: np.ndarray) -> bool:
    """Return True if ``points`` (k, 2) span no area."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) < 3 or bool(spread[1] <= _LINE_TOLERANCE * spread[0])
