"""Dimensionless measurement of many worlds of one body: the observation of an environment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.fem.batched import BatchedRecord
from egs_warp.fem.body import SoftBody
from egs_warp.geometry.frames import nearest_rotation
from egs_warp.locomotion.batch_state import BatchState
from egs_warp.motions.balance import solved
from egs_warp.motions.moments import part_moments


@dataclass(frozen=True)
class Measurement(BatchedRecord):
    """Measured values of B worlds: lengths in units of the body height H, speeds in sqrt(g H), forces in body
    weights."""

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
        """(B, 19 + m) float32, all values of each world in one row."""
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
    shares = torch.as_tensor(body.node_mass / body.mass, device=start.device)[None]
    start_centre = shares @ start
    reference = (start - start_centre).expand_as(state.positions)
    moments = part_moments(shares, reference, state.positions, state.velocities).on_host()
    second = moments.second[:, 0]
    inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    return Measurement(
        (moments.centres[:, 0] - start_centre.cpu().numpy()) / body.height,
        moments.velocity / body.speed_unit,
        solved(inertia, moments.spin) * body.time_unit,
        nearest_rotation(moments.cross[:, 0]),
        state.forces[:, :, 0].sum(dim=1).cpu().numpy() / body.weight,
        (state.activations @ means).cpu().numpy(),
    )
