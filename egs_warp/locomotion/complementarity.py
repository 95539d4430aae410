"""Contact states of the QP and how they change (Eq. 9, 13; pivoting after Tan, Turk and Liu 2012; DESIGN 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact.detection import tangent_directions

SEPARATE = -2
STATIC = -1
"""A state is SEPARATE, STATIC, or slide k: friction along +D_k and slip along -D_k for 0 <= k < n_d; n_d + k: friction
anywhere between D_k and D_(k+1), slip midway."""

Pivot = tuple[float, int, int]
"""(gain, contact, new state)."""


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

    def free_directions(self, states: np.ndarray) -> np.ndarray:
        """(n, n_d) whether friction along D_k is free (and the slip row held)."""
        nd = self.directions
        free = np.zeros((self.contacts, nd), bool)
        free[states == STATIC] = True
        sliding = np.flatnonzero(states >= 0)
        free[sliding, states[sliding] % nd] = True
        between = np.flatnonzero(states >= nd)
        free[between, (states[between] + 1) % nd] = True
        return free

    def bounds(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all rows: each state (n,) holds one side of each pair at zero."""
        lower = np.zeros(2 * self.variables - self.activations)
        upper = np.full_like(lower, np.inf)
        lower[: self.activations], upper[: self.activations] = -1.0, 1.0
        touching = states >= STATIC
        free = self.free_directions(states).ravel()
        upper[self.normal][~touching] = 0.0
        upper[self.paired(self.normal)][touching] = 0.0
        upper[self.tangent][~free] = 0.0
        upper[self.paired(self.tangent)][free] = 0.0
        upper[self.slip][states == STATIC] = 0.0
        upper[self.paired(self.slip)][states != STATIC] = 0.0
        return lower, upper


def states_from_prediction(
    normal_forces: np.ndarray, tangential: np.ndarray, velocities: np.ndarray, friction: float, directions: int
) -> np.ndarray:
    """(n,) states from stage 1: forces (n,), friction (n, 2) newtons and tangential velocities (n, 2) m/s (Eq. 12)."""
    table = tangent_directions(directions)
    static = np.linalg.norm(tangential, axis=1) < 0.999 * friction * normal_forces
    slide = np.argmin(velocities @ table.T, axis=1)
    return np.where(normal_forces <= 0.0, SEPARATE, np.where(static, STATIC, slide)).astype(int)


