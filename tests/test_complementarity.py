"""Contact states as bounds (Eq. 9, 12, 13): each state's rows, and pivots against brute force over all states."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from types import SimpleNamespace

import daqp
import numpy as np
import pytest

from egs_warp.complementarity import SEPARATE, STATIC, ContactLayout, proposed_pivots, states_from_prediction
from egs_warp.contact import tangent_directions
from egs_warp.locomotion import _pivot, _rows
from egs_warp.qp import QuadraticProgram

FRICTION = 0.8


@dataclass(frozen=True)
class SmallProblem:
    """Two contacts, three activations, eight degrees of freedom; units of weight and speed are 1."""

    layout: ContactLayout
    base: np.ndarray
    response: np.ndarray
    frame: np.ndarray
    shift: np.ndarray
    P: np.ndarray
    q: np.ndarray
    A: np.ndarray
    offset: np.ndarray

    def velocities(self, x: np.ndarray) -> np.ndarray:
        return (self.frame @ (self.base + self.response @ x)).reshape(-1, 3)


def small_problem(seed: int, *, contacts: int = 2, activations: int = 3, directions: int = 4) -> SmallProblem:
    """v = base + R a + J^T f with random J whose normals share a direction, asked to reach a random velocity."""
    rng = np.random.default_rng(seed)
    layout = ContactLayout(activations, contacts, directions)
    frame = rng.standard_normal((3 * contacts, 8))
    frame[0::3, 0] = 2.0
    base = rng.standard_normal(8) - 1.5 * np.eye(8)[0]
    push = frame.T.reshape(8, contacts, 3)
    table = tangent_directions(directions)
    tangent = np.einsum("vnt,dt->vnd", push[:, :, 1:], table).reshape(8, -1)
    response = np.hstack([rng.standard_normal((8, activations)), push[:, :, 0], tangent, np.zeros((8, contacts))])
    shift = rng.uniform(-0.1, 0.3, contacts)
    wanted = rng.standard_normal((4, 8))
    rows, gap = wanted @ response, wanted @ base - rng.standard_normal(4)
    P = 2.0 * rows.T @ rows + 1e-3 * np.eye(layout.variables)
    set_of = SimpleNamespace(frame=frame, count=contacts)
    A, offset = _rows(SimpleNamespace(base=base, response=response), set_of, shift, layout, FRICTION, 1.0)
    return SmallProblem(layout, base, response, frame, shift, P, 2.0 * rows.T @ gap, A, offset)


def exact(problem: SmallProblem, states: np.ndarray) -> tuple[float, np.ndarray]:
    """Optimum for one choice of states by DAQP; infinite where infeasible."""
    lower, upper = problem.layout.bounds(states)
    lower, upper = np.maximum(lower - problem.offset, -1e30), np.minimum(upper - problem.offset, 1e30)
    sense = np.where(upper - lower < 1e-12, 5, 0).astype(np.int32)
    x, value, flag, _ = daqp.solve(problem.P, problem.q, problem.A, upper, lower, sense)
    return (value, np.array(x)) if flag > 0 else (np.inf, np.array(x))


def all_states(layout: ContactLayout) -> list[np.ndarray]:
    choices = range(SEPARATE, layout.directions)
    return [np.array(s) for s in itertools.product(choices, repeat=layout.contacts)]


def test_rows_are_the_terms_of_the_lcp() -> None:
    """Eq. (9), Eq. (13): rows A y + offset are y, c = u_n + shift, D^T u + E lambda and mu f_n - E^T f_t, one by one."""
    problem = small_problem(0, contacts=3, directions=6)
    layout = problem.layout
    y = np.random.default_rng(1).standard_normal(layout.variables)
    rows = problem.A @ y + problem.offset
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


def test_every_state_satisfies_the_complementarity_conditions() -> None:
    """Eq. (9), Eq. (13): whatever the states, a feasible point has 0 <= x, 0 <= w, x.w = 0, and moves as its states say."""
    feasible = 0
    for seed in range(6):
        problem = small_problem(seed)
        layout, table = problem.layout, tangent_directions(4)
        for states in all_states(layout):
            value, y = exact(problem, states)
            if not np.isfinite(value):
                continue
            feasible += 1
            rows = problem.A @ y + problem.offset
            x, w = rows[layout.activations : layout.variables], rows[layout.variables :]
            assert x.min() > -1e-7 and w.min() > -1e-7 and np.abs(x * w).max() < 1e-6
            u, f_t = problem.velocities(y), y[layout.tangent].reshape(-1, 4) @ table
            for i, state in enumerate(states):
                if state == SEPARATE:
                    assert abs(y[layout.normal][i]) < 1e-7 and np.abs(f_t[i]).max() < 1e-7
                elif state == STATIC:
                    assert np.abs(u[i, 1:]).max() < 1e-6
                else:
                    assert np.allclose(f_t[i], FRICTION * y[layout.normal][i] * table[state], atol=1e-6)
                    assert table[state] @ u[i, 1:] < 1e-6
    assert feasible > 40


def test_states_from_prediction() -> None:
    """Eq. (12): no force separates, friction below its cap sticks, else the contact slides along the nearest -D_k."""
    normal = np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    tangential = np.array([[0, 0], [0.3, 0.2], [-0.8, 0], [0, 0.8], [0.8, 0.0]])
    slip = np.array([[1.0, 0], [0.1, 0.1], [2.0, 0.3], [0.1, -3.0], [-1.0, 0.9]])
    states = states_from_prediction(normal, tangential, slip, FRICTION, 4)
    # D_0 = +x, D_1 = +y, D_2 = -x, D_3 = -y; "slide k" slips along -D_k.
    assert states.tolist() == [SEPARATE, STATIC, 2, 1, 0]


def test_soft_bounds_keep_the_velocities_and_free_the_forces() -> None:
    """DESIGN 8: softened, the all-static choice always has a point, and whatever is solved still moves as its states say."""
    for seed in range(4):
        problem = small_problem(seed)
        program = QuadraticProgram(problem.P, problem.q, problem.A)
        for states in (np.full(2, STATIC), np.array([STATIC, SEPARATE]), np.array([0, STATIC]), np.array([2, 3])):
            lower, upper = problem.layout.bounds(states, soft=True)
            solution = program.solve(lower - problem.offset, upper - problem.offset)
            if not solution.usable:
                assert (states != STATIC).any()
                continue
            u = problem.velocities(solution.x)
            closed = states >= STATIC
            assert np.abs((u[:, 0] + problem.shift)[closed]).max(initial=0.0) < 1e-3
            assert np.abs(u[states == STATIC, 1:]).max(initial=0.0) < 1e-3


def pivoted(problem: SmallProblem, states: np.ndarray, limit: int) -> tuple[float, int]:
    program = QuadraticProgram(problem.P, problem.q, problem.A)
    linear = SimpleNamespace(base=problem.base, response=problem.response)
    stepper = SimpleNamespace(speed_scale=1.0, geometry=SimpleNamespace(friction=FRICTION))
    contacts = SimpleNamespace(frame=problem.frame)
    best, count, _ = _pivot(program, problem.layout, states, problem.offset, linear, contacts, stepper, limit)
    assert best is not None and count <= limit
    return best.objective, count


def test_pivots_never_return_a_worse_objective_and_are_bounded_by_brute_force() -> None:
    """Eq. (13): from every feasible start of 12 problems, brute-force optimum <= pivoted <= start.

    Pivots only see what the multipliers show of the next state, so many end in a local optimum.
    """
    reached = starts = improved = 0
    for seed in range(12):
        problem = small_problem(seed)
        values = {tuple(s): exact(problem, s)[0] for s in all_states(problem.layout)}
        optimum = min(values.values())
        for states, start in values.items():
            if not np.isfinite(start):
                continue
            value, _ = pivoted(problem, np.array(states), 30)
            tolerance = 2e-3 * (1.0 + abs(optimum))
            assert optimum - tolerance <= value <= start + 1e-2 * (1.0 + abs(start))  # OSQP stops at 3e-5
            starts += 1
            improved += value < start - tolerance
            reached += value < optimum + tolerance
    assert starts > 100 and improved > 0.3 * starts and reached > 0.25 * starts


def test_pivots_name_the_contact_that_helps() -> None:
    """DESIGN 8: a closed contact that holds the body down is opened, an open one that could help is closed to sliding."""
    layout = ContactLayout(0, 1, 4)
    rows = 2 * layout.variables
    x, y = np.zeros(layout.variables), np.zeros(rows)
    y[layout.paired(layout.normal)] = 0.5
    assert proposed_pivots(layout, np.array([STATIC]), x, y, np.zeros((1, 2)), FRICTION) == [(0.5, 0, SEPARATE)]
    y = np.zeros(rows)
    y[layout.normal] = 0.2
    moving = np.array([[-1.0, 0.1]])
    assert proposed_pivots(layout, np.array([SEPARATE]), x, y, moving, FRICTION) == [(0.2, 0, 0)]
    assert proposed_pivots(layout, np.array([SEPARATE]), x, y, 0 * moving, FRICTION) == [(0.2, 0, STATIC)]
    y = np.zeros(rows)
    y[layout.tangent.start + 3] = 0.3
    x[layout.normal] = 1.0
    assert proposed_pivots(layout, np.array([2]), x, y, 0 * moving, FRICTION) == [(0.3, 0, STATIC)]
    assert proposed_pivots(layout, np.array([2]), x, -y, 0 * moving, FRICTION) == []
