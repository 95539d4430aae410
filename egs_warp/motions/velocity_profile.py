"""When a body is to be where on its way: as fast as it may, gathering and losing speed evenly, slower at corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_SAMPLES = 8
"""Of each stretch of the way."""


@dataclass(frozen=True)
class ProfileSample:
    """Where it is to be, and how it goes; along the ground."""

    place: np.ndarray
    """(2,) metres."""
    velocity: np.ndarray
    """(2,) m/s."""
    acceleration: np.ndarray
    """(2,) m/s^2."""


@dataclass(frozen=True)
class VelocityProfile:
    """A way of n points in time; from rest to rest, standing still before and after."""

    points: np.ndarray
    """(n, 2) metres."""
    speeds: np.ndarray
    """(n,) m/s at the points; between two of them speed changes evenly."""
    times: np.ndarray
    """(n,) seconds at the points."""

    @classmethod
    def of(cls, way: np.ndarray, *, speed: float, acceleration: float) -> VelocityProfile:
        """Along the points ``way`` (k, 2), metres, at no more than ``speed`` m/s, gathered and lost by ``push`` m/s^2;
        past a corner only as fast as it goes on the same way, beyond a right angle from rest."""
        steps = np.diff(way, axis=0)
        kept = np.flatnonzero(np.linalg.norm(steps, axis=1) > 1e-12)
        if not len(kept):
            return cls(way[:1], np.zeros(1), np.zeros(1))
        corners = np.concatenate([way[kept], way[kept[-1] + 1 : kept[-1] + 2]])
        steps = np.diff(corners, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        ways = steps / lengths[:, None]
        parts = np.arange(_SAMPLES) / _SAMPLES
        points = np.concatenate([(corners[:-1, None] + parts[:, None] * steps[:, None]).reshape(-1, 2), corners[-1:]])
        gaps = np.repeat(lengths / _SAMPLES, _SAMPLES)
        squares = np.full(len(points), speed**2)
        squares[_SAMPLES:-1:_SAMPLES] *= np.maximum((ways[1:] * ways[:-1]).sum(axis=1), 0.0) ** 2
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
        """In all."""
        return float(self.times[-1])

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @property
    def top_speed(self) -> float:
        """m/s."""
        return float(self.speeds.max())

    def at(self, elapsed: float) -> ProfileSample:
        """``elapsed`` seconds after the start."""
        if elapsed <= 0.0 or elapsed >= self.seconds:
            still = np.zeros(2)
            return ProfileSample(self.points[0 if elapsed <= 0.0 else -1], still, still)
        k = int(np.searchsorted(self.times, elapsed, side="right")) - 1
        step = self.points[k + 1] - self.points[k]
        ahead = step / np.linalg.norm(step)
        past, span = elapsed - self.times[k], self.times[k + 1] - self.times[k]
        push = (self.speeds[k + 1] - self.speeds[k]) / span
        gone = self.speeds[k] * past + 0.5 * push * past**2
        return ProfileSample(self.points[k] + gone * ahead, (self.speeds[k] + push * past) * ahead, push * ahead)
