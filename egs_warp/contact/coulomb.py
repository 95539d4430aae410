"""Contact forces with exact Coulomb friction for a given Delassus operator, in one world or in many (Eq. 8, 9).

``coulomb_forces`` solves for one world on the host, ``coulomb_forces_of_worlds`` for many worlds on tensors. If the
kernel fails, both solve by continuation from compliant contacts. ``device_coulomb`` queues the kernel on a GPU without
this continuation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import warp as wp

from egs_warp.fem.batched import ArrayT, contiguous, empty_like, launch_on, nonzero
from egs_warp.kernels.contact import coulomb as kernels
from egs_warp.launching import shared_zeros, thread_local_cache
from egs_warp.precision import Vec4, real

if TYPE_CHECKING:
    import torch

_Residual = TypeVar("_Residual")

TOLERANCE, MAX_ITERATIONS = 1e-12, 16
"""Residual of the projection equations, m/s, at which Newton's method ends, and maximum number of Newton steps."""
FAILURE_TOLERANCE = 1e-8
"""Residual in m/s above which the solve is treated as failed and repeated by continuation."""
REGULARIZATION_STEPS = (1e-4, 1e-5, 1e-6, 1e-7)
"""Compliances of the continuation: fractions of the mean diagonal of the operator that are added to its diagonal. Each
solve starts from the forces of the previous one. With many points on few nodes the operator is nearly singular, and
Newton's method does not converge from most initial forces; with compliant contacts it does."""

DELASSUS_REGULARIZATION = 1e-7
"""Diagonal shift of the Delassus operator, as a fraction of the mean of its diagonal. The operator is singular if there
are more points than the cage can resolve."""


def regularized(
    delassus: ArrayT, fraction: float, counts: torch.Tensor | None = None, out: ArrayT | None = None
) -> ArrayT:
    """Return the operator with ``fraction`` of its mean diagonal entry added to its diagonal.

    Args:
        delassus: (3n, 3n) of one world, or (B, 3K, 3K), m/(N s).
        fraction: compliance of the contacts, relative to the mean diagonal entry.
        counts: (B,) number of contacts of each world; the mean is taken over their entries. None takes it over the
            whole diagonal.
        out: contiguous memory of the result, or None.
    """
    size, out = delassus.shape[-1], empty_like(delassus, delassus.shape) if out is None else out
    out[:] = delassus
    total = delassus.diagonal(0, -2, -1).sum(-1)
    mean = total / (max(size, 1) if counts is None else (3 * counts).clip(1, None))
    diagonal = out.reshape((*delassus.shape[:-2], -1))[..., :: size + 1]
    diagonal += (fraction * mean)[..., None]
    return out


def _continue_from_compliance(
    solve: Callable[[ArrayT, ArrayT], tuple[ArrayT, _Residual]],
    delassus: ArrayT,
    forces: ArrayT,
    counts: torch.Tensor | None = None,
) -> tuple[ArrayT, _Residual]:
    """Solve with gradually decreasing compliance of the contacts, starting from ``forces``.

    ``solve`` maps an operator and initial forces to forces and their residual. Return the forces and the residual for
    ``delassus`` itself, without compliance.
    """
    for softness in REGULARIZATION_STEPS:
        forces, _ = solve(regularized(delassus, softness, counts), forces)
    return solve(delassus, forces)


