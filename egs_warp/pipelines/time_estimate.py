"""How long a run will be, told while it goes: for progress bars whose time left is to be believed."""

from __future__ import annotations

from collections.abc import Sequence

from egs_warp.locomotion.rollout import REST_FRAMES
from egs_warp.motions.sequence import MotionSequence


class RemainingFrames:
    """Counts the frames to come of a sequence that ends at rest."""

    def __init__(self, sequence: MotionSequence, expected: Sequence[float], *, frame: float, most: int) -> None:
        """``expected``: seconds that each motion takes; ``frame``: seconds of one; after ``most`` it is cut off."""
        self._sequence, self._expected, self._frame, self._most = sequence, expected, frame, most
        self._rested: int | None = None

    def frames(self, done: int, *, finished: bool) -> int:
        """In all, once ``done`` are; ``finished``: whether the body lies or stands at rest for good."""
        if finished:
            self._rested = done if self._rested is None else self._rested
            last = self._rested + REST_FRAMES - 1
        else:
            left = self._sequence.time_left(done * self._frame, self._expected)
            last = done + round(left / self._frame) + REST_FRAMES
        return min(last, self._most)
