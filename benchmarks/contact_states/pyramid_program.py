"""QP of a step in the paper's form: contact as complementarity of pyramid forces and slip velocities (Eq. 9, 13).

See docs/benchmarks/contact.md#searches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from benchmarks.contact_states.complementarity import ContactLayout
from egs_warp.contact.detection import tangent_directions
from egs_warp.locomotion.contact_modes import CoulombProgram

_REGULARIZATION = 1e-7
"""Value added to the diagonal of P, which is singular in the pyramid forces."""


@dataclass(frozen=True)
class PyramidProgram:
    """QP min 1/2 y^T P y + q^T y + constant over y = (a, f_n, f_t, lambda), subject to the pairs of Eq. (9).

    The rows A y + offset are the rows of ``ContactLayout``; contact states change only their bounds. Units: activations
    are fractions of their bounds, forces are in body weights, velocities in sqrt(g H).
    """

    layout: ContactLayout
    friction: float
    P: np.ndarray
    """(variables, variables) Hessian of the objective."""
    q: np.ndarray
    """(variables,) linear term of the objective."""
    constant: float
    """Constant term of the objective, with which it equals a sum of weighted squares and is never negative."""
    A: np.ndarray
    """(rows, variables) matrix of the constraint rows."""
    offset: np.ndarray
    """(rows,) constant of the constraint rows."""
    lower: np.ndarray
    """(M,) lower bounds of the activations."""
    upper: np.ndarray
    """(M,) upper bounds of the activations."""

    @classmethod
    def of(cls, program: CoulombProgram, directions: int) -> PyramidProgram:
        """Return the QP of ``program`` with a friction pyramid of ``directions`` edges instead of the cone."""
        layout = ContactLayout(program.activation_count, program.contact_count, directions)
        spread = _spread(layout)
        P = spread.T @ (spread.T @ program.P).T
        A, offset = _contact_rows(program.rows @ spread, program.offset, layout, program.friction)
        P = 0.5 * (P + P.T) + _REGULARIZATION * np.eye(layout.variables)
        return cls(
            *(layout, program.friction, P, spread.T @ program.q, program.constant),
            *(A, offset, program.lower, program.upper),
        )

    def bounds(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds (rows,) of A y for contact ``states`` (n,)."""
        lower, upper = self.layout.bounds(states, self.lower, self.upper)
        return lower - self.offset, upper - self.offset

    def pairs(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (pairs,) x and (pairs,) w, both sides of Eq. (9), at ``y`` (variables,)."""
        rows = self.A @ y + self.offset
        return rows[self.layout.activations : self.layout.variables], rows[self.layout.variables :]

    def objective(self, y: np.ndarray) -> float:
        """Return the objective at ``y`` (variables,), including the constant."""
        return float(0.5 * y @ self.P @ y + self.q @ y + self.constant)

    def forces_of(self, y: np.ndarray) -> np.ndarray:
        """Return (M + 3n,) activations and contact forces at ``y``, the unknowns of ``CoulombProgram``."""
        return _spread(self.layout) @ y


def _spread(layout: ContactLayout) -> sparse.csr_matrix:
    """Return the matrix (M + 3n, variables) that maps y to activations and contact forces (one normal and two
    tangential components)."""
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
    velocity_rows: np.ndarray, base: np.ndarray, layout: ContactLayout, friction: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return A and offset of the rows of ``ContactLayout``: y itself, then c, D^T u' + E lambda and mu f_n - E^T f_t
    (Eq. 9), where contact velocities are ``velocity_rows`` (3n, variables) y + ``base`` (3n,)."""
    n, nd = layout.contacts, layout.directions
    by_contact, base = np.asarray(velocity_rows).reshape(n, 3, layout.variables), base.reshape(n, 3)
    table = tangent_directions(nd)
    lam = np.zeros((n, layout.variables))
    lam[np.arange(n), layout.slip.start + np.arange(n)] = 1.0
    slip = np.einsum("dt,ntv->ndv", table, by_contact[:, 1:]) + lam[:, None, :]
    cone = np.zeros((n, layout.variables))
    cone[np.arange(n), layout.normal.start + np.arange(n)] = friction
    for k in range(nd):
        cone[np.arange(n), layout.tangent.start + nd * np.arange(n) + k] = -1.0
    A = np.vstack([np.eye(layout.variables), by_contact[:, 0], slip.reshape(n * nd, layout.variables), cone])
    offset = np.concatenate([np.zeros(layout.variables), base[:, 0], (base[:, 1:] @ table.T).ravel(), np.zeros(n)])
    return A, offset
