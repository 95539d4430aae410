"""Velocity profile along a path: as fast as the limits of speed and acceleration allow, and slower at corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_SAMPLES = 8
"""Number of samples per segment of the path."""


@dataclass(frozen=True)
class ProfileSample:
    """Target position, velocity and acceleration along the ground at one time."""

    position: np.ndarray
    """(2,) m, position."""
    velocity: np.ndarray
    """(2,) m/s, velocity."""
    acceleration: np.ndarray
    """(2,) m/s^2, acceleration."""


@dataclass(frozen=True)
class VelocityProfile:
    """Velocity profile along n points, which starts and ends at rest. The position is constant before the start and
    after the end."""

    points: np.ndarray
    """(n, 2) m, points of the path."""
    speeds: np.ndarray
    """(n,) m/s, speeds at the points; acceleration is constant between two points."""
    times: np.ndarray
    """(n,) s, times at the points."""

    @classmethod
    def from_path(cls, path: np.ndarray, *, speed: float, acceleration: float) -> VelocityProfile:
        """Compute the profile along a path.

        At a corner, the speed is at most ``speed`` times the cosine of the change of direction; at a right angle or
        more, the body stops.

        Args:
            path: (k, 2) m, points of the path.
            speed: largest speed, m/s.
            acceleration: acceleration and deceleration, m/s^2.
        """
        steps = np.diff(path, axis=0)
        moving = np.flatnonzero(np.linalg.norm(steps, axis=1) > 1e-12)
        if not len(moving):
            return cls(path[:1], np.zeros(1), np.zeros(1))
        corners = np.concatenate([path[moving], path[moving[-1] + 1 : moving[-1] + 2]])
        steps = np.diff(corners, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        directions = steps / lengths[:, None]
        parts = np.arange(_SAMPLES) / _SAMPLES
        points = np.concatenate([(corners[:-1, None] + parts[:, None] * steps[:, None]).reshape(-1, 2), corners[-1:]])
        gaps = np.repeat(lengths / _SAMPLES, _SAMPLES)
        squares = np.full(len(points), speed**2)
        squares[_SAMPLES:-1:_SAMPLES] *= np.maximum((directions[1:] * directions[:-1]).sum(axis=1), 0.0) ** 2
        squares[0] = squares[-1] = 0.0
        for k, gap in enumerate(gaps):
            squares[k + 1] = min(squares[k + 1], squares[k] + 2.0 * acceleration * gap)
        for k in reversed(range(len(gaps))):
            squares[k] = min(squares[k], squares[k + 1] + 2.0 * acceleration * gaps[k])
        speeds = np.sqrt(squares)
        times = np.concatenate([[0.0], np.cumsum(2.0 * gaps / (speeds[1:] + speeds[:-1]))])
        return cls(points, speeds, times)

    @property
    def seconds(self) -> float:
        """Total duration, s."""
        return float(self.times[-1])

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @property
    def top_speed(self) -> float:
        """Largest speed, m/s."""
        return float(self.speeds.max())

    def at(self, elapsed: float) -> ProfileSample:
        """Return the sample ``elapsed`` seconds after the start."""
        if elapsed <= 0.0 or elapsed >= self.seconds:
            still = np.zeros(2)
            return ProfileSample(self.points[0 if elapsed <= 0.0 else -1], still, still)
        k = int(np.searchsorted(self.times, elapsed, side="right")) - 1
        step = self.points[k + 1] - self.points[k]
        ahead = step / np.linalg.norm(step)
        past, span = elapsed - self.times[k], self.times[k + 1] - self.times[k]
        push = (self.speeds[k + 1] - self.speeds[k]) / span
        distance = self.speeds[k] * past + 0.5 * push * past**2
        return ProfileSample(self.points[k] + distance * ahead, (self.speeds[k] + push * past) * ahead, push * ahead)
