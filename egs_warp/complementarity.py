"""Contact states of the QP and how they change (Eq. 9, 13; pivoting after Tan, Turk and Liu 2012; DESIGN 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact import tangent_directions

SEPARATE = -2
STATIC = -1
"""A state is SEPARATE, STATIC, or k >= 0: friction along +D_k and slip along -D_k."""


@dataclass(frozen=True)
class ContactLayout:
    """Where the unknowns y = (a, f_n, f_t, lambda) and the rows (y, c, D^T u' + E lambda, mu f_n - E^T f_t) lie."""

    activations: int
    """M."""
    contacts: int
    """n."""
    directions: int
    """n_d."""

    @property
    def variables(self) -> int:
        """M + n (n_d + 2)."""
        return self.activations + self.contacts * (self.directions + 2)

    @property
    def normal(self) -> slice:
        """f_n; shifted by ``variables - activations`` these are the rows of c."""
        return slice(self.activations, self.activations + self.contacts)

    @property
    def tangent(self) -> slice:
        """f_t, contact-major."""
        return slice(self.normal.stop, self.normal.stop + self.contacts * self.directions)

    @property
    def slip(self) -> slice:
        """lambda."""
        return slice(self.tangent.stop, self.variables)

    def paired(self, part: slice) -> slice:
        """Rows of the w that is complementary to this part of x."""
        shift = self.variables - self.activations
        return slice(part.start + shift, part.stop + shift)

    def bounds(self, states: np.ndarray, *, soft: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all rows: each state holds one side of each pair at zero.

        ``soft`` drops the friction cone and the sign of f_n, so that some force always fits the states' velocities.
        """
        n, nd = self.contacts, self.directions
        lower = np.zeros(2 * self.variables - self.activations)
        upper = np.full_like(lower, np.inf)
        lower[: self.activations], upper[: self.activations] = -1.0, 1.0
        touching = states >= STATIC
        sliding = states >= 0
        held_tangent = np.ones((n, nd), bool)
        held_tangent[states == STATIC] = False
        held_tangent[np.flatnonzero(sliding), states[sliding]] = False
        upper[self.normal][~touching] = 0.0
        upper[self.paired(self.normal)][touching] = 0.0
        upper[self.tangent][held_tangent.ravel()] = 0.0
        upper[self.paired(self.tangent)][~held_tangent.ravel()] = 0.0
        upper[self.slip][states == STATIC] = 0.0
        upper[self.paired(self.slip)][states != STATIC] = 0.0
        if soft:
            lower[self.normal][touching] = -np.inf
            lower[self.tangent][~held_tangent.ravel()] = -np.inf
            lower[self.paired(self.slip)] = -np.inf
            upper[self.paired(self.slip)] = np.inf
        return lower, upper


def states_from_prediction(
    normal_forces: np.ndarray, tangential: np.ndarray, velocities: np.ndarray, friction: float, directions: int
) -> np.ndarray:
    """(n,) states from stage 1: forces (n,), friction (n, 2) newtons and tangential velocities (n, 2) m/s (Eq. 12)."""
    table = tangent_directions(directions)
    static = np.linalg.norm(tangential, axis=1) < 0.999 * friction * normal_forces
    slide = np.argmin(velocities @ table.T, axis=1)
    return np.where(normal_forces <= 0.0, SEPARATE, np.where(static, STATIC, slide)).astype(int)


def proposed_pivots(
    layout: ContactLayout,
    states: np.ndarray,
    x: np.ndarray,
    multipliers: np.ndarray,
    tangential_velocity: np.ndarray,
    friction: float,
) -> list[tuple[float, int, int]]:
    """(gain, contact, new state), best first, read from the multipliers of the rows held at zero (DESIGN 8).

    ``tangential_velocity`` (n, 2) in the units of lambda.
    """
    n, nd = layout.contacts, layout.directions
    table = tangent_directions(nd)
    f_n = x[layout.normal]
    f_t = x[layout.tangent].reshape(n, nd)
    y_force = multipliers[layout.normal]
    y_tangent_force = multipliers[layout.tangent].reshape(n, nd)
    y_slip = multipliers[layout.slip]
    y_normal = multipliers[layout.paired(layout.normal)]
    y_tangent = multipliers[layout.paired(layout.tangent)].reshape(n, nd)
    tolerance = 1e-6
    pivots: list[tuple[float, int, int]] = []
    for i, state in enumerate(states):
        if state == STATIC:
            pull = y_tangent[i] @ table
            if f_n[i] <= tolerance:
                gain = max(y_normal[i], float(np.linalg.norm(pull)))
                if gain > tolerance:
                    pivots.append((gain, i, SEPARATE))
            elif f_t[i].sum() >= friction * f_n[i] - tolerance:
                k = int(np.argmax(f_t[i]))
                along = float(table[k] @ pull)
                across = float(np.linalg.norm(pull - along * table[k]))
                if along < np.tan(np.pi / nd) * across and np.linalg.norm(pull) > tolerance:
                    pivots.append((float(np.linalg.norm(pull)), i, k))
        elif state == SEPARATE:
            if y_force[i] > tolerance:
                slip = table @ tangential_velocity[i]
                closed = int(np.argmin(slip)) if slip.min() < -tolerance else STATIC
                pivots.append((float(y_force[i]), i, closed))
        else:
            stick = max(y_slip[i], float(y_tangent_force[i].max(initial=0.0)))
            if x[layout.slip][i] <= tolerance and stick > tolerance:
                pivots.append((stick, i, STATIC))
            elif f_n[i] <= tolerance and y_normal[i] > tolerance:
                pivots.append((float(y_normal[i]), i, SEPARATE))
    return sorted(pivots, key=lambda p: -p[0])
