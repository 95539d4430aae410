"""Resolution schedule of a training: its first steps compare reduced images, which cost less and suffice until the
coarse shape is found."""

from __future__ import annotations

from collections.abc import Sequence

from egs_warp.training.training_view import TrainingView

_SCHEDULE = ((0.1, 4), (0.3, 2))
"""Pairs of a fraction of the steps and a factor: up to this fraction, both sides of the images are divided by it."""
_MIN_SIDE = 64
"""Minimum longer side of a reduced image, pixels."""


class ResolutionSchedule:
    """The factor by which the sides of all ``views`` are divided at each of ``steps`` steps."""

    def __init__(self, views: Sequence[TrainingView], steps: int) -> None:
        side = min(max(view.camera.width, view.camera.height) for view in views) if steps > 0 else 0
        self._schedule = [(until * steps, factor) for until, factor in _SCHEDULE if side >= factor * _MIN_SIDE]

    @property
    def factors(self) -> set[int]:
        """All factors of the schedule."""
        return {1, *(factor for _, factor in self._schedule)}

    def factor(self, step: int) -> int:
        """Return the factor at ``step``."""
        return next((factor for until, factor in self._schedule if step < until), 1)
