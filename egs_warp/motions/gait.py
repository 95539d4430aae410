"""A walk as footprints and the even way of the centre of mass between them: geometry and time alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import ConvexHull

_CARRIED_FROM, _CARRIED = 0.2, 0.6
"""Parts of a swing: when a foot begins to be carried ahead, and for how long."""


@dataclass(frozen=True)
class Gait:
    """Diagonal pairs of feet swing in turn. Each step sets a pair ``step_length`` ahead of the other;
    one more swing closes the feet.
    """

    steps: int
    step_length: float
    """Metres; a stride, from one footprint of a foot to its next, is two of them."""
    swing_time: float
    """Seconds."""
    double_time: float
    """Seconds that all feet stand between two swings."""
    lift: float
    """Metres a foot is lifted."""

    @classmethod
    def of(cls, steps: int, step_length: float, *, height: float, gravity: float) -> Gait:
        """The gait of a body of ``height`` metres under ``gravity`` m/s^2."""
        time_unit = float(np.sqrt(height / gravity))
        return cls(steps, step_length, 0.94 * time_unit, 0.78 * time_unit, 0.03 * height)

    @property
    def swings(self) -> int:
        """Swings in all."""
        return self.steps + 1

    @property
    def carried_from(self) -> float:
        """Seconds into a swing at which the foot goes ahead."""
        return _CARRIED_FROM * self.swing_time

    @property
    def carried_until(self) -> float:
        """Seconds into a swing at which it is over its next footprint."""
        return (_CARRIED_FROM + _CARRIED) * self.swing_time

    @property
    def distance(self) -> float:
        """Metres."""
        return self.steps * self.step_length

    @property
    def stride(self) -> float:
        """Metres between two footprints of one foot."""
        return 2.0 * self.step_length

    @property
    def speed(self) -> float:
        """m/s of the centre of mass, from the first swing to the last."""
        return self.step_length / (self.swing_time + self.double_time)

    def landing(self, swing: int) -> float:
        """Metres ahead of its start at which the pair that makes swing ``swing`` (0, 1, ...) lands."""
        return min(swing + 1, self.steps) * self.step_length

    def place(self, swing: int, elapsed: float) -> float:
        """Metres ahead of the start at which the centre of mass should be ``elapsed`` seconds after ``swing`` began.

        In the middle of a swing it is over the standing pair.
        """
        return swing * self.step_length + self.speed * (elapsed - 0.5 * self.swing_time)

    def lifted(self, progress: float) -> float:
        """Metres a foot is above the ground when ``progress`` (0 to 1) of its swing is over;
        it leaves and lands at rest.
        """
        return self.lift * float(_smooth(progress / 0.4) * (1.0 - _smooth((progress - 0.65) / 0.35)))

    @staticmethod
    def carried(progress: float) -> float:
        """Part of its way that a foot has gone when ``progress`` (0 to 1) of its swing is over; it has arrived before
        it lands, lest an early touch of the ground drag it."""
        return float(_smooth((progress - _CARRIED_FROM) / _CARRIED))

    @staticmethod
    def eased(progress: float) -> float:
        """Part to which a foot is steered to its place when ``progress`` (0 to 1) of its swing is over."""
        return float(_smooth(progress / 0.3))


def _smooth(s: float) -> float:
    """From 0 at 0 to 1 at 1, at rest and without acceleration at both."""
    s = float(np.clip(s, 0.0, 1.0))
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


@dataclass(frozen=True)
class Passage:
    """A smooth way from one place and velocity to another."""

    start: np.ndarray
    start_velocity: np.ndarray
    end: np.ndarray
    end_velocity: np.ndarray
    duration: float
    """Seconds."""

    def at(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Place and velocity ``elapsed`` seconds after the start, on a cubic."""
        cubic = CubicHermiteSpline(
            [0.0, self.duration], [self.start, self.end], [self.start_velocity, self.end_velocity]
        )
        elapsed = float(np.clip(elapsed, 0.0, self.duration))
        return cubic(elapsed), cubic(elapsed, 1)


def nearest_in_hull(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(2,) the point of the convex hull of ``points`` (k, 2) that is nearest to ``place`` (2,)."""
    hull = ConvexHull(points)
    if np.all(hull.equations[:, :2] @ place + hull.equations[:, 2] <= 0.0):
        return place
    corners = points[hull.vertices]
    sides = np.roll(corners, -1, axis=0) - corners
    along = np.einsum("ki,ki->k", place - corners, sides) / np.einsum("ki,ki->k", sides, sides)
    candidates = corners + np.clip(along, 0.0, 1.0)[:, None] * sides
    return candidates[np.argmin(np.linalg.norm(candidates - place, axis=1))]
