"""Choice of a search by its name, and restart of the mode search."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp.errors import UserError
from egs_warp.locomotion.contact_modes import ContactModes, PredictedContact, search_modes
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import RESTART_COST, Strategy, search_program
from tests.support.contact_programs import FRICTION, small_problem


def test_strategies_and_solvers_are_chosen_by_name() -> None:
    settings = LocomotionSettings(strategy="paper", qp_solver="daqp")
    assert Strategy(settings.strategy) is Strategy.PAPER and QpSolver(settings.qp_solver) is QpSolver.DAQP
    assert settings.qp_solver_on(wp.get_device("cpu")) is QpSolver.DAQP
    gpu: Any = SimpleNamespace(is_cuda=True)
    assert LocomotionSettings().qp_solver_on(gpu) is QpSolver.ADMM
    assert LocomotionSettings(qp_solver="osqp").qp_solver_on(gpu) is QpSolver.OSQP
    assert LocomotionSettings().qp_solver_on(wp.get_device("cpu")) is QpSolver.OSQP
    with pytest.raises(UserError, match="strategy 'nonsense' is not known; give one of modes, paper"):
        LocomotionSettings(strategy="nonsense")
    with pytest.raises(UserError, match="QP solver 'nonsense' is not known; give one of osqp, admm, daqp"):
        LocomotionSettings(qp_solver="nonsense")


@pytest.mark.parametrize("bound", [None, 1.0, 0.5])
def test_a_second_search_only_if_uncertain(bound: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the result is within 1.2 times the lower bound, or the bound is not known, there is one more QP; otherwise
    there is a second search."""
    program = small_problem(3, contacts=3, directions=8, freedoms=14).coulomb
    forces = np.zeros((3, 3))
    predicted = PredictedContact(np.zeros(3), forces, forces)
    start = np.zeros(12)
    once = search_modes(program, start, ContactModes.of(forces, FRICTION), qp_limit=8, solver=QpSolver.DAQP)
    assert once.objective > RESTART_COST
    relaxed = None if bound is None else (np.zeros(3), bound * once.objective)
    monkeypatch.setattr("egs_warp.locomotion.strategies.solve_relaxed", lambda *given, **options: relaxed)
    found = search_program(program, Strategy.MODES, predicted, directions=8, qp_limit=8, solver=QpSolver.DAQP)
    assert found.objective <= once.objective
    assert (found.qp_count > once.qp_count + 1) == (bound == 0.5)
