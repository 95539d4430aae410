"""Exposure and white balance of each photo, optimised together with the cloud."""

from __future__ import annotations

import numpy as np
import torch

from egs_warp.training.checkpoint import State

_RATE, _LAST_RATE = 1e-2, 1e-4
"""Learning rate of Adam at the start and at the end."""
REGULARIZATION, TYPICAL_OFFSET = 1.0, 0.05
"""Weight w and scale s of the penalty w s^2 log(1 + |o|^2 / s^2) on the distance o of a colour map from the mean map.
Small distances, which also fit reflections and errors of the cloud, are suppressed; the penalty hardly affects the
large distances of photos with another exposure."""


class ExposureModel:
    """One affine colour map (3, 4) for each view. The mean of all maps is constrained to the identity.

    Without that constraint, a darker cloud with brighter maps would fit equally well. Adam updates each map separately,
    so that the map of a view that is not rendered does not drift.
    """

    def __init__(self, count: int, steps: int, device: str) -> None:
        self.offsets = torch.zeros((count, 3, 4), device=device)
        """(views, 3, 4) colour maps minus the identity."""
        self.first, self.second = torch.zeros_like(self.offsets), torch.zeros_like(self.offsets)
        """Adam's moments of the colour maps."""
        self._visits = [0] * count
        self._leaf = torch.zeros((3, 4), device=device)
        self._steps = steps
        self._identity = torch.eye(3, 4, device=device)

    def tensor_for(self, number: int) -> torch.Tensor:
        """Return the colour map (3, 4) of view ``number``, a leaf tensor; ``step`` uses its gradient."""
        self._leaf = leaf = (self._identity + self.offsets[number]).requires_grad_()
        return leaf

    def visit(self, number: int, step: int) -> tuple[float, float]:
        """Count a step with view ``number``. Return the learning rate of its map divided by the bias correction of the
        first moment, and the bias correction of the second moment."""
        self._visits[number] += 1
        visits = self._visits[number]
        rate = _RATE * (_LAST_RATE / _RATE) ** (step / max(self._steps, 1))
        return rate / (1 - 0.9**visits), 1 - 0.99**visits

    @torch.no_grad()
    def step(self, number: int, rate: float, bias: float) -> None:
        """Update the map of view ``number`` with its gradient. Then shift all maps so that their mean remains the
        identity. ``rate`` and ``bias`` are the results of ``visit``."""
        gradient = self._leaf.grad
        assert gradient is not None
        offset = self.offsets[number]
        gradient = gradient + 2 * REGULARIZATION * offset / (1 + offset.square().sum() / TYPICAL_OFFSET**2)
        first = self.first[number].lerp_(gradient, 0.1)
        second = self.second[number].lerp_(gradient.square(), 0.01)
        size = (second / bias).sqrt() + 1e-12
        self.offsets[number] -= rate * first / size
        self.offsets -= self.offsets.mean(dim=0)

    def state(self) -> State:
        """Return the state for a checkpoint."""
        arrays = {"offsets": self.offsets, "first": self.first, "second": self.second}
        return {name: tensor.cpu().numpy().copy() for name, tensor in arrays.items()} | {"visits": self._visits}

    def restore(self, state: State) -> None:
        """Restore the ``state`` of a checkpoint."""
        for name, tensor in (("offsets", self.offsets), ("first", self.first), ("second", self.second)):
            tensor.copy_(torch.from_numpy(state[name]))
        self._visits = list(state["visits"])

    def matrices(self) -> np.ndarray:
        """Return the colour maps of all views, (views, 3, 4) float64."""
        return (self._identity + self.offsets).double().cpu().numpy()
