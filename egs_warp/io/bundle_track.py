"""Positions of the nodes of a cage over time, stored as residuals of a prediction (docs/concepts/bundle.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from egs_warp.io.bundle_arrays import PackedArray, indices, quantised

PARENTS = 6
"""Number of nodes from which the displacement of a node is predicted."""
WEIGHT_STEP = 1.0 / 64.0
"""Quantisation step of the weights, which are between -2 and 127/64. The step is a power of two, so that a prediction
is exact in double precision and every reader rounds it to the same number."""
_WEIGHT_ZERO = 128
"""Integer that represents a weight of 0 in the file."""
_LEVELS = 65535
"""Number of quantisation steps along the space diagonal of the body at rest, divided by the square root of 3."""
_FIT_ROUNDS = 5
"""Rounds of reweighted least squares with which the weights are fitted."""
_SMALL_RESIDUAL = 2.0
"""Residual, in steps, below which the loss of the fit is quadratic instead of absolute."""


@dataclass(frozen=True)
class TrackPredictor:
    """Prediction of the displacement of each node from the displacements of earlier nodes in a fixed order."""

    order: np.ndarray
    """(N,) int64, node at each position of the order."""
    parents: np.ndarray
    """(N, PARENTS) int64, positions in the order of the nodes from which each node is predicted, smaller than its own
    position; 0 where the weight is 0."""
    weights: np.ndarray
    """(N, PARENTS) float64, multiples of 1/64."""

    @classmethod
    def fitted(cls, rest: np.ndarray, displacements: np.ndarray) -> TrackPredictor:
        """Return a predictor with small residuals.

        The order starts with the node nearest to the centre, and each further node is the one farthest from those
        before it, so that most nodes lie between their parents. The parents of a node are the nearest nodes before it.
        The weights approximately minimise the sum of the absolute residuals.

        Args:
            rest: (N, 3) rest positions.
            displacements: (F, N, 3) displacements from each frame to the next, in steps.
        """
        count = len(rest)
        order = _farthest_first(rest)
        parents, weights = np.zeros((count, PARENTS), np.int64), np.zeros((count, PARENTS))
        ordered, points = displacements[:, order].astype(np.float64), rest[order]
        for k in range(1, count):
            distances = np.sum((points[:k] - points[k]) ** 2, axis=1)
            nearest = np.argsort(distances, kind="stable")[:PARENTS]
            parents[k, : len(nearest)] = nearest
            # Displacements are relative to the nearest parent, so that the weights sum to 1 and a translation leaves no
            # residual.
            relative = ordered[:, nearest] - ordered[:, nearest[:1]]
            target = ordered[:, k] - ordered[:, nearest[0]]
            weights[k, : len(nearest)] = _whole_weights(relative.transpose(0, 2, 1).reshape(target.size, -1), target)
        return cls(order, parents, weights)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, PackedArray]) -> TrackPredictor:
        """Return the predictor in the ``arrays`` of a body."""
        order, parents = (arrays[name].stored.astype(np.int64) for name in ("order", "parents"))
        return cls(order, parents, arrays["weights"].numbers)

    def arrays(self) -> dict[str, PackedArray]:
        """Return the arrays that store this predictor."""
        lower = -_WEIGHT_ZERO * WEIGHT_STEP
        return {
            "order": indices(self.order),
            "parents": indices(self.parents),
            "weights": quantised(self.weights, np.uint8, step=WEIGHT_STEP, lower=lower),
        }

    def residuals(self, displacements: np.ndarray) -> PackedArray:
        """Pack the residuals of ``displacements`` (f, N, 3): flat, by frame, position in the order and axis.

        An even stored number s stands for the residual s / 2, an odd one for -(s + 1) / 2.
        """
        ordered = displacements[:, self.order]
        residuals = ordered.copy()
        for k in range(1, len(self.order)):
            residuals[:, k] -= self._prediction(ordered, k)
        return indices(np.where(residuals < 0, -1 - 2 * residuals, 2 * residuals).reshape(-1))

    def displacements(self, residuals: PackedArray) -> np.ndarray:
        """Return the displacements (f, N, 3) int64 of ``residuals``."""
        stored = residuals.stored.astype(np.int64).reshape(-1, len(self.order), 3)
        ordered = np.where(stored % 2 == 1, -(stored + 1) // 2, stored // 2)
        for k in range(1, len(self.order)):
            ordered[:, k] += self._prediction(ordered, k)
        displacements = np.empty_like(ordered)
        displacements[:, self.order] = ordered
        return displacements

    def _prediction(self, ordered: np.ndarray, k: int) -> np.ndarray:
        """Return the predicted displacements (f, 3) of position ``k``, rounded to whole steps."""
        sums = np.einsum("p,fpi->fi", self.weights[k], ordered[:, self.parents[k]])
        return np.floor(sums + 0.5).astype(np.int64)


@dataclass(frozen=True)
class NodeTrack:
    """Positions of the nodes of a body in all frames, in whole steps."""

    step: float
    """Quantisation step of the positions."""
    error: float
    """Maximum distance between the quantised and the original position of a node; at most half the diagonal of the body
    at rest, divided by 65,535."""
    predictor: TrackPredictor
    displacements: np.ndarray
    """(F, N, 3) int64, displacements in steps from the previous frame, or, for the first frame, from the rest pose."""

    @classmethod
    def fitted(cls, rest: np.ndarray, nodes: np.ndarray) -> NodeTrack:
        """Quantise ``nodes`` (F, N, 3) of a body with the ``rest`` positions (N, 3), and fit its predictor."""
        diagonal = float(np.linalg.norm(np.ptp(rest.astype(np.float64), axis=0)))
        step = diagonal / (math.sqrt(3.0) * _LEVELS)
        stored = whole_steps(nodes, step)
        error = float(np.linalg.norm(step * stored - nodes, axis=2).max())
        displacements = np.diff(stored, axis=0, prepend=whole_steps(rest, step)[None])
        return cls(step, error, TrackPredictor.fitted(rest.astype(np.float64), displacements), displacements)


def whole_steps(positions: np.ndarray, step: float) -> np.ndarray:
    """Round ``positions`` to whole numbers of steps, int64; halves are rounded up."""
    return np.floor(positions.astype(np.float64) / step + 0.5).astype(np.int64)


def _farthest_first(points: np.ndarray) -> np.ndarray:
    """Return an order (N,) of ``points``: first the one nearest to their mean, then always the one farthest from all
    previous ones."""
    distances = np.sum((points - points.mean(axis=0)) ** 2, axis=1)
    order = np.empty(len(points), np.int64)
    order[0] = np.argmin(distances)
    distances = np.full(len(points), np.inf)
    for k in range(1, len(points)):
        distances = np.minimum(distances, np.sum((points - points[order[k - 1]]) ** 2, axis=1))
        # Coincident nodes must not be chosen twice.
        distances[order[k - 1]] = -1.0
        order[k] = np.argmax(distances)
    return order


def _whole_weights(features: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return weights (p,) that sum to 1 and approximately minimise the sum of |target - features w|.

    Args:
        features: (m, p) displacements of the parents relative to the first one.
        target: (f, 3) displacements relative to the first parent, with 3 f = m.

    Returns:
        Multiples of 1/64 between -2 and 127/64. If a fitted weight exceeds these limits, the first weight is 1 and the
        others are 0.
    """
    others = _least_deviations(features[:, 1:], target.reshape(-1))
    stored = np.rint(others / WEIGHT_STEP)
    stored = np.concatenate([[1.0 / WEIGHT_STEP - stored.sum()], stored])
    if stored.min() < -_WEIGHT_ZERO or stored.max() >= _WEIGHT_ZERO:
        stored = np.where(np.arange(len(stored)) == 0, 1.0 / WEIGHT_STEP, 0.0)
    return WEIGHT_STEP * stored


def _least_deviations(features: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return weights w (k,) that approximately minimise the sum of |values - features w|, for (m, k) features."""
    share, weights = np.ones(len(values)), np.zeros(features.shape[1])
    if weights.size == 0:
        return weights
    for _ in range(_FIT_ROUNDS):
        matrix = features.T @ (share[:, None] * features)
        # The regularisation limits the weights of nodes that move alike.
        matrix[np.diag_indices_from(matrix)] += 1e-6 * np.mean(np.diag(matrix)) + 1e-3
        weights = np.linalg.solve(matrix, features.T @ (share * values))
        share = 1.0 / np.maximum(np.abs(values - features @ weights), _SMALL_RESIDUAL)
    return weights
