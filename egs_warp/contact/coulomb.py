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
"""m/s by which forces may miss the laws, and steps of Newton's method until they do."""
FAILURE_TOLERANCE = 1e-8
"""m/s: forces that miss the laws by more are sought by another way."""
REGULARIZATION_STEPS = (1e-4, 1e-5, 1e-6, 1e-7)
"""Of the mean of the operator's diagonal: what is added to it on that way, on which the forces of one are the start of
the next. Many points on few nodes leave an operator next to singular, and from most starts no way to the forces that
obey the laws; where contacts give way by so little there is one."""


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
    """Forces f (n, 3) with 0 <= f_n, 0 <= u_n + shift, complementary, and exact Coulomb friction; u = free + G f
    (Eq. 8, 9).

    ``delassus`` G (3n, 3n) m/(N s); ``free_velocity`` (3n,) m/s; ``shift`` (n,) m/s; ``start`` (n, 3). Semismooth
    Newton on the projection equations of Alart and Curnier, started from block Gauss-Seidel; where that leads nowhere,
    of contacts that give way, ever less (``SOFT``). Returns the residual (m/s) too.
    """
    count = len(shift)
    if count == 0:
        return start, 0.0
    room = _room(count, tolerance, iteration_limit)
    found, missed = room.solve(delassus, free_velocity, shift, friction, start)
    if missed <= FAILURE_TOLERANCE:
        return found, missed
    forces, left = start, missed
    for softness in (*REGULARIZATION_STEPS, 0.0):
        soft = delassus.copy()
        soft[np.diag_indices_from(soft)] += softness * delassus.diagonal().mean()
        forces, left = room.solve(soft, free_velocity, shift, friction, forces)
    return (forces, left) if left < missed else (found, missed)


class _CoulombWorkspace:
    """Memory for a problem of so many contacts, and a launch that is made again and again: a new one costs as much as
    the forces of ten contacts."""

    def __init__(self, count: int, tolerance: float, iteration_limit: int) -> None:
        size = 3 * count
        self._delassus, self._free, self._shifts = np.zeros((1, size, size)), np.zeros((1, size)), np.zeros((1, count))
        self._friction, self._forces, self._residual = np.zeros(1), np.zeros((1, size)), np.zeros(1)
        counts = wp.array(np.array([count], np.int32), dtype=int, device="cpu")
        given = [_shared(each) for each in (self._delassus, self._free, self._shifts, self._friction)]
        wanted = ((1, 5, size), real), ((1, 2, size), int), ((1, size, (size + 4) // 4), Vec4)
        scratch = [wp.zeros(shape, dtype=kind, device="cpu") for shape, kind in wanted]
        self._launch: Any = wp.launch(
            kernels.coulomb_kernel,
            dim=(1, 1),
            inputs=[counts, *given, tolerance, iteration_limit, _shared(self._forces), *scratch],
            outputs=[_shared(self._residual)],
            device="cpu",
            record_cmd=True,
        )

    def solve(
        self, delassus: np.ndarray, free_velocity: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """See ``coulomb_forces``."""
        self._delassus[0], self._free[0], self._shifts[0] = delassus, free_velocity, shift
        self._friction[0], self._forces[0] = friction, start.ravel()
        self._launch.launch()
        return self._forces.reshape(-1, 3).copy(), float(self._residual[0])


_room = thread_local_cache(32)(_CoulombWorkspace)


def pack_contacts(delassus: np.ndarray, free_velocity: np.ndarray, shift: np.ndarray, friction: float) -> Any:
    """The kernels' ``Contacts``, where they lie in the arrays: see ``coulomb_forces``."""
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
