"""Branch and bound compared with an exhaustive search over contact states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.contact_states.branch_and_bound import ExactResult, exact_states
from benchmarks.contact_states.complementarity import STATIC
from tests.support.contact_programs import optimum_of_each, small_problem


@pytest.mark.parametrize(("contacts", "directions", "seeds"), [(1, 4, 120), (1, 8, 3), (2, 4, 3), (2, 8, 3), (3, 4, 3)])
def test_the_optimum_equals_brute_force(contacts: int, directions: int, seeds: int) -> None:
    """Eq. (9), Eq. (13): the objective equals the minimum over all states, the solution is complementary, and far fewer
    QPs are solved than there are states. Among many problems with one contact, each state is optimal at least once.
    """
    best_states = set()
    for seed in range(seeds):
        program = small_problem(seed, contacts=contacts, directions=directions).pyramid
        tried = optimum_of_each(program)
        best = min(value for value, _ in tried.values())
        best_states |= {states for states, (value, _) in tried.items() if value == best}
        found = exact_states(program)
        assert found is not None and found.proved
        assert found.objective == pytest.approx(best, rel=1e-6, abs=1e-6)
        assert found.bound <= found.objective
        x, w = program.pairs(found.y)
        assert x.min() > -1e-6 and w.min() > -1e-6 and np.abs(x * w).max() < 1e-5
        assert found.objective == pytest.approx(program.objective(found.y))
        assert found.qp_count < 0.5 * (2 * directions + 2) ** contacts + 20
    if seeds > 3:
        assert len(best_states) == 2 * directions + 2


def test_the_bounds_of_the_activations_hold() -> None:
    """The optimum is within the program's bounds on the activations, which need not be -1 and 1."""
    program = small_problem(5).pyramid
    narrow = replace(program, lower=np.full(3, -0.05), upper=np.full(3, 0.02))
    found, best = exact_states(narrow), min(value for value, _ in optimum_of_each(narrow).values())
    assert found is not None and found.objective == pytest.approx(best, rel=1e-6, abs=1e-6)


def test_starts_change_only_the_number_of_qps() -> None:
    """The optimum does not depend on the initial states. From the optimal states, the search takes at most one QP
    more."""
    program = small_problem(5, contacts=3).pyramid
    plain = exact_states(program)
    assert plain is not None
    good = exact_states(program, starts=(plain.states,))
    bad = exact_states(program, starts=(np.full(3, STATIC),))
    assert good is not None and bad is not None
    assert good.objective == pytest.approx(plain.objective) and bad.objective == pytest.approx(plain.objective)
    assert good.qp_count <= plain.qp_count + 1


def test_a_limited_search_is_not_a_proof() -> None:
    """A search that reaches its limit of QPs reports a lower bound on the optimum."""
    program = small_problem(5, contacts=3).pyramid
    whole = exact_states(program)
    assert whole is not None
    cut = exact_states(program, starts=(whole.states,), qp_limit=6)
    assert cut is not None and not cut.proved
    assert cut.bound < whole.objective <= cut.objective + 1e-9
    assert exact_states(program, qp_limit=1) is None


@pytest.mark.slow
def test_the_bound_of_a_limited_search_is_valid() -> None:
    """For any limit of QPs, the bound is below the optimum; it does not decrease as the limit grows."""
    for seed in range(5, 9):
        program = small_problem(seed, contacts=3).pyramid
        whole = exact_states(program)
        assert whole is not None
        bounds = []
        for limit in range(2, whole.qp_count + 1):
            cut = exact_states(program, starts=(whole.states,), qp_limit=limit)
            assert cut is not None and cut.bound <= whole.objective + 1e-6
            bounds.append(cut.bound)
        assert (np.diff(bounds) >= -1e-6).all() and bounds[0] < whole.objective - 1e-3


@pytest.mark.parametrize("objective", [0.0, 0.3, -4.0, 1e3])
def test_optimality_gap_of_a_proof(objective: float) -> None:
    """A result is proved optimal if objective - bound <= 1e-6 (1 + abs(objective))."""
    for share, proved in ((0.9e-6, True), (1.1e-6, False)):
        bound = objective - share * (1.0 + abs(objective))
        assert ExactResult(np.zeros(1), np.zeros(1, int), objective, bound, 1).proved == proved