def states_of_pairs(layout: ContactLayout, x: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(n,) states of the larger side of each pair: x and w (pairs,) as ``ContactProgram.pairs`` gives them."""
    n, nd = layout.contacts, layout.directions
    f_n, f_t, lam = x[:n], x[n : n + n * nd].reshape(n, nd), x[n + n * nd :]
    c, w_t, cone = w[:n], w[n : n + n * nd].reshape(n, nd), w[n + n * nd :]
    side = f_t - w_t
    first = np.argmax(side, axis=1)
    states, rows, rounding = first.copy(), np.arange(n), 1e-9
    after, before = side[rows, (first + 1) % nd], side[rows, (first - 1) % nd]
    between = nd + np.where(after >= before, first, (first - 1) % nd)
    both = (np.maximum(after, before) > rounding) & (side[rows, first] > rounding)
    states[both] = between[both]
    states[cone >= lam - rounding] = STATIC
    states[f_n <= c + rounding] = SEPARATE
    return states


def proposed_pivots(
    layout: ContactLayout,
    states: np.ndarray,
    x: np.ndarray,
    w: np.ndarray,
    multipliers: np.ndarray,
    *,
    zero: float = 1e-4,
) -> list[Pivot]:
    """(gain, contact, new state), best first, read from the multipliers (rows,) of the rows held at zero (DESIGN 8).

    ``x`` and ``w`` (pairs,) as ``ContactProgram.pairs`` gives them. Only states that the point itself obeys are
    proposed, so no proposal is infeasible, nor are several contacts' proposals together. ``zero`` is the accuracy of x,
    w and the multipliers.
    """
    n, nd = layout.contacts, layout.directions
    table = tangent_directions(nd)
    friction, slip = slice(n, n + n * nd), slice(n + n * nd, None)
    f_n, f_t, lam = x[:n], x[friction].reshape(n, nd), x[slip]
    c, w_t, cone = w[:n], w[friction].reshape(n, nd), w[slip]
    y_x, y_w = multipliers[layout.activations : layout.variables], multipliers[layout.variables :]
    y_force, y_friction = y_x[:n], y_x[friction].reshape(n, nd)
    y_normal, y_slip, y_cone = y_w[:n], y_w[friction].reshape(n, nd), y_w[slip]
    pivots: list[Pivot] = []

    def propose(gain: float, contact: int, state: int) -> None:
        if gain > zero:
            pivots.append((float(gain), contact, int(state)))

    for i, state in enumerate(states):
        if state == SEPARATE:
            if c[i] <= zero:
                along = w_t[i] - lam[i]
                propose(y_force[i], i, int(np.argmin(along)) if along.min() < -zero else STATIC)
        elif state == STATIC:
            # The rows of a static contact are redundant: only their sum along D means something.
            pull = y_slip[i] @ table
            size = float(np.linalg.norm(pull))
            if f_n[i] <= zero:
                propose(max(y_normal[i], size), i, SEPARATE)
                propose(size, i, int(np.argmin(table @ pull)))
            elif cone[i] <= zero:
                k = int(np.argmax(f_t[i]))
                along = float(table[k] @ pull)
                across = float(np.linalg.norm(pull - along * table[k]))
                after, before = (k + 1) % nd, (k - 1) % nd
                beside = after if f_t[i, after] >= f_t[i, before] else before
                if f_t[i, beside] > zero:
                    middle = table[k] + table[beside]
                    if middle @ pull < 0.0:
                        propose(-float(middle @ pull), i, nd + (k if beside == after else before))
                elif along < np.tan(np.pi / nd) * across:
                    propose(size, i, k)
        else:
            k = int(state % nd)
            if lam[i] <= zero:
                propose(max(y_cone[i], y_friction[i].max(initial=0.0)), i, STATIC)
            if f_n[i] <= zero:
                propose(y_normal[i], i, SEPARATE)
            if state < nd:
                for between, other in ((nd + k, (k + 1) % nd), (nd + (k - 1) % nd, (k - 1) % nd)):
                    if w_t[i, other] <= zero:
                        propose(y_friction[i, other], i, between)
            else:
                for held, other in ((k, (k + 1) % nd), ((k + 1) % nd, k)):
                    if f_t[i, held] <= zero:
                        propose(y_slip[i, held], i, other)
    return sorted(pivots, key=lambda p: -p[0])


def plain_pivots(
    layout: ContactLayout,
    states: np.ndarray,
    x: np.ndarray,
    w: np.ndarray,
    multipliers: np.ndarray,
    *,
    zero: float = 1e-4,
) -> list[Pivot]:
    """The moves of ``proposed_pivots`` as a QPCC pivots without our corrections: each multiplier is taken at its word.

    A contact whose free side is zero goes to the state in which the multiplier's row is free: static to separate or
    slide k, slide k to static, separate or slide j, separate to static. For the baseline.
    """
    n, nd = layout.contacts, layout.directions
    friction, slip = slice(n, n + n * nd), slice(n + n * nd, None)
    f_n, f_t, lam = x[:n], x[friction].reshape(n, nd), x[slip]
    c, w_t, cone = w[:n], w[friction].reshape(n, nd), w[slip]
    y_x, y_w = multipliers[layout.activations : layout.variables], multipliers[layout.variables :]
    y_force, y_friction, y_lambda = y_x[:n], y_x[friction].reshape(n, nd), y_x[slip]
    y_normal, y_slip, y_cone = y_w[:n], y_w[friction].reshape(n, nd), y_w[slip]
    pivots: list[Pivot] = []
    for i, state in enumerate(states):
        k = int(state)
        if state == SEPARATE:
            gains = [(y_force[i], STATIC)] if c[i] <= zero else []
        elif state == STATIC:
            gains = [(y_normal[i], SEPARATE)] if f_n[i] <= zero else []
            if cone[i] <= zero:
                # Raising lambda opens every direction's row; friction stays where it is largest.
                gains.append((max(y_lambda[i], y_slip[i].max()), int(np.argmax(f_t[i]))))
        else:
            gains = [(y_cone[i], STATIC)] if lam[i] <= zero else []
            gains += [(y_normal[i], SEPARATE)] if f_n[i] <= zero else []
            gains += [(y_friction[i, j], j) for j in range(nd) if j != k and w_t[i, j] <= zero]
        pivots += [(float(gain), i, int(new)) for gain, new in gains if gain > zero]
    return sorted(pivots, key=lambda p: -p[0])
