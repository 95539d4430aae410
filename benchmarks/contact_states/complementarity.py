"""Contact states of the QP and changes of state (Eq. 9, 13; pivoting after Tan, Turk and Liu 2012).

See docs/benchmarks/contact.md#searches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from egs_warp.contact.detection import tangent_directions
from egs_warp.locomotion.contact_modes import FREE, STICK, ContactModes

SEPARATE = -2
STATIC = -1
"""A state is ``SEPARATE``, ``STATIC`` or slide k: for 0 <= k < n_d, friction acts along +D_k and the slip is along
-D_k; in state n_d + k, friction acts between D_k and D_(k+1) and slip is midway between -D_k and -D_(k+1)."""


class Pivot(NamedTuple):
    """Proposed change of the state of one contact."""

    gain: float
    """Magnitude of the multiplier that proposes the move."""
    contact: int
    state: int
    """Proposed new state of the contact."""


@dataclass(frozen=True)
class ContactLayout:
    """Layout of the unknowns y = (a, f_n, f_t, lambda) and of the rows (y, c, D^T u' + E lambda, mu f_n - E^T f_t) of
    Eq. (9)."""

    activations: int
    """Number of activations M."""
    contacts: int
    """Number of contacts n."""
    directions: int
    """Number of friction directions n_d."""

    @property
    def variables(self) -> int:
        """Number of unknowns M + n (n_d + 2)."""
        return self.activations + self.contacts * (self.directions + 2)

    @property
    def normal(self) -> slice:
        """Slice of f_n; shifted by ``variables - activations`` it gives the rows of c."""
        return slice(self.activations, self.activations + self.contacts)

    @property
    def tangent(self) -> slice:
        """Slice of f_t, contact by contact."""
        return slice(self.normal.stop, self.normal.stop + self.contacts * self.directions)

    @property
    def slip(self) -> slice:
        """Slice of the slip variables lambda."""
        return slice(self.tangent.stop, self.variables)

    def paired(self, part: slice) -> slice:
        """Return the rows of w that are complementary to the unknowns in the slice ``part``."""
        shift = self.variables - self.activations
        return slice(part.start + shift, part.stop + shift)

    def free_directions(self, states: np.ndarray) -> np.ndarray:
        """Return (n, n_d) bool, True where friction along D_k is free and its slip row is fixed to zero."""
        nd = self.directions
        free = np.zeros((self.contacts, nd), bool)
        free[states == STATIC] = True
        sliding = np.flatnonzero(states >= 0)
        free[sliding, states[sliding] % nd] = True
        between = np.flatnonzero(states >= nd)
        free[between, (states[between] + 1) % nd] = True
        return free

    def bounds(self, states: np.ndarray, lowest: np.ndarray, highest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds of all rows. Each of the ``states`` (n,) fixes one side of each pair to zero;
        the activations are between ``lowest`` and ``highest`` (M,)."""
        lower = np.zeros(2 * self.variables - self.activations)
        upper = np.full_like(lower, np.inf)
        lower[: self.activations], upper[: self.activations] = lowest, highest
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
    """Both sides of the pairs of Eq. (9), 0 <= x and 0 <= w with x w = 0, by contact; or the multipliers of their
    rows."""

    normal: np.ndarray
    """(n,) x: normal forces f_n."""
    friction: np.ndarray
    """(n, n_d) x: friction forces f_t along each of the directions D."""
    slip: np.ndarray
    """(n,) x: slip variables lambda."""
    gap: np.ndarray
    """(n,) w of ``normal``: the normal measure c."""
    drift: np.ndarray
    """(n, n_d) w of ``friction``: D^T u' + E lambda."""
    cone: np.ndarray
    """(n,) w of ``slip``: mu f_n minus the sum of f_t."""

    @classmethod
    def of(cls, layout: ContactLayout, x: np.ndarray, w: np.ndarray) -> Pairs:
        """Split ``x`` and ``w`` (pairs,), as returned by ``PyramidProgram.pairs``."""
        n, nd = layout.contacts, layout.directions
        middle = slice(n, n + n * nd)
        return cls(x[:n], x[middle].reshape(n, nd), x[middle.stop :], w[:n], w[middle].reshape(n, nd), w[middle.stop :])

    @property
    def violation(self) -> np.ndarray:
        """(n,) complementarity violation of each contact, the maximum over its pairs of the smaller side.

        It is zero where Eq. (9) is satisfied.
        """
        normal, slip = np.minimum(self.normal, self.gap), np.minimum(self.slip, self.cone)
        return np.maximum(np.maximum(normal, slip), np.minimum(self.friction, self.drift).max(axis=1))


def states_of_modes(modes: ContactModes, directions: int) -> np.ndarray:
    """Return the states (n,) of ``modes`` whose sliding contacts slip along one of ``directions``."""
    slide = np.argmin(modes.slip @ tangent_directions(directions).T, axis=1)
    return np.where(modes.kind == FREE, SEPARATE, np.where(modes.kind == STICK, STATIC, slide)).astype(int)


def states_of_pairs(layout: ContactLayout, x: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the states (n,) in which the larger side of each pair is free, for ``x`` and ``w`` (pairs,) of
    ``PyramidProgram.pairs``."""
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
    """Propose changes of state from the multipliers, best first (docs/benchmarks/contact.md#moves).

    Only states that the current point satisfies are proposed, so each proposal is feasible, and so are several at once.

    Args:
        layout: layout of unknowns and rows.
        states: (n,) current states.
        x: (pairs,) left sides of Eq. (9), from ``PyramidProgram.pairs``.
        w: (pairs,) right sides of Eq. (9), from ``PyramidProgram.pairs``.
        multipliers: (rows,) multipliers of all rows; only the multipliers of rows fixed to zero are used.
        zero: values of x, w and the multipliers that are not larger than this are treated as zero.
    """
    point, multiplier = Pairs.of(layout, x, w), _multipliers(layout, multipliers)
    pivots: list[Pivot] = []
    for i, state in enumerate(states):
        if state == SEPARATE:
            moves = _moves_of_separate(i, point, multiplier, zero)
        elif state == STATIC:
            moves = _moves_of_static(i, point, multiplier, zero, layout.directions)
        else:
            moves = _moves_of_sliding(i, int(state), point, multiplier, zero, layout.directions)
        pivots += [Pivot(float(gain), i, int(new)) for gain, new in moves if gain > zero]
    return sorted(pivots, key=lambda pivot: -pivot.gain)


def _multipliers(layout: ContactLayout, multipliers: np.ndarray) -> Pairs:
    """Split the multipliers (rows,) into the multipliers of the two rows of each pair."""
    return Pairs.of(layout, multipliers[layout.activations : layout.variables], multipliers[layout.variables :])


_Moves: TypeAlias = list[tuple[float, int]]
"""Gain and new state of each possible move of one contact."""


def _moves_of_separate(i: int, point: Pairs, multiplier: Pairs, zero: float) -> _Moves:
    if point.gap[i] > zero:
        return []
    along = point.drift[i] - point.slip[i]
    return [(multiplier.normal[i], int(np.argmin(along)) if along.min() < -zero else STATIC)]


def _moves_of_static(i: int, point: Pairs, multiplier: Pairs, zero: float, nd: int) -> _Moves:
    table = tangent_directions(nd)
    # The rows of a static contact are linearly dependent, so only the sum of their multipliers along D is determined.
    gradient = multiplier.drift[i] @ table
    size = float(np.linalg.norm(gradient))
    if point.normal[i] <= zero:
        return [(max(multiplier.gap[i], size), SEPARATE), (size, int(np.argmin(table @ gradient)))]
    if point.cone[i] > zero:
        return []
    k = int(np.argmax(point.friction[i]))
    along = float(table[k] @ gradient)
    across = float(np.linalg.norm(gradient - along * table[k]))
    after, before = (k + 1) % nd, (k - 1) % nd
    neighbour = after if point.friction[i, after] >= point.friction[i, before] else before
    if point.friction[i, neighbour] > zero:
        middle = table[k] + table[neighbour]
        return (
            [(-float(middle @ gradient), nd + (k if neighbour == after else before))] if middle @ gradient < 0.0 else []
        )
    return [(size, k)] if along < np.tan(np.pi / nd) * across else []


def _moves_of_sliding(i: int, state: int, point: Pairs, multiplier: Pairs, zero: float, nd: int) -> _Moves:
    k, moves = state % nd, []
    if point.slip[i] <= zero:
        moves.append((max(multiplier.cone[i], multiplier.friction[i].max(initial=0.0)), STATIC))
    if point.normal[i] <= zero:
        moves.append((multiplier.gap[i], SEPARATE))
    if state < nd:
        for between, other in ((nd + k, (k + 1) % nd), (nd + (k - 1) % nd, (k - 1) % nd)):
            if point.drift[i, other] <= zero:
                moves.append((multiplier.friction[i, other], between))
    else:
        for left, other in ((k, (k + 1) % nd), ((k + 1) % nd, k)):
            if point.friction[i, left] <= zero:
                moves.append((multiplier.drift[i, left], other))
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
    """Propose changes of state like the pivots of a QPCC, the baseline: each multiplier is considered on its own.

    The arguments are the same as for ``proposed_pivots``.

    A contact whose free side is zero changes to the state in which the row of the multiplier is free: static to
    separate or slide k, slide k to static, separate or slide j, separate to static.
    """
    point, multiplier, nd = Pairs.of(layout, x, w), _multipliers(layout, multipliers), layout.directions
    pivots: list[Pivot] = []
    for i, state in enumerate(states):
        k = int(state)
        if state == SEPARATE:
            gains = [(multiplier.normal[i], STATIC)] if point.gap[i] <= zero else []
        elif state == STATIC:
            gains = [(multiplier.gap[i], SEPARATE)] if point.normal[i] <= zero else []
            if point.cone[i] <= zero:
                # A positive lambda frees the row of every direction; friction remains only in the direction in which it
                # is largest.
                gains.append((max(multiplier.slip[i], multiplier.drift[i].max()), int(np.argmax(point.friction[i]))))
        else:
            gains = [(multiplier.cone[i], STATIC)] if point.slip[i] <= zero else []
            gains += [(multiplier.gap[i], SEPARATE)] if point.normal[i] <= zero else []
            gains += [(multiplier.friction[i, j], j) for j in range(nd) if j != k and point.drift[i, j] <= zero]
        pivots += [Pivot(float(gain), i, int(new)) for gain, new in gains if gain > zero]
    return sorted(pivots, key=lambda pivot: -pivot.gain)
