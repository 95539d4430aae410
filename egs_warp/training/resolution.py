"""Resolution schedule of a training run: the first steps compare reduced images, which cost less and suffice until the
coarse shape has been found."""

from __future__ import annotations

from collections.abc import Sequence

from egs_warp.training.training_view import TrainingView

_SCHEDULE = ((0.1, 4), (0.3, 2))
"""Pairs of a fraction of the steps and a factor: until this fraction is reached, both sides of the images are divided
by the factor."""
_MIN_SIDE = 64
"""Minimum length of the longer side of a reduced image, pixels."""


class ResolutionSchedule:
    """Schedule of the factor by which the sides of all ``views`` are divided, over ``steps`` steps."""

    def __init__(self, views: Sequence[TrainingView], steps: int) -> None:
        side = min(max(view.camera.width, view.camera.height) for view in views) if steps > 0 else 0
        self._schedule = [(until * steps, factor) for until, factor in _SCHEDULE if side >= factor * _MIN_SIDE]

    @property
    def factors(self) -> set[int]:
        """All factors that occur in the schedule."""
        return {1, *(factor for _, factor in self._schedule)}

    def factor(self, step: int) -> int:
        """Return the factor at ``step``."""
        return next((factor for until, factor in self._schedule if step < until), 1)
