"""Search over mode regions with QPs in the activations alone, whose results satisfy exact Coulomb contact (Eq. 9,
13)."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.locomotion.contact_modes import (
    FREE,
    SLIDE,
    STICK,
    ContactModes,
    CoulombProgram,
    ModeRegion,
    PredictedContact,
    search_modes,
    solve_mode_region,
    solve_relaxed,
)
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import RESTART_COST, Strategy, search_program

FRICTION = 0.6
CONTACTS = 3


def random_program(seed: int) -> CoulombProgram:
    """Return a program of a random stiff body with two activations and three contacts; its cost is the sum of a few
    squared velocities."""
    rng = np.random.default_rng(seed)
    to_velocity = rng.standard_normal((12, 2 + 3 * CONTACTS))
    half = rng.standard_normal((12, 12))
    inverse = half @ half.T / 12.0 + 0.5 * np.eye(12)
    frame = rng.standard_normal((3 * CONTACTS, 12))
    to_velocity[:, 2:] = inverse @ frame.T
    base = rng.standard_normal(12)
    goals = rng.standard_normal((4, 12))
    target = 0.5 * rng.standard_normal(4)
    rows, gap = goals @ to_velocity, goals @ base - target
    P = 2.0 * rows.T @ rows + np.diag([0.02, 0.02] + [0.0] * 3 * CONTACTS)
    return CoulombProgram(
        *(P, 2.0 * rows.T @ gap, float(gap @ gap), frame @ to_velocity, frame @ base, FRICTION),
        *(-np.ones(2), np.ones(2)),
    )


def under(program: CoulombProgram, activations: np.ndarray) -> np.ndarray:
    """Return x, which consists of ``activations`` (2,) and the contact forces under exact contact."""
    free = program.offset + program.rows[:, :2] @ activations
    forces, residual = coulomb_forces(program.rows[:, 2:], free, np.zeros(CONTACTS), FRICTION, np.zeros((CONTACTS, 3)))
    assert residual < 1e-9
    return np.concatenate([activations, forces.ravel()])


def started(program: CoulombProgram) -> tuple[np.ndarray, ContactModes]:
    start = under(program, np.zeros(2))
    return start, ContactModes.of(start[2:].reshape(-1, 3), FRICTION)


def larger_program(seed: int, activations: int, contacts: int) -> CoulombProgram:
    """Return a random program of the given size with a symmetric Hessian and a positive definite Delassus operator."""
    rng = np.random.default_rng(seed)
    size = activations + 3 * contacts
    half, frame = rng.standard_normal((size, size)), rng.standard_normal((3 * contacts, 3 * contacts + 4))
    rows = np.hstack([rng.standard_normal((3 * contacts, activations)), frame @ frame.T])
    return CoulombProgram(
        *(half @ half.T, rng.standard_normal(size), 0.7, rows, rng.standard_normal(3 * contacts), FRICTION),
        *(-np.ones(activations), np.ones(activations)),
    )


@pytest.mark.parametrize(("activations", "contacts"), [(1, 0), (2, 1), (5, 3), (8, 4), (13, 9), (92, 21)])
def test_a_mode_region_is_defined_by_its_modes(activations: int, contacts: int) -> None:
    """Compare a region with formulas that are written out: the forces from one linear system, the cost as a function of
    the activations alone, and the rows that bound the region."""
    program = larger_program(contacts, activations, contacts)
    rng = np.random.default_rng(activations)
    angle = rng.uniform(0.0, 2.0 * np.pi, contacts)
    for kind in (rng.integers(0, 3, contacts), np.full(contacts, STICK), np.full(contacts, SLIDE), np.zeros(contacts)):
        modes = ContactModes(kind.astype(int), np.stack([np.cos(angle), np.sin(angle)], axis=1))
        piece = ModeRegion.of(program, modes)
        assert piece is not None
        for a in (np.zeros(activations), rng.standard_normal(activations)):
            forces = (piece.force_offset + piece.force_slope @ a).reshape(-1, 3)
            x = np.concatenate([a, forces.ravel()])
            speeds = (program.rows @ x + program.offset).reshape(-1, 3)
            scale = 1e-5 * max(np.abs(forces).max(initial=1.0), 1.0)
            ends: list[list[float]] = [[], [], [], [], []]
            for i in range(contacts):
                normal, tangents, d = forces[i, 0], forces[i, 1:], modes.slip[i]
                if kind[i] == FREE:
                    assert not forces[i].any()
                    ends[4].append(speeds[i, 0])
                    continue
                # The velocity is zero up to the regularisation of the Delassus operator.
                assert abs(speeds[i, 0]) < scale
                if kind[i] == STICK:
                    assert np.abs(speeds[i]).max() < scale
                    angles = 2.0 * np.pi * np.arange(8) / 8
                    sides = np.cos(angles) * tangents[0] + np.sin(angles) * tangents[1]
                    ends[1].append(FRICTION * np.cos(np.pi / 8) * normal - sides)
                else:
                    assert np.allclose(tangents, -FRICTION * normal * d, atol=scale)
                    across = np.array([-d[1], d[0]])
                    for side, sign in ((2, 1.0), (3, -1.0)):
                        ends[side].append((0.5 * d + sign * np.sqrt(0.75) * across) @ speeds[i, 1:])
            leaves = [forces[i, 0] for kept in (STICK, SLIDE) for i in range(contacts) if kind[i] == kept]
            faces = np.array(ends[1]).T.ravel() if ends[1] else np.zeros(0)
            expected = np.concatenate([a, leaves, faces, ends[2], ends[3], ends[4]])
            found = piece.rows @ a + piece.rows_offset
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max(initial=1.0))
            cost = 0.5 * a @ piece.P @ a + piece.q @ a
            none = np.concatenate([np.zeros(activations), piece.force_offset])
            assert cost == pytest.approx(program.objective(x) - program.objective(none), rel=1e-7, abs=1e-7)
        assert np.array_equal(piece.P, piece.P.T)
        assert len(piece.contact) == len(piece.transitions) == len(piece.rows) - activations


@pytest.mark.parametrize("solver", list(QpSolver))
def test_the_search_ends_at_a_local_optimum(solver: QpSolver) -> None:
    """Compare the objective of the result under exact contact with its values for activations around the result and at
    the start.

    Each region assumes that sliding contacts keep their direction. The activations are large enough to change it, so
    the result may be slightly suboptimal.
    """
    if solver is QpSolver.DAQP:
        pytest.importorskip("daqp")
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    around = 0.03 * np.column_stack([np.cos(turns), np.sin(turns)])
    best = gained = 0
    for seed in range(12):
        program = random_program(seed)
        start, modes = started(program)
        found = search_modes(program, start, modes, qp_limit=20, solver=solver)
        assert found.x is not None and found.qp_count <= 20
        first, reached = (program.objective(x) for x in (start, under(program, found.x[:2])))
        assert reached <= first + 1e-6
        others = [program.objective(under(program, np.clip(found.x[:2] + step, -1.0, 1.0))) for step in around]
        assert first - reached >= 0.85 * (first - found.objective)
        best += min(others) > reached - 0.02 * (first - reached) - 1e-6
        gained += reached < first - 1e-3
    assert best >= 7 and gained >= 10


def test_a_costly_result_is_searched_from_the_relaxed_optimum() -> None:
    """The relaxed optimum is a lower bound on the objective under exact contact, which is evaluated on a grid of all
    activations. A search that restarts from the relaxed optimum never ends with a higher objective. Under exact
    contact, its result is at most 5 % worse than without the restart, and sometimes more than 10 % better."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 13)] * 2), axis=-1).reshape(-1, 2)
    better = worse = costly = 0
    for seed in range(40):
        program = random_program(seed)
        start, modes = started(program)
        alone = search_modes(program, start, modes, qp_limit=12, solver=QpSolver.OSQP)
        relaxed = solve_relaxed(program, QpSolver.OSQP)
        assert relaxed is not None
        cheapest = min(program.objective(under(program, a)) for a in grid)
        assert relaxed[1] <= cheapest + 1e-4 * (1.0 + cheapest)
        foreseen = PredictedContact(start[:2], start[2:].reshape(-1, 3), np.zeros((CONTACTS, 3)))
        both = search_program(program, Strategy.MODES, foreseen, directions=4, qp_limit=12)
        costly += alone.objective >= RESTART_COST
        if alone.objective < RESTART_COST:
            assert both.objective == alone.objective and both.qp_count == alone.qp_count
            continue
        assert both.objective <= alone.objective and both.qp_count > alone.qp_count
        assert both.x is not None and alone.x is not None
        before, after = (program.objective(under(program, x[:2])) for x in (alone.x, both.x))
        better += after < 0.9 * before
        worse += after > 1.05 * before
    assert costly >= 20 and better >= 3 and worse == 0


