"""Control of the number of Gaussians: growth up to a cap that ends earlier if it no longer decreases the loss."""

from __future__ import annotations

import os

import numpy as np
import torch

from egs_warp.training.checkpoint import State

_MIN_STEPS = 300
"""Minimum number of steps over which losses are averaged; it is rounded up to whole rounds of the views."""
_MIN_GAIN = 0.02
"""Minimum relative decrease of the loss when the number of Gaussians grows by a factor of e; a smaller decrease is not
worth the computing time."""
_WINDOWS = 2
"""Number of consecutive comparisons with a decrease below ``_MIN_GAIN`` after which growth ends."""
_BYTES_EACH = 4000
"""Memory of one Gaussian during training, bytes: parameters, gradients, Adam's moments, and the renderer's arrays."""


class Growth:
    """Cap on the number of Gaussians: the requested maximum, or what fits into the memory. It is set to the current
    number as soon as growth no longer decreases the loss."""

    def __init__(self, views: int, requested: int | None, device: str) -> None:
        self._limit = self.cap = requested if requested is not None else _memory_cap(device)
        self.history: list[tuple[float, int]] = []
        self._window = views * -(-_MIN_STEPS // views)
        self._losses: list[float] = []
        self._idle = 0

    def see(self, loss: float, count: int) -> None:
        """Record the loss of one step, computed with ``count`` Gaussians."""
        self._losses.append(loss)
        if len(self._losses) < self._window:
            return
        self.history.append((float(np.mean(self._losses)), count))
        self._losses.clear()
        if len(self.history) < 2:
            return
        (before, few), (after, many) = self.history[-2:]
        if many > few:
            worth = (1 - after / before) / np.log(many / few)
            self._idle = self._idle + 1 if worth < _MIN_GAIN else 0
        if self._idle >= _WINDOWS:
            self.cap = min(self.cap, count)

    def restart(self) -> None:
        """Clear the recorded losses, because they are not comparable with those at the next resolution. Also lift a cap
        that was derived from these losses, because larger images may need more Gaussians."""
        self._losses.clear()
        self.history.clear()
        self.cap, self._idle = self._limit, 0

    def state(self) -> State:
        """Return the state for a checkpoint."""
        return {"cap": self.cap, "history": self.history, "recent": self._losses, "idle": self._idle}

    def restore(self, state: State) -> None:
        """Restore the ``state`` of a checkpoint."""
        self.cap, self._losses, self._idle = int(state["cap"]), list(state["recent"]), int(state["idle"])
        self.history = [(float(loss), int(count)) for loss, count in state["history"]]


def _memory_cap(device: str) -> int:
    """Return the number of Gaussians that fit into half of the free memory."""
    if device.startswith("cuda"):
        free = torch.cuda.mem_get_info(torch.device(device))[0]
    else:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return max(1000, int(0.5 * free / _BYTES_EACH))
