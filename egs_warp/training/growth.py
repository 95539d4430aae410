"""How many Gaussians a scene gets: as many as asked, or as long as its pictures gain by more of them."""

from __future__ import annotations

import os

import numpy as np
import torch

from egs_warp.training.checkpoint import State

_LEAST_STEPS = 300
"""Steps whose losses are compared, in whole rounds of the views."""
_LEAST_GAIN = 0.02
"""Relative fall of the loss for each e-fold of Gaussians below which more are not worth their time."""
_WINDOWS = 2
"""Comparisons in a row that must say so."""
_BYTES_EACH = 4000
"""Parameters, gradients, Adam's moments, and the renderer's arrays of one Gaussian in training."""


class Growth:
    """The cap on the number of Gaussians, which falls to what is there once the pictures no longer gain."""

    def __init__(self, views: int, asked: int | None, device: str) -> None:
        self.asked = asked
        self.cap = asked if asked is not None else _room(device)
        self.history: list[tuple[float, int]] = []
        self._window = views * -(-_LEAST_STEPS // views)
        self._losses: list[float] = []
        self._idle = 0

    def see(self, loss: float, count: int) -> None:
        """The loss of one more step, made with ``count`` Gaussians."""
        self._losses.append(loss)
        if len(self._losses) < self._window:
            return
        self.history.append((float(np.mean(self._losses)), count))
        self._losses.clear()
        if self.asked is not None or len(self.history) < 2:
            return
        (before, few), (after, many) = self.history[-2:]
        if many > few:
            worth = (1 - after / before) / np.log(many / few)
            self._idle = self._idle + 1 if worth < _LEAST_GAIN else 0
        if self._idle >= _WINDOWS:
            self.cap = min(self.cap, count)

    def state(self) -> State:
        """All that lasts from step to step."""
        return {"cap": self.cap, "history": self.history, "recent": self._losses, "idle": self._idle}

    def restore(self, state: State) -> None:
        """Go on from ``state``."""
        self.cap, self._losses, self._idle = int(state["cap"]), list(state["recent"]), int(state["idle"])
        self.history = [(float(loss), int(count)) for loss, count in state["history"]]


def _room(device: str) -> int:
    """Gaussians for which half of the free memory is enough."""
    if device.startswith("cuda"):
        free = torch.cuda.mem_get_info(torch.device(device))[0]
    else:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return max(1000, int(0.5 * free / _BYTES_EACH))
