"""Search over mode regions in one kernel launch, which on every device gives the result of the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.kernels.locomotion import mode_region, mode_search
from egs_warp.kernels.locomotion.active_set import INFEASIBLE, OPTIMUM_FOUND, ActiveSet, UnitConstraints
from egs_warp.kernels.locomotion.splitting import Splitting
from egs_warp.locomotion import active_set, solvers, strategies
from egs_warp.locomotion.active_set import WhitenedQp, solve_from_guess
from egs_warp.locomotion.contact_modes import (
    SLIDE,
    STICK,
    ContactModes,
    CoulombProgram,
    ModeSearchResult,
    PredictedContact,
    search_modes,
    solve_mode_region,
    solve_relaxed,
)
from egs_warp.locomotion.device_search import ModeSearchWorkspace, RelaxationWorkspace, search_modes_device
from egs_warp.locomotion.operator_splitting import warm_start
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy, search_program
from egs_warp.precision import real
from tests.support.kernels import algebra_kernel, iterate_kernel

DEVICES = [str(device) for device in wp.get_devices()]
FRICTION = 0.6


def body_program(
    seed: int, activations: int, contacts: int, *, bias: float = 0.0, softness: float | None = None
) -> CoulombProgram:
    """Return the program of a random body with objectives on some of its velocities.

    Args:
        bias: speed that is subtracted from the normal velocities of all contacts.
        softness: if given, contacts share six rigid motions, and move relative to each other by this fraction.
    """
    rng = np.random.default_rng(seed)
    freedoms = activations + 2 * contacts + 6
    half = rng.standard_normal((freedoms, freedoms)) / np.sqrt(freedoms)
    inverse = half @ half.T + 0.3 * np.eye(freedoms)
    frame = rng.standard_normal((3 * contacts, freedoms))
    if softness is not None:
        rigid = rng.standard_normal((3 * contacts, 6)) @ rng.standard_normal((6, freedoms))
        frame = rigid + softness * frame
    columns = np.hstack([rng.standard_normal((freedoms, activations)), inverse @ frame.T])
    base = 0.3 * rng.standard_normal(freedoms)
    base -= bias * np.linalg.pinv(frame)[:, ::3].sum(axis=1) if contacts else 0.0
    goals = rng.standard_normal((max(3, activations // 2), freedoms))
    rows, gap = goals @ columns, goals @ base - rng.standard_normal(len(goals))
    weights = np.concatenate([np.full(activations, 0.05), np.zeros(3 * contacts)])
    return CoulombProgram(
        *(2.0 * rows.T @ rows + np.diag(weights), 2.0 * rows.T @ gap, float(gap @ gap)),
        *(frame @ columns, frame @ base, FRICTION, -np.ones(activations), np.ones(activations)),
    )


def entered(program: CoulombProgram) -> tuple[np.ndarray, ContactModes]:
    """Return x for zero activations, and the contact modes at x."""
    m, n = program.activation_count, program.contact_count
    forces, _ = coulomb_forces(program.rows[:, m:], program.offset, np.zeros(n), FRICTION, np.zeros((n, 3)))
    return np.concatenate([np.zeros(m), forces.ravel()]), ContactModes.of(forces, FRICTION)


def both(program: CoulombProgram, device: str, limit: int = 12) -> tuple[ModeSearchResult | None, ModeSearchResult]:
    start, modes = entered(program)
    given: dict[str, Any] = {"qp_limit": limit}
    here = search_modes(program, start, modes, solver=QpSolver.OSQP, **given)
    return search_modes_device(program, start, modes, device=wp.get_device(device), **given), here


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("activations", "contacts"), [(1, 0), (2, 1), (5, 3), (9, 8), (23, 11)])
def test_one_launch_finds_the_result_of_the_host(activations: int, contacts: int, device: str) -> None:
    """The search passes through the same regions to the same point, for sticking and sliding contacts."""
    alike = several = slid = 0
    for seed in range(12):
        program = body_program(seed, activations, contacts, bias=0.5 * (seed % 3))
        slid += (entered(program)[1].kind == SLIDE).any()
        there, here = both(program, device)
        if there is None:
            continue
        assert here.x is not None and there.x is not None
        assert there.objective == pytest.approx(program.objective(there.x), rel=1e-9, abs=1e-9)
        same = there.qp_count == here.qp_count and np.allclose(there.x, here.x, rtol=1e-6, atol=1e-6)
        alike += same
        # In these cases two regions are tied, and rounding decides between them.
        assert same or there.objective <= here.objective + 0.1 * abs(here.objective)
        several += here.qp_count > 1
    assert alike >= 10
    if contacts > 2:
        assert several >= 6 and slid >= 4


@pytest.mark.parametrize("device", DEVICES)
def test_at_the_limit_the_best_result_so_far_is_returned(device: str) -> None:
    program = body_program(3, 9, 8, bias=0.5)
    whole = both(program, device)[1]
    assert whole.qp_count > 2
    last = np.inf
    for limit in range(1, whole.qp_count + 1):
        there, here = both(program, device, limit)
        assert there is not None and there.qp_count == here.qp_count == limit
        # Rows may be violated by 1e-7, which changes the objective by about as much.
        assert there.objective == pytest.approx(here.objective, abs=1e-7 * program.constant)
        assert there.objective <= last
        last = there.objective


@pytest.mark.parametrize("device", DEVICES)
def test_infeasible_sticking_contacts_slide(device: str) -> None:
    """Two points at the same position that must stick with different velocities have no feasible forces; if they may
    slide, there are feasible ones."""
    counts = set()
    for seed in range(30):
        program = body_program(seed, 3, 4, bias=1.0)
        program.lower[:], program.upper[:] = -1e-3, 1e-3
        there, here = both(program, device)
        if there is not None:
            assert there.infeasible == here.infeasible and (there.x is None) == (here.x is None)
            counts.add(there.infeasible)
    assert {0, 1} <= counts


def test_the_default_strategy_falls_back_to_the_host(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program = body_program(1, 5, 3, bias=0.5)
    start, modes = entered(program)
    forces = start[5:].reshape(-1, 3)
    asked: list[int] = []

    def counted(*given: Any, **named: Any) -> ModeSearchResult | None:
        asked.append(named["qp_limit"])
        return search_modes_device(*given, **named) if len(asked) == 1 else None

    monkeypatch.setattr(strategies, "search_modes_device", counted)
    given: dict[str, Any] = {"directions": 4, "qp_limit": 9, "device": "cpu"}
    foreseen = PredictedContact(np.zeros(5), forces, np.zeros((3, 3)))
    found = [search_program(program, Strategy.MODES, foreseen, solver="admm", **given) for _ in range(2)]
    assert asked[:2] == [9, 9]
    assert found[0].x is not None and found[1].x is not None
    np.testing.assert_allclose(found[0].x, found[1].x, atol=1e-6)
    search_program(program, Strategy.MODES, foreseen, solver="osqp", **given)
    assert len(asked) == 2 and modes.kind.max() >= STICK


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("own", [-1.0, 0.0])
def test_contacts_without_a_pivot_are_left_to_the_host(own: float, device: str) -> None:
    """The elimination does not pivot. A program with a contact whose force does not change its own velocity is left to
    the host. A contact whose force has the opposite effect, which coupled friction can cause, is eliminated on the
    device."""
    program = body_program(2, 3, 2, bias=1.0)
    speeds = program.rows[:, 3:]
    speeds[3, :] = 0.0
    # This entry cancels the regularisation of the diagonal.
    speeds[3, 3] = own or -mode_region.DELASSUS_REGULARIZATION * np.abs(np.delete(np.diag(speeds), 3)).sum() / 6.0
    start = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    modes = ContactModes(np.full(2, STICK), np.tile([1.0, 0.0], (2, 1)))
    there = search_modes_device(program, start, modes, qp_limit=3, device=wp.get_device(device))
    if own == 0.0:
        assert there is None
        return
    here = search_modes(program, start, modes, qp_limit=3, solver=QpSolver.OSQP)
    assert there is not None and there.qp_count == here.qp_count and there.infeasible == here.infeasible
    assert there.objective == pytest.approx(here.objective, rel=1e-7)


@pytest.mark.parametrize("device", DEVICES)
def test_almost_redundant_contacts_do_not_fail(device: str) -> None:
    """Rows of the contacts of a stiff base are nearly dependent, which makes the updated inverse of the active rows
    inaccurate. The search recovers from this error and finds the optimum of its first region.

    The solvers relax the bounds by different small distances. By duality, a relaxation by d lowers the optimum by at
    most d times the sum of the multipliers, which are large here. Beyond that, objectives of programs that differ by
    1e-15 differ by up to 5 %, because the equations for the contact forces have a condition number of 1e7.
    """
    relaxation, rounding = 5e-5, 0.1
    for seed in range(40):
        program = body_program(seed, 20, 12, softness=1e-4)
        start, modes = entered(program)
        there = search_modes_device(program, start, modes, device=wp.get_device(device), qp_limit=1)
        assert there is not None and search_modes_device(
            program, start, modes, qp_limit=12, device=wp.get_device(device)
        )
        sticking = ContactModes(np.where(modes.kind == SLIDE, STICK, modes.kind), modes.slip)
        here = solve_mode_region(program, start, sticking, QpSolver.DAQP)
        assert (there.x is None) == (here is None)
        if here is not None:
            least = (1.0 - rounding) * here.objective - relaxation * here.multiplier.sum()
            assert least <= there.objective <= (1.0 + rounding) * here.objective


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("activations", "contacts"), [(1, 1), (5, 3), (9, 8), (23, 11)])
def test_one_launch_finds_the_relaxed_optimum(activations: int, contacts: int, device: str) -> None:
    """The relaxed optimum equals that of the host, in a workspace of larger capacity; no search has a lower
    objective."""
    search = ModeSearchWorkspace(activations, contacts + 2, device)
    room = RelaxationWorkspace(activations, contacts + 2, search)
    alike = apart = 0
    for seed in range(12):
        program = body_program(seed, activations, contacts, bias=0.5 * (seed % 3))
        found = search.search(program, *entered(program), 12)
        room.enqueue()
        there, here = room.parse_result(), solve_relaxed(program, QpSolver.OSQP)
        assert here is not None
        if there is None:
            continue
        assert there[1] == pytest.approx(here[1], rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(there[0][:activations], here[0], atol=1e-5)
        alike += 1
        if found is not None:
            assert there[1] <= found.objective + 1e-6 * program.constant
            apart += there[1] < 0.99 * found.objective
    assert alike >= 11 and apart >= 3


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 7, 8, 9, 16, 31, 50, 130])
def test_block_algebra(count: int, device: str) -> None:
    """Products, roots of inverses, elimination, lists and lengths equal NumPy's, for sizes around those of blocks."""
    rng, right = np.random.default_rng(count), 5
    matrix = rng.standard_normal((count, count + right)) + 3.0 * np.eye(count, count + right) * np.sqrt(count)
    half = rng.standard_normal((count, count))
    symmetric = half @ half.T + np.eye(count)
    marks = rng.integers(0, 2, count + right) * rng.integers(-3, 4, count + right)
    given = [wp.array(each, dtype=real, device=device) for each in (matrix, symmetric)]
    made = [wp.zeros((count, count), dtype=real, device=device) for _ in range(3)]
    numbers = [wp.array(marks.astype(np.int32), dtype=int, device=device)]
    numbers += [wp.zeros(size, dtype=int, device=device) for size in (count, 4)]
    which, shares = rng.integers(0, count, (count, 3)), rng.standard_normal((count, 3))
    parts = [wp.array(which.astype(np.int32), dtype=int, device=device), wp.array(shares, dtype=real, device=device)]
    lengths, across = (wp.zeros(count, dtype=real, device=device) for _ in range(2))
    wp.launch(
        algebra_kernel,
        1 if device == "cpu" else mode_search.BLOCK,
        inputs=[count, count + right, *given, *made, *numbers, *parts, lengths, across],
        device=device,
        block_dim=mode_search.BLOCK,
    )
    root, product, turned = (each.numpy() for each in made)
    np.testing.assert_allclose(product, matrix[:, :count] @ symmetric, atol=1e-10 * count)
    np.testing.assert_allclose(turned, matrix[:, :count].T @ symmetric, atol=1e-10 * count)
    np.testing.assert_allclose(root @ root.T @ symmetric, np.eye(count), atol=1e-9)
    assert np.array_equal(root, np.triu(root))
    told = numbers[2].numpy().tolist()
    listed = np.flatnonzero(marks)
    assert told == [1, 1, len(listed), 0 if device == "cpu" else 6]
    kept = min(len(listed), count)
    np.testing.assert_array_equal(numbers[1].numpy()[:kept], listed[:kept])
    left = given[0].numpy()
    expected = np.linalg.solve(matrix[:, :count], matrix[:, count:])
    np.testing.assert_allclose(left[:, count:], expected, rtol=1e-9, atol=1e-9)
    long = np.linalg.norm((shares[:, :, None] * left[which]).sum(axis=1), axis=1)
    np.testing.assert_allclose(lengths.numpy(), long, rtol=1e-9)
    np.testing.assert_allclose(parts[1].numpy(), shares / long[:, None], rtol=1e-9)
    np.testing.assert_allclose(across.numpy(), product.T @ long, rtol=1e-9, atol=1e-9 * count)


