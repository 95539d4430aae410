"""Contact states of the QP and how they change (Eq. 9, 13; pivoting after Tan, Turk and Liu 2012).

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from egs_warp.contact.detection import tangent_directions

SEPARATE = -2
STATIC = -1
"""A state is SEPARATE, STATIC, or slide k: friction along +D_k and slip along -D_k for 0 <= k < n_d; n_d + k: friction
anywhere between D_k and D_(k+1), slip midway."""


class Pivot(NamedTuple):
    """A contact's move to another state."""

    gain: float
    """How strongly the multipliers ask for it."""
    contact: int
    state: int
    """The new one."""


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


@dataclass(frozen=True)
class Pairs:
    """Both sides of Eq. (9) by contact, 0 <= x and 0 <= w of which one is zero; or the multipliers of their rows."""

    normal: np.ndarray
    """(n,) x: f_n."""
    friction: np.ndarray
    """(n, n_d) x: f_t along each D."""
    slip: np.ndarray
    """(n,) x: lambda."""
    gap: np.ndarray
    """(n,) w of ``normal``: the normal measure c."""
    drift: np.ndarray
    """(n, n_d) w of ``friction``: D^T u' + lambda."""
    cone: np.ndarray
    """(n,) w of ``slip``: mu f_n less the sum of f_t."""

    @classmethod
    def of(cls, layout: ContactLayout, x: np.ndarray, w: np.ndarray) -> Pairs:
        """From x and w (pairs,) as ``ContactProgram.pairs`` gives them."""
        n, nd = layout.contacts, layout.directions
        middle = slice(n, n + n * nd)
        return cls(x[:n], x[middle].reshape(n, nd), x[middle.stop :], w[:n], w[middle].reshape(n, nd), w[middle.stop :])

    @property
    def violation(self) -> np.ndarray:
        """(n,) the largest smaller side of each contact's pairs: zero where Eq. (9) holds."""
        normal, slip = np.minimum(self.normal, self.gap), np.minimum(self.slip, self.cone)
        return np.maximum(np.maximum(normal, slip), np.minimum(self.friction, self.drift).max(axis=1))


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
    pairs, nd = Pairs.of(layout, x, w), layout.directions
    side = pairs.friction - pairs.drift
    first = np.argmax(side, axis=1)
    states, rows, rounding = first.copy(), np.arange(layout.contacts), 1e-9
    after, before = side[rows, (first + 1) % nd], side[rows, (first - 1) % nd]
    between = nd + np.where(after >= before, first, (first - 1) % nd)
    both = (np.maximum(after, before) > rounding) & (side[rows, first] > rounding)
    states[both] = between[both]
    states[pairs.cone >= pairs.slip - rounding] = STATIC
    states[pairs.normal <= pairs.gap + rounding] = SEPARATE
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
    """Moves of contacts, best first, read from the multipliers (rows,) of the rows held at zero
    (docs/concepts/locomotion.md).

    ``x`` and ``w`` (pairs,) as ``ContactProgram.pairs`` gives them. Only states that the point itself obeys are
    proposed, so no proposal is infeasible, nor are several contacts' proposals together. ``zero`` is the accuracy of x,
    w and the multipliers.
    """
    point, held = Pairs.of(layout, x, w), _multipliers(layout, multipliers)
    pivots: list[Pivot] = []
    for i, state in enumerate(states):
        if state == SEPARATE:
            moves = _moves_of_separate(i, point, held, zero)
        elif state == STATIC:
            moves = _moves_of_static(i, point, held, zero, layout.directions)
        else:
            moves = _moves_of_sliding(i, int(state), point, held, zero, layout.directions)
        pivots += [Pivot(float(gain), i, int(new)) for gain, new in moves if gain > zero]
    return sorted(pivots, key=lambda pivot: -pivot.gain)


def _multipliers(layout: ContactLayout, multipliers: np.ndarray) -> Pairs:
    return Pairs.of(layout, multipliers[layout.activations : layout.variables], multipliers[layout.variables :])


_Moves: TypeAlias = list[tuple[float, int]]
"""Gains and new states of one contact."""


def _moves_of_separate(i: int, point: Pairs, held: Pairs, zero: float) -> _Moves:
    if point.gap[i] > zero:
        return []
    along = point.drift[i] - point.slip[i]
    return [(held.normal[i], int(np.argmin(along)) if along.min() < -zero else STATIC)]


def _moves_of_static(i: int, point: Pairs, held: Pairs, zero: float, nd: int) -> _Moves:
    table = tangent_directions(nd)
    # The rows of a static contact are redundant: only their sum along D means something.
    pull = held.drift[i] @ table
    size = float(np.linalg.norm(pull))
    if point.normal[i] <= zero:
        return [(max(held.gap[i], size), SEPARATE), (size, int(np.argmin(table @ pull)))]
    if point.cone[i] > zero:
        return []
    k = int(np.argmax(point.friction[i]))
    along = float(table[k] @ pull)
    across = float(np.linalg.norm(pull - along * table[k]))
    after, before = (k + 1) % nd, (k - 1) % nd
    beside = after if point.friction[i, after] >= point.friction[i, before] else before
    if point.friction[i, beside] > zero:
        middle = table[k] + table[beside]
        return [(-float(middle @ pull), nd + (k if beside == after else before))] if middle @ pull < 0.0 else []
    return [(size, k)] if along < np.tan(np.pi / nd) * across else []


def _moves_of_sliding(i: int, state: int, point: Pairs, held: Pairs, zero: float, nd: int) -> _Moves:
    k, moves = state % nd, []
    if point.slip[i] <= zero:
        moves.append((max(held.cone[i], held.friction[i].max(initial=0.0)), STATIC))
    if point.normal[i] <= zero:
        moves.append((held.gap[i], SEPARATE))
    if state < nd:
        for between, other in ((nd + k, (k + 1) % nd), (nd + (k - 1) % nd, (k - 1) % nd)):
            if point.drift[i, other] <= zero:
                moves.append((held.friction[i, other], between))
    else:
        for left, other in ((k, (k + 1) % nd), ((k + 1) % nd, k)):
            if point.friction[i, left] <= zero:
                moves.append((held.drift[i, left], other))
    return moves


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
    point, held, nd = Pairs.of(layout, x, w), _multipliers(layout, multipliers), layout.directions
    pivots: list[Pivot] = []
    for i, state in enumerate(states):
        k = int(state)
        if state == SEPARATE:
            gains = [(held.normal[i], STATIC)] if point.gap[i] <= zero else []
        elif state == STATIC:
            gains = [(held.gap[i], SEPARATE)] if point.normal[i] <= zero else []
            if point.cone[i] <= zero:
                # Raising lambda opens every direction's row; friction stays where it is largest.
                gains.append((max(held.slip[i], held.drift[i].max()), int(np.argmax(point.friction[i]))))
        else:
            gains = [(held.cone[i], STATIC)] if point.slip[i] <= zero else []
            gains += [(held.gap[i], SEPARATE)] if point.normal[i] <= zero else []
            gains += [(held.friction[i, j], j) for j in range(nd) if j != k and point.drift[i, j] <= zero]
        pivots += [Pivot(float(gain), i, int(new)) for gain, new in gains if gain > zero]
    return sorted(pivots, key=lambda pivot: -pivot.gain)
