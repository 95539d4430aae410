"""Lemke's method for linear complementarity problems."""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dger  # pyright: ignore[reportAttributeAccessIssue]  # compiled: not in the stubs


def lemke(matrix: np.ndarray, q: np.ndarray, *, pivot_limit: int = 2000) -> np.ndarray | None:
    """Solve the linear complementarity problem 0 <= z, 0 <= w = matrix z + q, z^T w = 0.

    For the contact rows of Eq. (9) the matrix is copositive, so the method ends at a solution (Anitescu and Potra
    1997). Ties are broken lexicographically by the columns of the basis inverse, so degenerate problems cannot cycle.

    Args:
        matrix: (n, n).
        q: (n,).
        pivot_limit: maximum number of pivots.

    Returns:
        z (n,), or None on a secondary ray or at ``pivot_limit``.
    """
    count = len(q)
    if count == 0 or q.min() >= 0.0:
        return np.zeros(count)
    # Columns: w (n), z (n), the covering variable, the right-hand side, for w - M z - e z0 = q.
    tableau = np.asfortranarray(np.hstack([np.eye(count), -matrix, -np.ones((count, 1)), q[:, None]]))
    basis = np.arange(count)
    scale = 1e-11 * max(1.0, float(np.abs(matrix).max()))
    row, entering = int(np.argmin(q)), 2 * count
    for _ in range(pivot_limit):
        leaving = basis[row]
        pivot_row = tableau[row] / tableau[row, entering]
        column = tableau[:, entering].copy()
        column[row] -= 1.0
        tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=True)
        basis[row] = entering
        if leaving == 2 * count:
            return _solution(tableau, basis)
        entering = leaving + count if leaving < count else leaving - count
        column = tableau[:, entering]
        usable = np.flatnonzero(column > scale)
        if len(usable) == 0:
            # No row can leave the basis: a secondary ray. If the covering variable is already zero, the point is the
            # solution.
            return _solution(tableau, basis) if tableau[basis == 2 * count, -1].item() < 1e-11 else None
        row = _smallest_ratio(tableau, column, usable, basis, 2 * count)
    return None


def _solution(tableau: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return the solution z (n,) of a final tableau."""
    count = len(tableau)
    values = np.zeros(2 * count + 1)
    values[basis] = tableau[:, -1]
    return np.maximum(values[count : 2 * count], 0.0)


def _smallest_ratio(tableau: np.ndarray, column: np.ndarray, rows: np.ndarray, basis: np.ndarray, cover: int) -> int:
    """Return the row with the smallest ratio. In a tie, return the row of the covering variable if it is among them,
    else the lexicographic minimum."""
    count = len(tableau)
    for index in (-1, *range(count)):
        ratios = tableau[rows, index] / column[rows]
        low = ratios.min()
        rows = rows[ratios <= low + 1e-12 * max(1.0, abs(low))]
        if len(rows) == 1:
            break
        if index == -1 and (basis[rows] == cover).any():
            return int(rows[basis[rows] == cover][0])
    return int(rows[0])
