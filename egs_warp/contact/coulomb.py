"""Contact forces with exact Coulomb friction for a given Delassus operator (Eq. 8, 9)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.contact import coulomb as kernels
from egs_warp.kernels.contact.coulomb_equations import Contacts
from egs_warp.launching import thread_local_cache
from egs_warp.precision import Vec4, real

TOLERANCE, MAX_ITERATIONS = 1e-12, 16
"""Residual of the projection equations, m/s, at which Newton's method ends, and its maximum number of steps."""
FAILURE_TOLERANCE = 1e-8
"""Residual in m/s above which the solve counts as failed and is repeated by continuation."""
REGULARIZATION_STEPS = (1e-4, 1e-5, 1e-6, 1e-7)
"""Continuation in the compliance of the contacts: fractions of the mean diagonal of the operator that are added to the
diagonal, each solve starting from the forces of the one before. With many points on few nodes the operator is nearly
singular, and most starts do not converge; with compliant contacts they do.
"""


def coulomb_forces(
    delassus: np.ndarray,
    free_velocity: np.ndarray,
    shift: np.ndarray,
    friction: float,
    start: np.ndarray,
    *,
    tolerance: float = TOLERANCE,
    iteration_limit: int = MAX_ITERATIONS,
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
        tolerance: residual at which Newton's method ends, m/s.
        iteration_limit: maximum number of Newton steps of the first attempt.

    Returns:
        The forces (n, 3) in newtons and the residual in m/s.
    """
    count = len(shift)
    if count == 0:
        return start, 0.0
    workspace = _workspace(count, tolerance, iteration_limit)
    result, residual = workspace.solve(delassus, free_velocity, shift, friction, start)
    if residual <= FAILURE_TOLERANCE:
        return result, residual
    forces, new_residual = start, residual
    for softness in (*REGULARIZATION_STEPS, 0.0):
        soft = delassus.copy()
        soft[np.diag_indices_from(soft)] += softness * delassus.diagonal().mean()
        forces, new_residual = workspace.solve(soft, free_velocity, shift, friction, forces)
    return (forces, new_residual) if new_residual < residual else (result, residual)


class _CoulombWorkspace:
    """Buffers for a problem of ``count`` contacts, and a recorded launch on them: preparing a new launch takes as long
    as solving for ten contacts.
    """

    def __init__(self, count: int, tolerance: float, iteration_limit: int) -> None:
        size = 3 * count
        self._delassus, self._free, self._shifts = np.zeros((1, size, size)), np.zeros((1, size)), np.zeros((1, count))
        self._friction, self._forces, self._residual = np.zeros(1), np.zeros((1, size)), np.zeros(1)
        counts = wp.array(np.array([count], np.int32), dtype=int, device="cpu")
        values = [_shared(each) for each in (self._delassus, self._free, self._shifts, self._friction)]
        scratch_shapes = ((1, 5, size), real), ((1, 2, size), int), ((1, size, (size + 4) // 4), Vec4)
        scratch = [wp.zeros(shape, dtype=kind, device="cpu") for shape, kind in scratch_shapes]
        self._launch: Any = wp.launch(
            kernels.coulomb_kernel,
            dim=(1, 1),
            inputs=[counts, *values, tolerance, iteration_limit, _shared(self._forces), *scratch],
            outputs=[_shared(self._residual)],
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


def pack_contacts(delassus: np.ndarray, free_velocity: np.ndarray, shift: np.ndarray, friction: float) -> Any:
    """Return the kernels' ``Contacts``, which share the memory of these arrays (shapes as in ``coulomb_forces``)."""
    contacts = Contacts()
    contacts.count, contacts.friction = len(shift), friction
    contacts.delassus, contacts.free_velocity, contacts.normal_bias = (
        _shared(delassus),
        _shared(free_velocity),
        _shared(shift),
    )
    return contacts


def _shared(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=real, device="cpu", copy=False)
