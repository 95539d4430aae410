"""Factorisation of matrices and tests of its status."""

from __future__ import annotations

from typing import Any

from egs_warp.fem.linear_solver import FactorStatus, LinearSolver


def is_definite(solver: LinearSolver, *matrix: Any) -> bool:
    """Factor ``matrix``, the arguments of ``LinearSolver.factor``; return True if it is positive definite."""
    solver.factor(*matrix)
    return solver.status is FactorStatus.DEFINITE


def has_factors(solver: LinearSolver) -> bool:
    """Return True if factors of the last matrix exist."""
    return solver.status is not FactorStatus.NONE
