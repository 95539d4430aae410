"""A spring by which a user pulls at a body."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody

STIFFNESS = 3.0
"""Body weights for each body height that the spring is drawn out."""
MAX_FORCE = 1.5
"""Body weights."""
GRIP_RADIUS = 0.25
"""Body heights around the node, at rest, within which the body is held."""


class Spring:
    """Pulls the material around a node towards a target, damped."""

    def __init__(self, body: SoftBody, node: int) -> None:
        self.node, self.target = node, np.zeros(3)
        nodes = body.mesh.nodes
        near = np.linalg.norm(nodes - nodes[node], axis=1) / (GRIP_RADIUS * body.height)
        shares = np.maximum(1.0 - near**2, 0.0) ** 2
        self._body = body
        self._shares = shares / (body.node_mass @ shares)
        """(N,) 1/kg: acceleration of each node for a force of one newton."""
        self._stiffness = STIFFNESS * body.weight / body.height
        self._damping = float(np.sqrt(self._stiffness * body.mass))
        """N s/m, half of what is critical for the whole body."""

    def force(self, state: BodyState) -> np.ndarray:
        """(3,) newtons."""
        shares = self._body.node_mass * self._shares
        force = self._stiffness * (self.target - shares @ state.positions) - self._damping * (shares @ state.velocities)
        size = float(np.linalg.norm(force))
        return force * min(1.0, MAX_FORCE * self._body.weight / max(size, 1e-12))

    def kick(self, state: BodyState, dt: float) -> np.ndarray:
        """(N, 3) m/s that a step of ``dt`` s from ``state`` gives the nodes."""
        return dt * self._shares[:, None] * self.force(state)
