"""Damped spring by which the user pulls a body."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody

STIFFNESS = 3.0
"""Stiffness, body weights per body height of extension."""
MAX_FORCE = 1.5
"""Maximum force, body weights."""
GRIP_RADIUS = 0.25
"""Radius around the node at rest within which the force acts, body heights."""


class Spring:
    """Damped spring between the material around a node and a target point."""

    def __init__(self, body: SoftBody, node: int) -> None:
        """Attach the spring to ``node``; the caller sets ``target``, (3,) m."""
        self.node, self.target = node, np.zeros(3)
        nodes = body.mesh.nodes
        distance_ratio = np.linalg.norm(nodes - nodes[node], axis=1) / (GRIP_RADIUS * body.height)
        shares = np.maximum(1.0 - distance_ratio**2, 0.0) ** 2
        self._body = body
        self._shares = shares / (body.node_mass @ shares)
        """(N,) acceleration of each node per unit of force, 1/kg."""
        self._stiffness = STIFFNESS * body.weight / body.height
        self._damping = float(np.sqrt(self._stiffness * body.mass))
        """Half of the critical damping of the whole body, N s/m."""

    def force(self, state: BodyState) -> np.ndarray:
        """Return the force (3,) on the body in N."""
        shares = self._body.node_mass * self._shares
        force = self._stiffness * (self.target - shares @ state.positions) - self._damping * (shares @ state.velocities)
        size = float(np.linalg.norm(force))
        return force * min(1.0, MAX_FORCE * self._body.weight / max(size, 1e-12))

    def kick(self, state: BodyState, dt: float) -> np.ndarray:
        """Return the velocities (N, 3), m/s, that the spring adds to the nodes in a time step of ``dt`` s that starts
        at ``state``."""
        return dt * self._shares[:, None] * self.force(state)
