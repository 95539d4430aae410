"""Timing of a gait, in which groups of feet swing in turn."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GaitTiming:
    """Timing of a gait."""

    swing_time: float
    """Duration of a swing, in sqrt(H / g)."""
    double_support_time: float
    """Time for which all feet stand after a swing, in sqrt(H / g)."""
    transfer_start: float
    """Fraction of a swing at which the foot starts to move forward."""
    transfer_fraction: float
    """Fraction of a swing during which the foot moves forward. It ends before the landing, so that an early contact
    does not drag the foot."""


def feet_in_turn(count: int) -> tuple[tuple[int, ...], ...]:
    """Return the groups of feet that swing together; ``count`` feet are numbered around the body.

    Two and three feet swing one by one. With a larger even number, every other foot swings at the same time, so that
    four feet trot diagonally. With a larger odd number, the last foot swings alone.
    """
    if count <= 3:
        return tuple((foot,) for foot in range(count))
    even = count - count % 2
    groups = (tuple(range(0, even, 2)), tuple(range(1, even, 2)))
    return groups if even == count else (*groups, (even,))


@dataclass(frozen=True)
class Gait:
    """Gait in which groups of feet swing in turn.

    Each swing sets a group of feet down one step ahead of the group of the previous swing; the last swings bring all
    feet together.
    """

    groups: tuple[tuple[int, ...], ...]
    step_count: int
    swing_time: float
    """Duration of a swing, s."""
    double_time: float
    """Time for which all feet stand between two swings, s."""
    lift: float
    """Height to which a foot is lifted, m."""
    window: tuple[float, float]
    """Fractions of a swing between which a foot moves forward."""

    @classmethod
    def create(cls, feet: int, step_count: int, lift: float, timing: GaitTiming, *, time_unit: float) -> Gait:
        """Create the gait.

        Args:
            feet: number of feet.
            step_count: number of steps.
            lift: height to which a foot is lifted, m.
            timing: timing of the gait.
            time_unit: sqrt(H / g), s.
        """
        window = (timing.transfer_start, timing.transfer_start + timing.transfer_fraction)
        return cls(
            feet_in_turn(feet),
            step_count,
            timing.swing_time * time_unit,
            timing.double_support_time * time_unit,
            lift,
            window,
        )

    @property
    def swings(self) -> int:
        """Total number of swings."""
        return self.step_count + len(self.groups) - 1

    def swing_feet(self, swing: int) -> tuple[int, ...]:
        """Return the indices of the feet that swing in swing number ``swing``, counted from 0."""
        return self.groups[swing % len(self.groups)]

    def target_step(self, swing: int) -> int:
        """Return the index of the step at whose planar pose the feet of swing number ``swing`` land."""
        return min(swing + 1, self.step_count)

    def progress(self, swing: int, elapsed: float) -> float:
        """Return the number of steps that the body should have completed ``elapsed`` seconds after ``swing`` began.

        The progress is uniform; in the middle of a swing, it equals the mean progress of the feet over the swing.
        """
        done = swing + 1.0 - 0.5 * len(self.groups)
        return done + (elapsed - 0.5 * self.swing_time) / (self.swing_time + self.double_time)

    @property
    def transfer_start_time(self) -> float:
        """Time in a swing at which the foot starts to move forward, s."""
        return self.window[0] * self.swing_time

    @property
    def transfer_end_time(self) -> float:
        """Time in a swing at which the foot is over its next footprint, s."""
        return self.window[1] * self.swing_time

    def foot_height(self, progress: float) -> float:
        """Return the height in metres of a foot after a fraction ``progress`` (0 to 1) of its swing; the velocity is
        zero at lift-off and landing."""
        return self.lift * smooth(progress / 0.4) * (1.0 - smooth((progress - 0.65) / 0.35))

    def transfer_progress(self, progress: float) -> float:
        """Return the fraction of its displacement that a foot has completed after a fraction ``progress`` (0 to 1) of
        its swing."""
        start, end = self.window
        return smooth((progress - start) / (end - start))

    @staticmethod
    def steering_progress(progress: float) -> float:
        """Return the weight with which a foot is steered to its target after a fraction ``progress`` (0 to 1) of its
        swing."""
        return smooth(progress / 0.3)


def smooth(s: float) -> float:
    """Quintic smoothstep: from 0 at 0 to 1 at 1, with zero slope and curvature at both ends; clamped outside."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
