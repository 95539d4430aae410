"""Table 2's frames and figures: every strategy gets the same programs and loses none."""

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


def assert_coulomb(pieces: CoulombProgram, x: np.ndarray) -> None:
    """Eq. (9), with the exact cone."""
    forces = x[pieces.activation_count :].reshape(-1, 3)
    speeds = (pieces.rows @ x + pieces.offset).reshape(-1, 3)
    pull, slip = np.linalg.norm(forces[:, 1:], axis=1), np.linalg.norm(speeds[:, 1:], axis=1)
    assert forces[:, 0].min() >= 0.0 and speeds[:, 0].min() > -1e-4
    assert np.abs(np.minimum(forces[:, 0], speeds[:, 0])).max() < 1e-4
    assert (pull <= pieces.friction * forces[:, 0] + 1e-9).all()
    assert (slip * (pieces.friction * forces[:, 0] - pull)).max() < 1e-4


def test_every_strategy_finds_a_point_of_every_random_program(table2: ModuleType) -> None:
    """None beats the optimum of its own friction law; the search by pieces begins where contact truly is."""
    frames = table2.random_frames(30, 0)
    for frame in frames:
        at_rest = np.concatenate([frame.foreseen.activations, frame.foreseen.forces.ravel()])
        assert_coulomb(frame.pieces, at_rest)
    figures = table2.solve_all(frames, QpSolver.DAQP, 4)
    for strategy in Strategy:
        qps, objective, true, _ = figures[strategy].T
        assert qps.min() >= 1 and np.isfinite(objective).all() and np.isfinite(true).all(), strategy
        if strategy is Strategy.MODES:
            at_rest = [
                frame.pieces.objective(np.append(f.activations, f.forces)) for frame in frames for f in [frame.foreseen]
            ]
            assert (objective <= np.array(at_rest) + 1e-6).all()
        else:
            assert (objective >= figures[Strategy.EXACT][:, 1] * (1 - 1e-4) - 1e-4).all(), strategy


def test_what_contact_answers_obeys_coulomb(table2: ModuleType) -> None:
    for frame in table2.random_frames(10, 1):
        pieces = frame.pieces
        x = np.random.default_rng(0).uniform(-1.0, 1.0, pieces.activations + 3 * pieces.contacts)
        answered = table2.answered(frame, x)
        assert np.array_equal(answered[: pieces.activations], x[: pieces.activations])
        assert_coulomb(pieces, answered)


@pytest.mark.slow
def test_every_strategy_solves_frames_of_an_animation(table2: ModuleType) -> None:
    """Their programs have the activations of its muscle groups alone, within whose bounds those that made it are."""
    frames = table2.animation_frames(table2.body_named("pawn", "cpu", nodes=60), frames=6, activations=4, contacts=3)
    assert len(frames) == 6
    for frame in frames:
        pieces = frame.pieces
        assert (pieces.activations, pieces.contacts, len(frame.foreseen.activations)) == (4, 3, 4)
        assert pieces.rows.shape == (9, 13) and pieces.P.shape == (13, 13)
        assert (pieces.lower <= frame.known).all() and (frame.known <= pieces.upper).all()
    figures = table2.solve_all(frames, QpSolver.DAQP, 4)
    for strategy in Strategy:
        qps, objective, true, _ = figures[strategy].T
        assert qps.min() >= 1 and np.isfinite(objective).all() and np.isfinite(true).all(), strategy
    made = np.array(
        [
            frame.pieces.objective(table2.answered(frame, np.append(frame.known, frame.foreseen.forces)))
            for frame in frames
        ]
    )
    # Those that see every contact state, or the cone, do as well as the activations that made the frames.
    for strategy in (Strategy.MODES, Strategy.EXACT):
        assert (figures[strategy][:, 2] <= made + 1e-6).all(), strategy
