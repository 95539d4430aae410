"""Detection of outlier photos: their loss remains high when all others fit, because their pose is wrong or something
moved."""

from __future__ import annotations

import numpy as np

from egs_warp.training.checkpoint import State

_JUDGED_AT = (0.3, 0.5, 0.7)
"""Fractions of the steps after which outliers are determined."""
_LAST_VISITS = 3
_TIMES_MEDIAN = 1.8
_SPREADS = 3.0
"""Minimum distance of an outlier's loss from the median, in robust standard deviations of the logarithm of the loss."""
_MAX_EXCLUDED_FRACTION = 0.1
"""Maximum fraction of the photos that may be excluded."""


class OutlierViews:
    """Record of the losses of all views; ``indices`` contains the views to exclude."""

    def __init__(self, count: int) -> None:
        self.indices: list[int] = []
        self._losses: list[list[float]] = [[] for _ in range(count)]
        self._judged = 0

    def update(self, number: int, loss: float) -> None:
        """Record the loss of view ``number`` in one step."""
        self._losses[number].append(loss)

    def find(self, done: float) -> None:
        """Search for views with high losses when the fractions ``_JUDGED_AT`` of the steps are reached. ``done`` is the
        current fraction, 0 to 1."""
        if self._judged == len(_JUDGED_AT) or done < _JUDGED_AT[self._judged]:
            return
        self._judged += 1
        numbers = [n for n, losses in enumerate(self._losses) if n not in self.indices and len(losses) >= _LAST_VISITS]
        values = np.array([np.mean(self._losses[n][-_LAST_VISITS:]) for n in numbers])
        remaining = int(_MAX_EXCLUDED_FRACTION * len(self._losses)) - len(self.indices)
        worst = np.array(numbers)[is_outlier(values)]
        self.indices += sorted(worst.tolist(), key=lambda n: -np.mean(self._losses[n][-_LAST_VISITS:]))[
            : max(remaining, 0)
        ]

    def state(self) -> State:
        """Return the state for a checkpoint."""
        return {"found": self.indices, "losses": self._losses, "judged": self._judged}

    def restore(self, state: State) -> None:
        """Restore the ``state`` of a checkpoint."""
        self.indices, self._losses, self._judged = list(state["found"]), state["losses"], int(state["judged"])


def is_outlier(losses: np.ndarray) -> np.ndarray:
    """Return the mask (n,) bool of ``losses`` (n,) that are far above the others; all False for fewer than eight
    losses."""
    if len(losses) < 8:
        return np.zeros(len(losses), bool)
    logarithms = np.log(np.maximum(losses, 1e-12))
    median = np.median(logarithms)
    spread = 1.4826 * np.median(np.abs(logarithms - median))
    return logarithms - median > max(np.log(_TIMES_MEDIAN), _SPREADS * spread)
