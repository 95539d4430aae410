"""Photos that do not fit the others, by what is left of them when all others fit.

Their pose is wrong, or something moved.
"""

from __future__ import annotations

import numpy as np

from egs_warp.training.checkpoint import State

_JUDGED_AT = (0.3, 0.5, 0.7)
"""Shares of the steps."""
_LAST_VISITS = 3
_TIMES_MEDIAN = 1.8
_SPREADS = 3.0
"""Robust standard deviations of the logarithm."""
_MOST = 0.1
"""Share of the photos that may be left out: where more do not fit, it is not they."""


class OutlierViews:
    """Watches the losses of all views; ``found`` are those to leave out."""

    def __init__(self, count: int) -> None:
        self.found: list[int] = []
        self._losses: list[list[float]] = [[] for _ in range(count)]
        self._judged = 0

    def update(self, number: int, loss: float) -> None:
        """The loss of view ``number`` at one more visit."""
        self._losses[number].append(loss)

    def find(self, done: float) -> None:
        """At three times on the way (``done`` is the share of the steps) find the views that stay behind."""
        if self._judged == len(_JUDGED_AT) or done < _JUDGED_AT[self._judged]:
            return
        self._judged += 1
        numbers = [n for n, seen in enumerate(self._losses) if n not in self.found and len(seen) >= _LAST_VISITS]
        values = np.array([np.mean(self._losses[n][-_LAST_VISITS:]) for n in numbers])
        room = int(_MOST * len(self._losses)) - len(self.found)
        worst = np.array(numbers)[is_outlier(values)]
        self.found += sorted(worst.tolist(), key=lambda n: -np.mean(self._losses[n][-_LAST_VISITS:]))[: max(room, 0)]

    def state(self) -> State:
        """All that lasts from step to step."""
        return {"found": self.found, "losses": self._losses, "judged": self._judged}

    def restore(self, state: State) -> None:
        """Go on from ``state``."""
        self.found, self._losses, self._judged = list(state["found"]), state["losses"], int(state["judged"])


def is_outlier(losses: np.ndarray) -> np.ndarray:
    """(n,) bool of the ``losses`` (n,) that lie far above the others; nowhere among fewer than eight."""
    if len(losses) < 8:
        return np.zeros(len(losses), bool)
    logarithms = np.log(np.maximum(losses, 1e-12))
    median = np.median(logarithms)
    spread = 1.4826 * np.median(np.abs(logarithms - median))
    return logarithms - median > max(np.log(_TIMES_MEDIAN), _SPREADS * spread)
