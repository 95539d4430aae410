"""Estimate of the number of frames of a run while it is simulated, for progress bars."""

from __future__ import annotations

from collections.abc import Sequence

from egs_warp.locomotion.rollout import REST_FRAMES
from egs_warp.motions.sequence import MotionSequence


class RemainingFrames:
    """Estimate of the number of frames of a sequence that ends when the body is at rest."""

    def __init__(self, sequence: MotionSequence, expected: Sequence[float], *, frame: float, max_frames: int) -> None:
        """Create the estimate.

        Args:
            sequence: The motions.
            expected: Expected time of each motion, s.
            frame: Duration of a frame, s.
            max_frames: Maximum number of frames of the run.
        """
        self._sequence, self._expected, self._frame, self._max_frames = sequence, expected, frame, max_frames
        self._rested: int | None = None

    def frames(self, done: int, *, finished: bool) -> int:
        """Return the expected total number of frames.

        Args:
            done: Number of finished frames.
            finished: True if the body is at rest after the last motion.
        """
        if finished:
            self._rested = done if self._rested is None else self._rested
            last = self._rested + REST_FRAMES - 1
        else:
            left = self._sequence.time_left(done * self._frame, self._expected)
            last = done + round(left / self._frame) + REST_FRAMES
        return min(last, self._max_frames)
