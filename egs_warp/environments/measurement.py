"""Dimensionless measurement of many worlds of one body: the observation of an environment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.fem.batched import BatchedRecord
from egs_warp.fem.body import SoftBody
from egs_warp.locomotion.batch_state import BatchState


@dataclass(frozen=True)
class Measurement(BatchedRecord):
    """Measured values of B worlds: lengths in body heights H, speeds in sqrt(g H), forces in body weights."""

    displacement: np.ndarray
    """(B, 3) displacement of the centre of mass since the start."""
    velocity: np.ndarray
    """(B, 3) velocity of the centre of mass."""
    angular_velocity: np.ndarray
    """(B, 3) angular velocity of a rigid body with the same angular momentum, in sqrt(g / H)."""
    rotation: np.ndarray
    """(B, 3, 3) mean rotation of the body since the start."""
    load: np.ndarray
    """(B,) sum of the normal contact forces."""
    activations: np.ndarray
    """(B, m) mean activation of each synergy, as a fraction of its bound."""

    @property
    def vectors(self) -> np.ndarray:
        """(B, 19 + m) float32, all values of each world."""
        parts = [np.asarray(value).reshape(len(self.load), -1) for _, value in self.batched_fields()]
        return np.hstack(parts).astype(np.float32)


def measure(body: SoftBody, start: torch.Tensor, state: BatchState, means: torch.Tensor) -> Measurement:
    """Measure all worlds of ``state``.

    Args:
        body: the body.
        start: (N, 3) m, positions at the start.
        state: state of B worlds.
        means: (M, m) 1/m, matrix that maps muscle activations to ``Measurement.activations``.
    """
    mass = torch.as_tensor(body.node_mass, device=start.device)[:, None]
    centre, start_centre = ((mass * each).sum(dim=-2) / body.mass for each in (state.positions, start))
    arms, start_arms = state.positions - centre[:, None], start - start_centre
    velocity = (mass * state.velocities).sum(dim=1) / body.mass
    momentum = torch.linalg.cross(arms, mass * state.velocities).sum(dim=1)
    second = arms.mT @ (mass * arms)
    trace = second.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
    inertia = trace * torch.eye(3, dtype=trace.dtype, device=trace.device) - second
    spin = torch.linalg.solve(inertia, momentum)
    # The rotation R that minimises sum m |arm - R start arm|^2.
    left, _, right = torch.linalg.svd(arms.mT @ (mass * start_arms))
    handedness = torch.ones_like(centre)
    handedness[:, 2] = torch.linalg.det(left @ right)
    values = (
        (centre - start_centre) / body.height,
        velocity / body.speed_unit,
        spin * body.time_unit,
        left @ (handedness[:, :, None] * right),
        state.forces[:, :, 0].sum(dim=1) / body.weight,
        state.activations @ means,
    )
    return Measurement(*(each.cpu().numpy() for each in values))
