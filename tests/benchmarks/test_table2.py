"""Frames and measures of Table 2: every strategy solves all of the same programs."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from egs_warp.locomotion.contact_modes import CoulombProgram
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy
from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def table2(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("table2")


def assert_coulomb(program: CoulombProgram, x: np.ndarray) -> None:
    """Assert that ``x`` satisfies Eq. (9) with the exact friction cone."""
    forces = x[program.activation_count :].reshape(-1, 3)
    speeds = (program.rows @ x + program.offset).reshape(-1, 3)
    pull, slip = np.linalg.norm(forces[:, 1:], axis=1), np.linalg.norm(speeds[:, 1:], axis=1)
    assert forces[:, 0].min() >= 0.0 and speeds[:, 0].min() > -1e-4
    assert np.abs(np.minimum(forces[:, 0], speeds[:, 0])).max() < 1e-4
    assert (pull <= program.friction * forces[:, 0] + 1e-9).all()
    assert (slip * (program.friction * forces[:, 0] - pull)).max() < 1e-4


def test_every_strategy_finds_a_point_of_every_random_program(table2: ModuleType) -> None:
    """No strategy has an objective below the optimum of its friction law; the search over modes starts from exact
    contact."""
    frames = table2.random_frames(30, 0)
    for frame in frames:
        at_rest = np.concatenate([frame.predicted.activations, frame.predicted.forces.ravel()])
        assert_coulomb(frame.program, at_rest)
    figures = table2.solve_all(frames, QpSolver.DAQP, 4)
    for strategy in table2.SEARCHES:
        qps, objective, true, _ = figures[strategy].T
        assert qps.min() >= 1 and np.isfinite(objective).all() and np.isfinite(true).all(), strategy
        if strategy is Strategy.MODES:
            at_rest = [
                frame.program.objective(np.append(f.activations, f.forces))
                for frame in frames
                for f in [frame.predicted]
            ]
            assert (objective <= np.array(at_rest) + 1e-6).all()
        else:
            assert (objective >= figures[table2.StateSearch.EXACT][:, 1] * (1 - 1e-4) - 1e-4).all(), strategy


def test_exact_forces_satisfy_coulomb(table2: ModuleType) -> None:
    for frame in table2.random_frames(10, 1):
        program = frame.program
        x = np.random.default_rng(0).uniform(-1.0, 1.0, program.activation_count + 3 * program.contact_count)
        exact = table2.with_exact_forces(frame, x)
        assert np.array_equal(exact[: program.activation_count], x[: program.activation_count])
        assert_coulomb(program, exact)


@pytest.mark.slow
def test_every_strategy_solves_frames_of_an_animation(table2: ModuleType) -> None:
    """The activations of a program are those of the frame's muscle groups, and the known activations are within the
    bounds."""
    frames = table2.animation_frames(table2.body_named("pawn", "cpu", nodes=60), frames=6, activations=4, contacts=3)
    assert len(frames) == 6
    for frame in frames:
        program = frame.program
        assert (program.activation_count, program.contact_count, len(frame.predicted.activations)) == (4, 3, 4)
        assert program.rows.shape == (9, 13) and program.P.shape == (13, 13)
        assert (program.lower <= frame.known).all() and (frame.known <= program.upper).all()
    figures = table2.solve_all(frames, QpSolver.DAQP, 4)
    for strategy in table2.SEARCHES:
        qps, objective, true, _ = figures[strategy].T
        assert qps.min() >= 1 and np.isfinite(objective).all() and np.isfinite(true).all(), strategy
    made = np.array(
        [
            frame.program.objective(table2.with_exact_forces(frame, np.append(frame.known, frame.predicted.forces)))
            for frame in frames
        ]
    )
    # Strategies over all contact states, or with the exact cone, do at least as well as the known activations of the
    # frames.
    for strategy in (Strategy.MODES, table2.StateSearch.EXACT):
        assert (figures[strategy][:, 2] <= made + 1e-6).all(), strategy
