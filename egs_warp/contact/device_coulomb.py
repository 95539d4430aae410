"""Forces of a step's contacts where a GPU has their operator: ``coulomb_forces`` with nothing that waits."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coulomb import MAX_ITERATIONS, TOLERANCE
from egs_warp.contact.newton import DELASSUS_REGULARIZATION
from egs_warp.fem.batched import launch_on
from egs_warp.fem.cuda_graphs import GraphStream, PinnedUpload
from egs_warp.kernels.contact import coulomb as kernels
from egs_warp.precision import Vec4, real


class CoulombWorkspace:
    """Memory for so many contacts, of which some are there."""

    def __init__(self, stream: GraphStream, places: int, count: torch.Tensor) -> None:
        """``count`` (1,) of those that are there."""
        width, device = 3 * places, stream.device
        self._laws, self._laws_here, self._count = PinnedUpload(stream, 1 + places), np.zeros(0), count
        self.friction, self.shifts = self._laws.device.split([1, places])
        self.counts = torch.zeros(1, dtype=torch.int32, device=device)
        """(1,) contacts of the operator; ``friction`` (1,), ``shifts`` (places,) m/s."""
        self._regular = torch.zeros((width, width), dtype=torch.float64, device=device)
        self._vectors, self._indices = self._regular.new_zeros((1, 5, width)), self.counts.new_zeros((1, 2, width))
        self._matrices = self._regular.new_zeros((1, width, (width + 4) // 4, 4))

    def upload(self, shifts: np.ndarray, friction: float) -> None:
        """Of contacts with ``shifts`` (n,) m/s."""
        laws = np.array([friction, *shifts])
        # From look to look they are the same.
        if not np.array_equal(laws, self._laws_here):
            self._laws.set(laws)
            self._laws_here = laws

    def has_uploaded(self, shifts: np.ndarray, friction: float) -> bool:
        """Whether these were told last."""
        return np.array_equal(np.array([friction, *shifts]), self._laws_here)

    def enqueue_operator(self, delassus: torch.Tensor) -> None:
        """The ``delassus`` operator (3K, 3K) m/(N s) from now on."""
        self.counts.copy_(self._count)
        self._regular.copy_(delassus)
        mean = delassus.diagonal().sum() / (3.0 * self._count).clamp(min=1.0)
        self._regular.diagonal().add_(DELASSUS_REGULARIZATION * mean)

    def enqueue_forces(self, speeds: torch.Tensor, forces: torch.Tensor, missed: torch.Tensor) -> None:
        """``forces`` (3K,) newtons, from these on, of contacts that move at ``speeds`` (3K,) m/s without them; and (1,)
        m/s by which they have ``missed`` the laws."""
        lanes = kernels.BLOCK if speeds.is_cuda else 1
        launch_on(
            speeds.device,
            kernels.coulomb_kernel,
            (1, lanes),
            inputs=[
                (self.counts, wp.int32),
                *((each, real) for each in (self._regular[None], speeds[None], self.shifts[None], self.friction)),
                *(TOLERANCE, MAX_ITERATIONS, (forces[None], real), (self._vectors, real)),
                *((self._indices, wp.int32), (self._matrices, Vec4)),
            ],
            outputs=[(missed, real)],
            block_dim=lanes,
        )
