"""The program of a step as the paper writes it: contact as complementarity of pyramid forces and slips (Eq. 9, 13).

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from egs_warp.contact.detection import tangent_directions
from egs_warp.locomotion.complementarity import ContactLayout
from egs_warp.locomotion.contact_modes import CoulombProgram

_REGULAR = 1e-7


@dataclass(frozen=True)
class ContactProgram:
    """min 1/2 y^T P y + q^T y + constant over y = (a, f_n, f_t, lambda), subject to the pairs of Eq. (9).

    Rows A y + offset are ``ContactLayout``'s; only their bounds depend on the contact states. Units: activations in
    their bounds, forces in body weights, speeds in sqrt(g H).
    """

    layout: ContactLayout
    friction: float
    P: np.ndarray
    """(variables, variables)."""
    q: np.ndarray
    """(variables,)."""
    constant: float
    """Makes the objective the sum of weighted squares that was asked for: never negative."""
    A: np.ndarray
    """(rows, variables)."""
    offset: np.ndarray
    """(rows,)."""
    lower: np.ndarray
    """(M,) of the activations."""
    upper: np.ndarray
    """(M,) of the activations."""

    @classmethod
    def of(cls, pieces: CoulombProgram, directions: int) -> ContactProgram:
        """The same step with a friction pyramid of ``directions`` edges in place of the cone."""
        layout = ContactLayout(pieces.activation_count, pieces.contact_count, directions)
        spread = _spread(layout)
        P = spread.T @ (spread.T @ pieces.P).T
        A, offset = _contact_rows(pieces.rows @ spread, pieces.offset, layout, pieces.friction)
        P = 0.5 * (P + P.T) + _REGULAR * np.eye(layout.variables)
        return cls(
            *(layout, pieces.friction, P, spread.T @ pieces.q, pieces.constant),
            *(A, offset, pieces.lower, pieces.upper),
        )

    def bounds(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of A y for contact states (n,)."""
        lower, upper = self.layout.bounds(states)
        lower[: self.layout.activations], upper[: self.layout.activations] = self.lower, self.upper
        return lower - self.offset, upper - self.offset

    def pairs(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(pairs,) x and w of Eq. (9) at ``y``."""
        rows = self.A @ y + self.offset
        return rows[self.layout.activations : self.layout.variables], rows[self.layout.variables :]

    def objective(self, y: np.ndarray) -> float:
        """Value at ``y``."""
        return float(0.5 * y @ self.P @ y + self.q @ y + self.constant)

    def forces_of(self, y: np.ndarray) -> np.ndarray:
        """(M + 3n,) activations and contact forces, as ``ContactPieces`` has them, at ``y``."""
        return _spread(self.layout) @ y


def _spread(layout: ContactLayout) -> sparse.csr_matrix:
    """(M + 3n, variables) activations and forces (normal and two tangents a contact) of y."""
    m, n, nd = layout.activations, layout.contacts, layout.directions
    spread = np.zeros((m + 3 * n, layout.variables))
    spread[np.arange(m), np.arange(m)] = 1.0
    normals = m + 3 * np.arange(n)
    spread[normals, layout.normal.start + np.arange(n)] = 1.0
    for k, direction in enumerate(tangent_directions(nd)):
        for t in (0, 1):
            spread[normals + 1 + t, layout.tangent.start + nd * np.arange(n) + k] = direction[t]
    return sparse.csr_matrix(spread)


def _contact_rows(
    speeds: np.ndarray, base: np.ndarray, layout: ContactLayout, friction: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows A y + offset of ``ContactLayout``: y itself, then c, D^T u' + E lambda and mu f_n - E^T f_t (Eq. 9), of
    contact velocities ``speeds`` (3n, variables) y + ``base`` (3n,)."""
    n, nd = layout.contacts, layout.directions
    speed, base = np.asarray(speeds).reshape(n, 3, layout.variables), base.reshape(n, 3)
    table = tangent_directions(nd)
    lam = np.zeros((n, layout.variables))
    lam[np.arange(n), layout.slip.start + np.arange(n)] = 1.0
    slip = np.einsum("dt,ntv->ndv", table, speed[:, 1:]) + lam[:, None, :]
    cone = np.zeros((n, layout.variables))
    cone[np.arange(n), layout.normal.start + np.arange(n)] = friction
    for k in range(nd):
        cone[np.arange(n), layout.tangent.start + nd * np.arange(n) + k] = -1.0
    A = np.vstack([np.eye(layout.variables), speed[:, 0], slip.reshape(n * nd, layout.variables), cone])
    offset = np.concatenate([np.zeros(layout.variables), base[:, 0], (base[:, 1:] @ table.T).ravel(), np.zeros(n)])
    return A, offset