def coulomb_forces(
    delassus: np.ndarray, free_velocity: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Compute contact forces f (n, 3) with exact Coulomb friction and complementary f_n >= 0 and u_n + shift >= 0,
    where u = free_velocity + G f (Eq. 8, 9).

    The method is semismooth Newton on the projection equations of Alart and Curnier, started from block Gauss-Seidel.
    If it fails, the problem is solved by continuation from compliant contacts (``REGULARIZATION_STEPS``).

    Args:
        delassus: G (3n, 3n) m/(N s).
        free_velocity: (3n,) m/s without contact forces.
        shift: (n,) m/s, bias of the normal velocities.
        friction: Coulomb coefficient mu.
        start: (n, 3) newtons, initial forces.

    Returns:
        The forces (n, 3) in newtons and the residual in m/s.
    """
    count = len(shift)
    if count == 0:
        return start, 0.0
    workspace = _workspace(count)
    result, residual = workspace.solve(delassus, free_velocity, shift, friction, start)
    if residual <= FAILURE_TOLERANCE:
        return result, residual
    forces, new_residual = _continue_from_compliance(
        lambda soft, initial: workspace.solve(soft, free_velocity, shift, friction, initial), delassus, start
    )
    return (forces, new_residual) if new_residual < residual else (result, residual)


class _CoulombWorkspace:
    """Buffers for a problem of ``count`` contacts, and a launch that is recorded on them, because preparing a new
    launch takes as long as solving for ten contacts."""

    def __init__(self, count: int) -> None:
        size = 3 * count
        shapes = (1, size, size), (1, size), (1, count), 1, (1, size), 1
        arrays, shared = zip(*map(shared_zeros, shapes), strict=True)
        self._delassus, self._free, self._shifts, self._friction, self._forces, self._residual = arrays
        counts = wp.array(np.array([count], np.int32), dtype=int, device="cpu")
        scratch_shapes = ((1, 5, size), real), ((1, 2, size), int), ((1, size, (size + 4) // 4), Vec4)
        scratch = [wp.zeros(shape, dtype=kind, device="cpu") for shape, kind in scratch_shapes]
        self._launch: Any = wp.launch(
            kernels.coulomb_kernel,
            dim=(1, 1),
            inputs=[counts, *shared[:4], TOLERANCE, MAX_ITERATIONS, shared[4], *scratch],
            outputs=[shared[5]],
            device="cpu",
            record_cmd=True,
        )

    def solve(
        self, delassus: np.ndarray, free_velocity: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Compute the forces with the kernel alone, without continuation (arguments as in ``coulomb_forces``)."""
        self._delassus[0], self._free[0], self._shifts[0] = delassus, free_velocity, shift
        self._friction[0], self._forces[0] = friction, start.ravel()
        self._launch.launch()
        return self._forces.reshape(-1, 3).copy(), float(self._residual[0])


_workspace = thread_local_cache(32)(_CoulombWorkspace)


def coulomb_forces_of_worlds(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the Coulomb forces of c worlds on tensors. Arguments and results are those of ``coulomb_forces``, with a
    leading world axis, and the number of contacts of each world, ``counts`` (c,) int32."""
    worlds, capacity, _ = start.shape
    if worlds == 0 or capacity == 0:
        return start.clone(), start.new_zeros(worlds)
    result, residual = _solve_worlds(counts, delassus, free_velocity, shift, frictions, start)
    failed = nonzero(residual > FAILURE_TOLERANCE)
    if len(failed) == 0:
        return result, residual
    counts, operators, free, shift, frictions, forces = (
        each[failed].contiguous() for each in (counts, delassus, free_velocity, shift, frictions, start)
    )
    forces, new_residual = _continue_from_compliance(
        lambda soft, initial: _solve_worlds(counts, soft, free, shift, frictions, initial), operators, forces, counts
    )
    better = new_residual < residual[failed]
    result[failed[better]], residual[failed[better]] = forces[better], new_residual[better]
    return result, residual


def _solve_worlds(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the forces with the kernel alone, without continuation (arguments as in ``coulomb_forces_of_worlds``)."""
    worlds, capacity, _ = start.shape
    forces, residual, size = start.clone(), start.new_zeros(worlds), 3 * capacity
    vectors = start.new_empty((worlds, 5, size))
    indices = counts.new_empty((worlds, 2, size))
    matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))
    values = tuple(contiguous(each) for each in (delassus, free_velocity, shift, frictions))
    enqueue_forces(counts, values, forces.view(worlds, size), (vectors, indices, matrices), residual)
    return forces, residual


def enqueue_forces(
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
        scratch: workspaces (c, 5, 3K), (c, 2, 3K) int32 and (c, 3K, ceil((3K + 1) / 4), 4).
        residual: (c,) m/s, overwritten with the residual of Coulomb's law.
    """
    vectors, indices, matrices = scratch
    lanes = kernels.BLOCK if forces.is_cuda else 1
    launch_on(
        forces,
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