def test_tolerances_equal_those_of_the_host() -> None:
    """The kernels define these constants again, because they do not import host modules."""
    device_values = mode_region.ROW_TOLERANCE, mode_region.BOUND_PADDING, mode_search.INFEASIBLE_COST
    host_values = active_set._BOUND_TOLERANCE, solvers._BOUND_PADDING * 3e-5, active_set._INFEASIBLE_COST
    assert [float(each) for each in device_values] == pytest.approx(host_values, rel=1e-12)


def filled(made: Any, device: str, **shapes: Any) -> Any:
    """Fill the struct ``made`` with zeros of these shapes, or with the values of arrays."""
    for name, given in shapes.items():
        kind = int if name in ("side", "active", "cancelled", "base_rows") else real
        array = given if isinstance(given, np.ndarray) else np.zeros(given)
        setattr(made, name, wp.array(np.ascontiguousarray(array), dtype=kind, device=device))
    return made


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", range(6))
def test_a_block_iterates_as_osqp_and_ends_at_the_optimum(seed: int, device: str) -> None:
    """For min 1/2 z^T z with constraint rows of unit length, the kernel guesses the same active rows as OSQP's
    iterations and ends at the optimum, from any start."""
    rng, n, m = np.random.default_rng(seed), 12, 60
    units = rng.standard_normal((m, n))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    free, start = rng.standard_normal(m), 0.3 * seed * rng.standard_normal(n)
    lower = np.where(rng.uniform(size=m) < 0.8, -0.8, -np.inf)
    upper = np.where(rng.uniform(size=m) < 0.5, 0.9, np.inf)
    broken = (free < lower) | (free > upper)
    assert 5 < broken.sum() <= n + 30
    chosen = np.flatnonzero(broken)[:n]
    side = np.zeros(m, np.int32)
    side[chosen] = np.where(free[chosen] < lower[chosen], 1, -1)
    near = warm_start(units[chosen], (lower - free)[chosen], (upper - free)[chosen], start)
    pushes = np.zeros(m)
    pushes[chosen] = near.multipliers
    at = free + units @ near.x
    expected = np.where(at - lower < -pushes, 1, np.where(upper - at < pushes, -1, 0))
    rows = filled(
        UnitConstraints(), device, units=units, values_at_origin=free, lower=lower, upper=upper,
        slack=np.full(m, 1e-8),
        cancelled=1, base_values=m, base_rows=np.arange(m)[:, None].repeat(3, 1),
        coefficients=np.eye(1, 3).repeat(m, 0),
    )  # fmt: skip
    rows.unknowns, rows.count, rows.base_count, rows.cost_limit = n, m, m, 1e6
    holding = filled(
        ActiveSet(), device, side=side, active=n, values=m,
        **dict.fromkeys(("multipliers", "z", "dual_direction", "scratch_a"), n),
        **dict.fromkeys(("scratch_b", "entering_row", "orthogonal_part"), n),
        **dict.fromkeys(("active_rows", "active_columns", "products", "root", "inverse"), (n, n)),
    )  # fmt: skip
    splitting = filled(
        Splitting(), device, initial_values=units @ start, all_multipliers=m,
        **dict.fromkeys(("rows", "projected", "multipliers", "sums", "right", "between", "step"), n),
    )  # fmt: skip
    guessed, ended = (wp.zeros(count, dtype=int, device=device) for count in (m, 1))
    wp.launch(
        iterate_kernel,
        1 if device == "cpu" else mode_search.BLOCK,
        inputs=[rows, holding, splitting, guessed, ended],
        device=device,
        block_dim=mode_search.BLOCK,
    )
    # A row that is at its bound, up to rounding, may be counted on either side.
    sure = np.minimum(np.abs(at - lower + pushes), np.abs(upper - at - pushes)) > 1e-9
    np.testing.assert_array_equal(guessed.numpy()[sure], expected[sure])
    assert sure.sum() > m - 3 and np.count_nonzero(expected) > 2
    np.testing.assert_allclose(splitting.multipliers.numpy()[: len(chosen)], near.multipliers, atol=1e-8)
    np.testing.assert_allclose(splitting.rows.numpy()[: len(chosen)], units[chosen] @ near.x, atol=1e-8)
    exact = solve_from_guess(
        WhitenedQp.of(np.eye(n), np.zeros(n), units), lower - free, upper - free, free < lower, free > upper
    )
    assert exact is not None
    assert ended.numpy()[0] == (OPTIMUM_FOUND if exact.feasible else INFEASIBLE)
    if exact.feasible:
        np.testing.assert_allclose(holding.z.numpy(), exact.x, atol=1e-6)
