"""Linear inverted pendulum model of a walking body: c'' = w^2 (c - p), with centre of mass c and centre of pressure p.

The divergent component of motion is x = c + c' / w, with x' = w (x - p). It is the instantaneous capture point of Pratt
et al. (2006). Plans of this component follow Englsberger et al. (2015), "Three-dimensional bipedal walking control
based on divergent component of motion".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
        """Return the unique plan with the centres of pressure ``pressure`` (n, 2) whose motion does not diverge after
        the last interval. ``rate`` is w, 1/s."""
        divergent = np.empty((len(pressure) + 1, 2))
        divergent[-1] = pressure[-1]
        shrink = np.exp(-rate * step)
        for k in reversed(range(len(pressure))):
            divergent[k] = pressure[k] + shrink * (divergent[k + 1] - pressure[k])
        return cls(step, pressure, divergent)

    def at(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre of pressure (2,) and the divergent component (2,) ``elapsed`` seconds after the start."""
        k = min(int(elapsed / self.step), len(self.pressure) - 1)
        part = min(elapsed / self.step - k, 1.0)
        return self.pressure[k], (1.0 - part) * self.divergent[k] + part * self.divergent[k + 1]


@dataclass(frozen=True)
class FallingPendulum:
    """Pendulum whose capture point has left the support, so that the body tips over an edge: p is constant.

    With the components x = c + c' / w and y = c - c' / w, x - p grows as exp(w t) and y - p decreases as exp(-w t).
    """

    com: np.ndarray
    """(2,) m, centre of mass."""
    capture: np.ndarray
    """(2,) m, capture point."""
    edge: np.ndarray
    """(2,) m, centre of pressure: the point of the support that is nearest to the capture point."""
    rate: float
    """w, 1/s, rate of the pendulum."""

    def capture_at(self, time: float) -> np.ndarray:
        """Return the capture point (2,) in metres after ``time`` s."""
        return self.edge + np.exp(self.rate * time) * (self.capture - self.edge)

    def com_at(self, time: float) -> np.ndarray:
        """Return the centre of mass (2,) in metres after ``time`` s."""
        convergent = self.edge + np.exp(-self.rate * time) * (2.0 * self.com - self.capture - self.edge)
        return 0.5 * (self.capture_at(time) + convergent)

    def velocity_at(self, time: float) -> np.ndarray:
        """Return the velocity (2,) in m/s of the centre of mass after ``time`` s."""
        return self.rate * (self.capture_at(time) - self.com_at(time))


def drift(off: np.ndarray, push: np.ndarray, growth: float) -> np.ndarray:
    """Predict the error (2,) of the divergent component.

    Args:
        off: (2,) m, present error.
        push: (2,) m, constant error of the centre of pressure.
        growth: exp(w t) for the time t of the prediction.
    """
    return off * growth - push * (growth - 1.0)


def max_lag(distances: np.ndarray, step: float, rate: float) -> float:
    """Return the largest lag in metres of the divergent component behind its plan that the centre of pressure can
    correct until the end of the plan, if it stays at the rear edge of the support: x' = w (x - p) integrated over the
    difference of the centres of pressure.

    Args:
        distances: (n,) m, distances of the planned centres of pressure from the rear edge, one every ``step`` seconds.
        step: s.
        rate: w, 1/s.
    """
    times = step * np.arange(len(distances))
    return float(distances @ (np.exp(-rate * times) - np.exp(-rate * (times + step))))


def momentum_as_velocity(momentum: np.ndarray, mass: float, height: np.ndarray | float) -> np.ndarray:
    """Return the velocity (..., 2) m/s of the centre of mass along the ground that contributes as much to the angular
    momentum about a point on the ground as the angular momentum about the centre of mass does.

    Args:
        momentum: (..., 3) kg m^2/s, angular momentum about the centre of mass, ground axes.
        mass: mass of the body, kg.
        height: (...,) m, height of the centre of mass above the point.
    """
    turning = momentum / np.asarray(mass * height)[..., None]
    return np.stack([turning[..., 1], -turning[..., 0]], axis=-1)


def capture_point(com: np.ndarray, velocity: np.ndarray, rate: np.ndarray | float) -> np.ndarray:
    """Return the point (..., 2) over which a pendulum with its centre of mass at ``com`` (..., 2) m, moving at
    ``velocity`` (..., 2) m/s, comes to rest; ``rate`` (...,) is w, 1/s."""
    return com + velocity / np.asarray(rate)[..., None]
