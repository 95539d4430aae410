"""Maximum work of one push against the ground, from the strength of the muscles and the elasticity of the body.

The elasticity is linearised at the present shape. With all activations at their bounds, a point on the ground would
move by the distance d relative to the edge about which the body rolls. If the ground holds the point in place, it
presses on the ground with the force F = d / c instead, where c is the compliance between point and edge. The force
decreases linearly to zero over d, so the work of a push over the distance s <= d is at most F s (1 - s / (2 d)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import activation_jacobian

_SOFTNESS = 1e-6
"""Diagonal term, relative to the largest entry, that makes the stiffness matrix of a free body nonsingular."""


@dataclass(frozen=True)
class PushCapacity:
    """Capacity of the muscles to push a point away from the body."""

    force: float
    """N, largest force on a point that is held in place."""
    stroke: float
    """m, largest distance by which the point moves if no force resists."""

    def work(self, distance: float) -> float:
        """Return the maximum work of a push in joules; the point leaves the ground after at most ``distance`` m."""
        moved = min(distance, self.stroke)
        return self.force * moved * (1.0 - 0.5 * moved / self.stroke) if moved > 0.0 else 0.0


def push_capacity(
    body: SoftBody, muscles: MuscleSet, positions: np.ndarray, far: np.ndarray, edge: np.ndarray, normal: np.ndarray
) -> PushCapacity:
    """Return the capacity of a free body to push its nodes ``far`` against ``normal`` relative to its nodes ``edge``.

    Args:
        body: the body.
        muscles: muscles of the body.
        positions: (N, 3) m, nodes of the body.
        far: (k,) nodes that push.
        edge: (l,) nodes of the edge about which the body rolls.
        normal: (3,) unit normal of the ground.
    """
    load = np.zeros_like(positions)
    load[far] -= normal / len(far)
    load[edge] += normal / len(edge)
    load -= _rigid_part(body, positions, load)
    assembly = body.assembly
    entries = assembly.hessian_entries(positions, projected=True)
    entries[assembly.diagonal_entries] += _SOFTNESS * entries.max()
    factors = MultifrontalLdl(assembly.upper_pattern, assembly.analysis)
    factors.factor(entries)
    response = factors.solve(load.reshape(-1, 1))[:, 0]
    stroke = float(np.abs(activation_jacobian(muscles, positions).T @ response) @ muscles.bounds)
    return PushCapacity(stroke / float(load.ravel() @ response), stroke)


def _rigid_part(body: SoftBody, positions: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Return the inertial forces (N, 3) of the rigid-body acceleration that ``load`` (N, 3) causes."""
    arms = positions - body.centre_of_mass(positions)
    spin = np.linalg.solve(body.inertia(positions), np.cross(arms, load).sum(axis=0))
    return body.node_mass[:, None] * (load.sum(axis=0) / body.mass + np.cross(spin, arms))
