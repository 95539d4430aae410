"""The centre of mass of a walking body as a linear inverted pendulum: c'' = w^2 (c - p), p the centre of pressure.

What diverges of its motion is x = c + c' / w, with x' = w (x - p) (the instantaneous capture point; Pratt et al. 2006;
as a plan: Englsberger et al. 2015, "Three-dimensional bipedal walking control based on divergent component of motion").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

_FLAT = 1e-6
"""Width over length of points that lie in a line."""


@dataclass(frozen=True)
class PendulumPlan:
    """Centre of pressure and divergent point over time, every ``step`` seconds."""

    step: float
    pressure: np.ndarray
    """(n, 2) metres, over each step."""
    divergent: np.ndarray
    """(n+1, 2) metres, at the ends of the steps."""

    @classmethod
    def over(cls, pressure: np.ndarray, step: float, rate: float) -> PendulumPlan:
        """The only motion under ``pressure`` (n, 2), at ``rate`` w (1/s), that does not diverge from where it ends."""
        divergent = np.empty((len(pressure) + 1, 2))
        divergent[-1] = pressure[-1]
        shrink = np.exp(-rate * step)
        for k in reversed(range(len(pressure))):
            divergent[k] = pressure[k] + shrink * (divergent[k + 1] - pressure[k])
        return cls(step, pressure, divergent)

    def at(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Centre of pressure and divergent point (2,) ``elapsed`` seconds after the start."""
        k = min(int(elapsed / self.step), len(self.pressure) - 1)
        part = min(elapsed / self.step - k, 1.0)
        return self.pressure[k], (1.0 - part) * self.divergent[k] + part * self.divergent[k + 1]


def drift(off: np.ndarray, push: np.ndarray, growth: float) -> np.ndarray:
    """(2,) how far the divergent point is from its plan after it has grown by ``growth`` = exp(w t), if it is ``off``
    (2,) now and the centre of pressure is ``push`` (2,) off for so long."""
    return off * growth - push * (growth - 1.0)


def nearest_in_hull(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(2,) the point of the convex hull of ``points`` (k, 2), which may lie in a line, that is nearest to ``place``
    (2,)."""
    if is_line(points):
        middle = points.mean(axis=0)
        along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
        ways = (points - middle) @ along
        return middle + np.clip((place - middle) @ along, ways.min(), ways.max()) * along
    hull = ConvexHull(points)
    if np.all(hull.equations[:, :2] @ place + hull.equations[:, 2] <= 0.0):
        return place
    corners = points[hull.vertices]
    sides = np.roll(corners, -1, axis=0) - corners
    along = np.einsum("ki,ki->k", place - corners, sides) / np.einsum("ki,ki->k", sides, sides)
    candidates = corners + np.clip(along, 0.0, 1.0)[:, None] * sides
    return candidates[np.argmin(np.linalg.norm(candidates - place, axis=1))]


def is_line(points: np.ndarray) -> bool:
    """Whether ``points`` (k, 2) span no area."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) < 3 or bool(spread[1] <= _FLAT * spread[0])
