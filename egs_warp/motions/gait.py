"""A gait as groups of feet that swing in turn, and when: time alone."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GaitTiming:
    """How a gait shares out its time."""

    swing_time: float
    """Of sqrt(H / g): how long a swing takes,"""
    double_support_time: float
    """and how long all feet stand after it."""
    transfer_start: float
    """Parts of a swing: when a foot begins to be carried ahead,"""
    transfer_fraction: float
    """and for how long. It has arrived before it lands, lest an early touch of the ground drag it."""


def feet_in_turn(count: int) -> tuple[tuple[int, ...], ...]:
    """Groups of ``count`` feet, numbered round the body, that swing together: two feet and three one by one, an even
    number every other one, and so four as the diagonals; of an odd number the last goes alone."""
    if count <= 3:
        return tuple((foot,) for foot in range(count))
    even = count - count % 2
    groups = (tuple(range(0, even, 2)), tuple(range(1, even, 2)))
    return groups if even == count else (*groups, (even,))


@dataclass(frozen=True)
class Gait:
    """Groups of feet swing in turn. Each swing sets a group to its place one pace ahead of the last group's; the last
    swings close the feet.
    """

    groups: tuple[tuple[int, ...], ...]
    step_count: int
    swing_time: float
    """Seconds."""
    double_time: float
    """Seconds that all feet stand between two swings."""
    lift: float
    """Metres a foot is lifted."""
    window: tuple[float, float]
    """Parts of a swing between which a foot is carried ahead."""

    @classmethod
    def of(cls, feet: int, paces: int, lift: float, tempo: GaitTiming, *, time_unit: float) -> Gait:
        """The gait on so many ``feet``; ``lift`` in metres, ``time_unit`` seconds, as sqrt(H / g)."""
        window = (tempo.transfer_start, tempo.transfer_start + tempo.transfer_fraction)
        return cls(
            feet_in_turn(feet), paces, tempo.swing_time * time_unit, tempo.double_support_time * time_unit, lift, window
        )

    @property
    def swings(self) -> int:
        """Swings in all."""
        return self.step_count + len(self.groups) - 1

    def swing_feet(self, swing: int) -> tuple[int, ...]:
        """The feet that make swing ``swing`` (0, 1, ...)."""
        return self.groups[swing % len(self.groups)]

    def target_step(self, swing: int) -> int:
        """The pace to whose place the feet of swing ``swing`` come."""
        return min(swing + 1, self.step_count)

    def progress(self, swing: int, elapsed: float) -> float:
        """Paces that the body should have done ``elapsed`` seconds after ``swing`` began, evenly: in the middle of a
        swing it is as far as its feet are in the mean over the swing."""
        done = swing + 1.0 - 0.5 * len(self.groups)
        return done + (elapsed - 0.5 * self.swing_time) / (self.swing_time + self.double_time)

    @property
    def carried_from(self) -> float:
        """Seconds into a swing at which the foot goes ahead."""
        return self.window[0] * self.swing_time

    @property
    def carried_until(self) -> float:
        """Seconds into a swing at which it is over its next footprint."""
        return self.window[1] * self.swing_time

    def foot_height(self, progress: float) -> float:
        """Metres a foot is above the ground when ``progress`` (0 to 1) of its swing is over;
        it leaves and lands at rest.
        """
        return self.lift * smooth(progress / 0.4) * (1.0 - smooth((progress - 0.65) / 0.35))

    def transfer_progress(self, progress: float) -> float:
        """Part of its way that a foot has gone when ``progress`` (0 to 1) of its swing is over."""
        start, end = self.window
        return smooth((progress - start) / (end - start))

    @staticmethod
    def steering_progress(progress: float) -> float:
        """Part to which a foot is steered to its place when ``progress`` (0 to 1) of its swing is over."""
        return smooth(progress / 0.3)


def smooth(s: float) -> float:
    """From 0 at 0 to 1 at 1, at rest and without acceleration at both."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
