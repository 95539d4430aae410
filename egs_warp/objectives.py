"""What a motion asks of the end velocity: weighted squares of linear functions of v (DESIGN 9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from egs_warp.body import SoftBody


@dataclass(frozen=True)
class Objective:
    """weight |rows v - target|^2, all in m/s so that weights compare."""

    name: str
    rows: sparse.csr_matrix
    """(k, 3N)."""
    target: np.ndarray
    """(k,) m/s."""
    weight: float


def centre_of_mass_velocity(body: SoftBody, target: np.ndarray, weight: float) -> Objective:
    """Velocity (3,) of the centre of mass."""
    shares = body.node_mass / body.mass
    return Objective("com", sparse.csr_matrix(np.kron(shares, np.eye(3))), np.asarray(target, float), weight)


@dataclass(frozen=True)
class SpinObjective:
    """weight |L+ - target|^2 / (m r)^2, r the radius of gyration, for the angular momentum about the centre of mass at the end of the step.

    The stepper keeps L+ = L + dt sum (x - c) x f (DESIGN 5), so contact forces alone steer it.
    """

    target: np.ndarray
    """(3,) kg m^2/s."""
    weight: float


def node_velocities(body: SoftBody, target: np.ndarray, weight: float) -> Objective:
    """Velocities (N, 3) of all nodes, each weighted by its share of the mass: a pose to move towards."""
    shares = np.sqrt(np.repeat(body.node_mass / body.mass, 3))
    return Objective("pose", sparse.diags(shares).tocsr(), shares * target.ravel(), weight)
