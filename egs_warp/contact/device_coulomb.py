"""Coulomb solves on a GPU: of one step's contacts, asynchronously, and of many worlds. ``coulomb_forces`` is the
version on the host.

The asynchronous solve has no continuation: if it fails, it is repeated on the host
(``DeviceNewtonIterate.newton_steps``). The kernel is in ``kernels/contact/coulomb.py``.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coulomb import FAILURE_TOLERANCE, MAX_ITERATIONS, REGULARIZATION_STEPS, TOLERANCE
from egs_warp.contact.newton import DELASSUS_REGULARIZATION
from egs_warp.fem.batched import launch_on, nonzero
from egs_warp.fem.cuda_graphs import GraphStream, PinnedUpload
from egs_warp.kernels.contact import coulomb as kernels
from egs_warp.precision import Vec4, real


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
        """Return True if these values were uploaded last."""
        return np.array_equal(np.array([friction, *shifts]), self._uploaded_parameters)

    def enqueue_operator(self, delassus: torch.Tensor) -> None:
        """Set the ``delassus`` operator (3K, 3K) m/(N s), and regularise it."""
        self.counts.copy_(self._count)
        self._regular.copy_(delassus)
        mean = delassus.diagonal().sum() / (3.0 * self._count).clamp(min=1.0)
        self._regular.diagonal().add_(DELASSUS_REGULARIZATION * mean)

    def enqueue_forces(self, speeds: torch.Tensor, forces: torch.Tensor, violation: torch.Tensor) -> None:
        """Solve for the contact forces.

        Args:
            speeds: (3K,) m/s, contact velocities without contact forces.
            forces: (3K,) newtons, initial forces; overwritten with the solution.
            violation: (1,) m/s, overwritten with the residual of Coulomb's law.
        """
        scratch = self._vectors, self._indices, self._matrices
        values = self._regular[None], speeds[None], self.normal_bias[None], self.friction
        _enqueue(self.counts, values, forces[None], scratch, violation)


def coulomb_forces_batch(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute Coulomb forces of c worlds, as ``coulomb_forces`` does in one.

    Args:
        counts: (c,) int32, number of contacts of each world.
        delassus: (c, 3K, 3K) m/(N s).
        free_velocity: (c, 3K) m/s without contact forces.
        shift: (c, K) m/s, bias of the normal velocities.
        frictions: (c,).
        start: (c, K, 3) newtons, initial forces.

    Returns:
        (c, K, 3) newtons and the residuals (c,) in m/s.
    """
    worlds, capacity, _ = start.shape
    if worlds == 0 or capacity == 0:
        return start.clone(), start.new_zeros(worlds)
    result, residual = _solve(counts, delassus, free_velocity, shift, frictions, start)
    failed = nonzero(residual > FAILURE_TOLERANCE)
    if len(failed) == 0:
        return result, residual
    counts, operators, free, shift, frictions, forces = (
        each[failed].contiguous() for each in (counts, delassus, free_velocity, shift, frictions, start)
    )
    diagonal = operators.diagonal(dim1=1, dim2=2)
    mean = diagonal.sum(dim=1, keepdim=True) / (3 * counts[:, None])
    for softness in (*REGULARIZATION_STEPS, 0.0):
        soft = operators + torch.diag_embed((softness * mean).expand_as(diagonal))
        forces, new_residual = _solve(counts, soft, free, shift, frictions, forces)
    better = new_residual < residual[failed]
    result[failed[better]], residual[failed[better]] = forces[better], new_residual[better]
    return result, residual


def _solve(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the forces with the kernel alone, without continuation."""
    worlds, capacity, _ = start.shape
    forces, residual, size = start.clone(), start.new_zeros(worlds), 3 * capacity
    vectors = start.new_empty((worlds, 5, size))
    indices = torch.empty((worlds, 2, size), dtype=torch.int32, device=start.device)
    matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))
    values = tuple(each.contiguous() for each in (delassus, free_velocity, shift, frictions))
    _enqueue(counts, values, forces.view(worlds, size), (vectors, indices, matrices), residual)
    return forces, residual


def _enqueue(
    counts: torch.Tensor,
    values: tuple[torch.Tensor, ...],
    forces: torch.Tensor,
    scratch: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    residual: torch.Tensor,
) -> None:
    """Queue the kernel for c worlds with contiguous arrays.

    Args:
        counts: (c,) int32, number of contacts of each world.
        values: operators (c, 3K, 3K) m/(N s), contact velocities without contact forces (c, 3K) m/s, biases (c, K) m/s
            and Coulomb coefficients (c,).
        forces: (c, 3K) newtons, initial forces; overwritten with the solution.
        scratch: (c, 5, 3K), (c, 2, 3K) int32 and (c, 3K, ceil((3K + 1) / 4), 4).
        residual: (c,) m/s, overwritten with the residual of Coulomb's law.
    """
    vectors, indices, matrices = scratch
    lanes = kernels.BLOCK if forces.is_cuda else 1
    launch_on(
        forces.device,
        kernels.coulomb_kernel,
        (len(forces), lanes),
        inputs=[
            (counts, wp.int32),
            *((each, real) for each in values),
            *(TOLERANCE, MAX_ITERATIONS, (forces, real), (vectors, real), (indices, wp.int32), (matrices, Vec4)),
        ],
        outputs=[(residual, real)],
        block_dim=lanes,
    )
