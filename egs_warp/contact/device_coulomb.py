"""Asynchronous Coulomb solve for the contacts of one step on a GPU.

The solve has no continuation. If it fails, the host repeats it (``DeviceNewtonIterate.newton_steps``).
"""

from __future__ import annotations

import numpy as np
import torch

from egs_warp.contact.coulomb import DELASSUS_REGULARIZATION, enqueue_forces, regularized
from egs_warp.fem.cuda_graphs import GraphStream, PinnedUpload


class CoulombWorkspace:
    """Buffers of the Coulomb solve for up to ``capacity`` contacts."""

    def __init__(self, stream: GraphStream, capacity: int, count: torch.Tensor) -> None:
        """Allocate the buffers.

        Args:
            stream: stream on which the solve is queued.
            capacity: K, maximum number of contacts.
            count: (1,) number of contacts, on the device.
        """
        width, device = 3 * capacity, stream.device
        self._parameters, self._uploaded_parameters, self._count = (
            PinnedUpload(stream, 1 + capacity),
            np.zeros(0),
            count,
        )
        self.friction, self.normal_bias = self._parameters.device.split([1, capacity])
        self.counts = torch.zeros(1, dtype=torch.int32, device=device)
        """(1,) int32, number of contacts of the operator. ``friction`` is (1,), ``normal_bias`` (K,) m/s."""
        self._regular = torch.zeros((width, width), dtype=torch.float64, device=device)
        self._vectors, self._indices = self._regular.new_zeros((1, 5, width)), self.counts.new_zeros((1, 2, width))
        self._matrices = self._regular.new_zeros((1, width, (width + 4) // 4, 4))

    def upload(self, shifts: np.ndarray, friction: float) -> None:
        """Upload the normal bias ``shifts`` (n,) in m/s and the Coulomb coefficient, if they have changed."""
        parameters = np.array([friction, *shifts])
        # The parameters are the same for all Newton steps of a round.
        if not np.array_equal(parameters, self._uploaded_parameters):
            self._parameters.set(parameters)
            self._uploaded_parameters = parameters

    def has_uploaded(self, shifts: np.ndarray, friction: float) -> bool:
        """Return True if these values are the ones that were uploaded last."""
        return np.array_equal(np.array([friction, *shifts]), self._uploaded_parameters)

    def enqueue_operator(self, delassus: torch.Tensor) -> None:
        """Set the ``delassus`` operator (3K, 3K) m/(N s), and regularise it."""
        self.counts.copy_(self._count)
        regularized(delassus[None], DELASSUS_REGULARIZATION, self._count, out=self._regular[None])

    def enqueue_forces(self, speeds: torch.Tensor, forces: torch.Tensor, violation: torch.Tensor) -> None:
        """Solve for the contact forces.

        Args:
            speeds: (3K,) m/s, contact velocities without contact forces.
            forces: (3K,) newtons, initial forces; overwritten with the solution.
            violation: (1,) m/s, overwritten with the residual of Coulomb's law.
        """
        scratch = self._vectors, self._indices, self._matrices
        values = self._regular[None], speeds[None], self.normal_bias[None], self.friction
        enqueue_forces(self.counts, values, forces[None], scratch, violation)
