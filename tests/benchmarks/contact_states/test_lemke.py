"""Lemke's method on contact problems of full and deficient rank."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.contact_states.lemke import lemke
from tests.support.contact_programs import small_problem


def contact_lcp(seed: int, contacts: int, freedoms: int) -> tuple[np.ndarray, np.ndarray]:
    program = small_problem(seed, contacts=contacts, freedoms=freedoms).pyramid
    layout = program.layout
    rows, offset = program.A[layout.variables :], program.offset[layout.variables :]
    a = np.random.default_rng(seed).uniform(-1, 1, layout.activations)
    return rows[:, layout.activations :], rows[:, : layout.activations] @ a + offset


@pytest.mark.parametrize(("contacts", "freedoms"), [(1, 8), (3, 12), (5, 6), (8, 6), (32, 6), (32, 100)])
def test_contact_problems_are_solved(contacts: int, freedoms: int) -> None:
    """Eq. (9): 0 <= z, 0 <= w and z.w = 0 to rounding, also for more loaded contacts than the body has degrees of
    freedom."""
    for seed in range(6):
        matrix, q = contact_lcp(seed, contacts, freedoms)
        z = lemke(matrix, q)
        assert z is not None
        w = matrix @ z + q
        assert z.min() >= 0.0 and w.min() > -1e-9 and np.abs(z * w).max() < 1e-9


def test_closed_forms() -> None:
    """For a positive q, z is zero; a single row gives z = -q / m; a row that no z can make non-negative has no
    solution."""
    still = lemke(np.eye(2), np.array([1.0, 0.0]))
    assert still is not None and np.array_equal(still, np.zeros(2))
    assert lemke(np.array([[2.0]]), np.array([-3.0])) == pytest.approx([1.5])
    assert lemke(np.array([[-1.0]]), np.array([-1.0])) is None


def test_ties_terminate() -> None:
    """Equal rows of the matrix, and zero or equal entries of q, cause ties; the lexicographic rule still terminates."""
    matrix = np.ones((6, 6)) + np.kron(np.eye(3), np.ones((2, 2)))
    z = lemke(matrix, np.array([-1.0, -1.0, -1.0, -1.0, 0.0, 0.0]))
    assert z is not None
    w = matrix @ z + np.array([-1.0, -1.0, -1.0, -1.0, 0.0, 0.0])
    assert w.min() > -1e-12 and np.abs(z * w).max() < 1e-12