def test_the_optimum_of_a_region_satisfies_exact_contact() -> None:
    """Forces and objective of a region's optimum are those of exact contact if no contact slides."""
    kinds = set()
    for seed in range(12):
        program = random_program(seed)
        start, modes = started(program)
        kinds |= set(modes.kind.tolist())
        if (modes.kind == SLIDE).any():
            continue
        solution = solve_mode_region(program, start, modes, QpSolver.OSQP)
        assert solution is not None
        exact = under(program, solution.x[:2])
        assert np.allclose(solution.x, exact, atol=2e-3 * max(1.0, np.abs(exact).max()))
    assert kinds == {FREE, STICK, SLIDE}


def test_a_region_contains_its_start() -> None:
    """The region of the modes of a point gives the forces of that point, also those of sliding contacts."""
    for seed in range(12):
        program = random_program(seed)
        start, modes = started(program)
        held = CoulombProgram(
            *(program.P, program.q, program.constant, program.rows, program.offset, FRICTION), start[:2], start[:2]
        )
        solution = solve_mode_region(held, start, modes, QpSolver.OSQP)
        assert solution is not None
        assert np.allclose(solution.x, start, atol=1e-5 * max(1.0, np.abs(start).max()))


def test_friction_stays_opposite_to_the_slip() -> None:
    """In the result, the friction of each sliding contact is opposite to its slip to within 45 degrees. If it always
    kept its initial direction, the result could contain forces that no ground can exert."""
    angles = []
    for seed in range(40):
        program = random_program(seed)
        start, modes = started(program)
        x = search_modes(program, start, modes, qp_limit=20, solver=QpSolver.OSQP).x
        assert x is not None
        forces = x[2:].reshape(-1, 3)
        slip = (program.rows @ x + program.offset).reshape(-1, 3)[:, 1:]
        pull, speed = np.linalg.norm(forces[:, 1:], axis=1), np.linalg.norm(slip, axis=1)
        # The thresholds exclude contacts that move only because the start violates bounds.
        slides = (speed > 0.1) & (forces[:, 0] > 0.05)
        cosine = -(forces[slides, 1:] * slip[slides]).sum(axis=1) / (pull * speed)[slides]
        angles += np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).tolist()
    assert len(angles) > 20
    assert max(angles) < 45.0
