"""Contact forces with exact Coulomb friction for a given Delassus operator (Eq. 8, 9)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.contact import coulomb as kernels
from egs_warp.kernels.contact.coulomb_equations import Contacts
from egs_warp.launching import empty_together
from egs_warp.precision import Vec4, real


def coulomb_forces(
    delassus: np.ndarray,
    free_velocity: np.ndarray,
    shift: np.ndarray,
    friction: float,
    start: np.ndarray,
    *,
    tolerance: float = 1e-12,
    iteration_limit: int = 16,
) -> tuple[np.ndarray, float]:
    """Forces f (n, 3) with 0 <= f_n, 0 <= u_n + shift, complementary, and exact Coulomb friction; u = free + G f
    (Eq. 8, 9).

    ``delassus`` G (3n, 3n) m/(N s); ``free_velocity`` (3n,) m/s; ``shift`` (n,) m/s; ``start`` (n, 3). Semismooth
    Newton on the projection equations of Alart and Curnier, started from block Gauss-Seidel. Returns the residual (m/s)
    too.
    """
    count = len(shift)
    if count == 0:
        return start, 0.0
    size = 3 * count
    wanted = ((1, 5, size), real), ((1, 2, size), int), ((1, size, (size + 4) // 4), Vec4)
    forces = np.array(start, dtype=np.float64, order="C")
    residual = np.empty(1)
    wp.launch(
        kernels.coulomb_kernel,
        dim=(1, 1),
        inputs=[
            wp.array(np.array([count], np.int32), dtype=int, device="cpu", copy=False),
            *(_shared(given[None]) for given in (delassus, free_velocity, shift)),
            *(_shared(np.array([friction])), tolerance, iteration_limit, _shared(forces.reshape(1, -1))),
            *empty_together("cpu", *wanted),
        ],
        outputs=[_shared(residual)],
        device="cpu",
    )
    return forces, float(residual[0])


def contacts_of(delassus: np.ndarray, free_velocity: np.ndarray, shift: np.ndarray, friction: float) -> Any:
    """The kernels' ``Contacts``, where they lie in the arrays: see ``coulomb_forces``."""
    contacts = Contacts()
    contacts.count, contacts.friction = len(shift), friction
    contacts.delassus, contacts.free, contacts.shifts = _shared(delassus), _shared(free_velocity), _shared(shift)
    return contacts


def _shared(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=real, device="cpu", copy=False)
