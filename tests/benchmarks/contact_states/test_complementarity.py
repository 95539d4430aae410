"""Contact states as bounds on rows (Eq. 9, 12, 13), and moves between states compared with an exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.contact_states.complementarity import (
    SEPARATE,
    STATIC,
    ContactLayout,
    Pivot,
    plain_pivots,
    proposed_pivots,
    states_of_modes,
    states_of_pairs,
)
from benchmarks.contact_states.pyramid_program import PyramidProgram
from egs_warp.contact.detection import tangent_directions
from egs_warp.locomotion.contact_modes import FREE, SLIDE, STICK, ContactModes
from egs_warp.locomotion.solvers import QpSolver, quadratic_program
from tests.support.contact_programs import FRICTION, optimum_of_each, small_problem


def obeys(program: PyramidProgram, y: np.ndarray, states: np.ndarray) -> bool:
    """Return True if ``y`` is a feasible point of these states."""
    lower, upper = program.bounds(states)
    rows = program.A @ y
    return bool((rows - lower).min() > -2e-5 and (upper - rows).min() > -2e-5)


def test_rows_are_the_terms_of_the_lcp() -> None:
    """Eq. (9), Eq. (13): the rows A y + offset are y, c = u_n + shift, D^T u + E lambda and mu f_n - E^T f_t, in this
    order.
    """
    problem = small_problem(0, contacts=3, directions=6)
    program, layout = problem.pyramid, problem.pyramid.layout
    y = np.random.default_rng(1).standard_normal(layout.variables)
    rows = program.A @ y + program.offset
    u, table = problem.velocities(y), tangent_directions(6)
    assert np.array_equal(rows[: layout.variables], y)
    assert np.allclose(rows[layout.paired(layout.normal)], u[:, 0] + problem.shift)
    for i in range(3):
        for k in range(6):
            row = layout.paired(layout.tangent).start + 6 * i + k
            assert rows[row] == pytest.approx(table[k] @ u[i, 1:] + y[layout.slip][i])
        f_t = y[layout.tangent][6 * i : 6 * i + 6]
        assert rows[layout.paired(layout.slip)][i] == pytest.approx(FRICTION * y[layout.normal][i] - f_t.sum())
    assert layout.paired(layout.slip).stop == len(rows)
    x, w = program.pairs(y)
    assert np.array_equal(np.concatenate([y[:3], x, w]), rows)


def test_every_state_satisfies_the_complementarity_conditions() -> None:
    """Eq. (9), Eq. (13): for any states, a feasible point has 0 <= x, 0 <= w, x.w = 0, and the contact velocities that
    its states prescribe.
    """
    feasible = between = 0
    for seed in range(8):
        problem = small_problem(seed)
        layout, table = problem.pyramid.layout, tangent_directions(4)
        for states, (_, y) in optimum_of_each(problem.pyramid).items():
            feasible += 1
            x, w = problem.pyramid.pairs(y)
            assert x.min() > -1e-6 and w.min() > -1e-6 and np.abs(x * w).max() < 1e-5
            u, f_t = problem.velocities(y), y[layout.tangent].reshape(-1, 4) @ table
            f_n = y[layout.normal]
            for i, state in enumerate(states):
                if state == SEPARATE:
                    assert abs(f_n[i]) < 1e-6 and np.abs(f_t[i]).max() < 1e-5
                elif state == STATIC:
                    assert np.abs(u[i, 1:]).max() < 1e-5
                elif state < 4:
                    assert np.allclose(f_t[i], FRICTION * f_n[i] * table[state], atol=1e-5)
                    assert table[state] @ u[i, 1:] < 1e-5
                else:
                    between += 1
                    first, second = table[state % 4], table[(state + 1) % 4]
                    assert first @ f_t[i] + second @ f_t[i] == pytest.approx(FRICTION * f_n[i], abs=1e-5)
                    assert first @ u[i, 1:] == pytest.approx(second @ u[i, 1:], abs=1e-5)
    assert feasible > 100 and between > 20


def test_states_of_modes() -> None:
    """A contact that slips along -D_k has the state "slide k"."""
    modes = ContactModes(np.array([FREE, STICK, SLIDE, SLIDE]), -tangent_directions(4)[[0, 0, 1, 2]])
    assert states_of_modes(modes, 4).tolist() == [SEPARATE, STATIC, 1, 2]


def test_states_of_pairs_admit_the_point() -> None:
    """Eq. (9): a complementary point is feasible under the states that are derived from it, whichever states it was
    solved with."""
    read = same = 0
    for seed in range(8):
        program = small_problem(seed).pyramid
        for states, (_, y) in optimum_of_each(program).items():
            found = states_of_pairs(program.layout, *program.pairs(y))
            assert obeys(program, y, found)
            read += 1
            same += tuple(found) == states
    assert read > 100 and same > 0.15 * read


def test_moves_are_feasible_and_almost_always_better() -> None:
    """The optimum of any states is feasible under the states of each proposed move, and of all moves together; most
    moves improve the objective.

    A move that follows one multiplier and ignores the other rows of the contact is often infeasible. See
    docs/concepts/locomotion.md.
    """
    proposed = solved = better = plain = plain_lost = 0
    for seed in range(12):
        program = small_problem(seed, directions=6 if seed % 2 else 4).pyramid
        qp = quadratic_program(program.P, program.q, program.A, solver=QpSolver.DAQP)
        values = optimum_of_each(program)
        for states, (value, _) in values.items():
            solution = qp.solve(*program.bounds(np.array(states)))
            arguments = (program.layout, np.array(states), *program.pairs(solution.x), solution.multipliers)
            together = np.array(states)
            for gain, contact, state in proposed_pivots(*arguments, zero=1e-5)[::-1]:
                together[contact] = state
                moved = (*states[:contact], state, *states[contact + 1 :])
                assert gain > 0.0 and obeys(program, solution.x, np.array(moved))
                proposed += 1
                if moved in values:
                    solved += 1
                    better += values[moved][0] < value - 1e-9
                    assert values[moved][0] < value + 1e-5 * (1.0 + abs(value))
            assert obeys(program, solution.x, together)
            for _, contact, state in plain_pivots(*arguments, zero=1e-5):
                plain += 1
                plain_lost += not obeys(
                    program, solution.x, np.array((*states[:contact], state, *states[contact + 1 :]))
                )
    assert proposed > 400 and solved > 0.95 * proposed and better > 0.8 * solved
    assert plain_lost > 0.1 * plain


def test_moves_select_the_contact_that_improves_the_objective() -> None:
    """A closed contact that holds the body down opens, and an open contact that would improve the objective closes and
    slides (docs/benchmarks/contact.md#moves)."""
    layout = ContactLayout(0, 1, 4)
    zeros, lam = np.zeros(6), slice(5, 6)

    def moves(state: int, x: np.ndarray, w: np.ndarray, **rows: float) -> list[Pivot]:
        y = np.zeros(12)
        for name, value in rows.items():
            y[{"f_n": 0, "f_3": 4, "c": 6, "w_0": 7, "w_1": 8, "cone": 11}[name]] = value
        return proposed_pivots(layout, np.array([state]), x, w, y)

    assert moves(STATIC, zeros, zeros, c=0.5) == [(0.5, 0, SEPARATE)]
    along = np.array([0.0, -1.0, 0.1, 1.0, -0.1, 0.0])
    assert moves(SEPARATE, zeros, along, f_n=0.2) == [(0.2, 0, 0)]
    assert moves(SEPARATE, zeros, zeros, f_n=0.2) == [(0.2, 0, STATIC)]
    assert moves(SEPARATE, zeros, along + np.eye(6)[0], f_n=0.2) == []  # c > 0: the contact is open
    loaded = np.eye(6)[0]
    assert moves(2, loaded, zeros, f_3=0.3) == [(0.3, 0, STATIC), (0.3, 0, 4 + 2)]
    assert moves(2, loaded, zeros, cone=0.4) == [(0.4, 0, STATIC)]
    assert moves(2, loaded, zeros, f_3=-0.3) == []
    sliding = loaded.copy()
    sliding[lam] = 1.0
    assert moves(2, sliding, np.zeros(6), f_3=0.3) == [(0.3, 0, 4 + 2)]
    assert moves(4 + 0, sliding, zeros, w_1=0.3) == [(0.3, 0, 0)]


def test_plain_moves_follow_the_multipliers_of_degenerate_contacts() -> None:
    """Only contacts whose free side is zero change their state, each according to its own multiplier."""
    layout = ContactLayout(0, 1, 4)
    zeros, one = np.zeros(6), np.eye(6)

    def moves(state: int, x: np.ndarray, w: np.ndarray, **rows: float) -> list[Pivot]:
        y = np.zeros(12)
        for name, value in rows.items():
            y[{"f_n": 0, "f_3": 4, "c": 6, "w_1": 8, "cone": 11}[name]] = value
        return plain_pivots(layout, np.array([state]), x, w, y)

    loaded, sliding = one[0], one[0] + one[5]
    assert moves(STATIC, zeros, zeros, c=0.5) == [(0.5, 0, SEPARATE)]
    assert moves(STATIC, loaded, one[5], c=0.5) == []
    assert moves(STATIC, loaded + one[3], zeros, w_1=0.3) == [(0.3, 0, 2)]
    assert moves(SEPARATE, zeros, zeros, f_n=0.2) == [(0.2, 0, STATIC)]
    assert moves(SEPARATE, zeros, one[0], f_n=0.2) == []
    assert moves(2, sliding, one[1] + one[2] + one[4], cone=0.4) == []
    assert moves(2, loaded, one[1] + one[2] + one[4], cone=0.4) == [(0.4, 0, STATIC)]
    assert moves(2, one[5], one[1] + one[2] + one[4], c=0.4) == [(0.4, 0, SEPARATE)]
    assert moves(2, sliding, one[1] + one[2], f_3=0.3) == [(0.3, 0, 3)]
    assert moves(2, sliding, one[1] + one[2] + one[4], c=0.4, f_3=0.3) == []
