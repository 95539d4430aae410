"""Results of a trial on a GPU that the host reads. They share one array, so that one transfer downloads them all."""

from __future__ import annotations

from typing import Generic, NamedTuple

import numpy as np
import torch

from egs_warp.fem.batched import ArrayT
from egs_warp.fem.cuda_graphs import GraphStream
from egs_warp.kernels.contact.newton_convergence import ROW_SIZE


class TrialReadback(NamedTuple, Generic[ArrayT]):
    """Results of a trial: views of one array on the device or on the host. The next trial overwrites them."""

    residual_norm: ArrayT
    """(1,) N s, norm of the residual; not finite where an element is inverted."""
    free_contact_velocities: ArrayT
    """(3K,) m/s, contact velocities after a Newton step from the trial without contact forces."""
    velocities: ArrayT
    """(3N,) m/s, velocities of the trial."""
    coulomb_violation: ArrayT
    """(1,) m/s, residual of the last Coulomb solve."""
    forces: ArrayT
    """(3K,) newtons, contact forces of the last Coulomb solve."""
    penetration: ArrayT
    """(5,), packed ``PenetrationCheck``."""
    progress: ArrayT
    """(ROW_SIZE,) row of ``NewtonProgress`` after the loop."""
    previous_contact_velocities: ArrayT
    """(3K,) m/s, contact velocities after a Newton step without contact forces from the iterate at the start of the
    last step."""
    velocities_before: ArrayT
    """(3N,) m/s, velocities of the iterate at the start of the last step."""
    forces_before: ArrayT
    """(3K,) newtons, contact forces of the iterate at the start of the last step."""


class ReadbackBuffers:
    """Results of a trial with up to K contacts and N nodes, on the device and in page-locked host memory."""

    def __init__(self, stream: GraphStream, capacity: int, node_count: int) -> None:
        width, size = 3 * capacity, 3 * node_count
        parts = [1, width, size, 1, width, 5, ROW_SIZE, width, size, width]
        self._host = stream.pinned(sum(parts))
        self._device = torch.zeros(sum(parts), dtype=torch.float64, device=stream.device)
        self.on_device = TrialReadback(*self._device.split(parts))
        self.on_host = TrialReadback(*np.split(self._host.numpy(), np.cumsum(parts)[:-1]))

    def start_download(self) -> None:
        """Start the copy from the device to the host."""
        self._host.copy_(self._device, non_blocking=True)
