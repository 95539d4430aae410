"""Number of threads of linear algebra in a step."""

from __future__ import annotations

from typing import Any

import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from egs_warp.locomotion.stepper import LocomotionStepper
from tests.support.live_sessions import coarse_pawn


def _threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().info() if library["user_api"] == "blas"}


def test_a_step_uses_one_blas_thread_and_restores_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step sets the number of BLAS threads to one, whatever number the calling program has set, and restores it."""
    pawn, seen = coarse_pawn(), []
    step = LocomotionStepper.step

    def watched(self: LocomotionStepper, *arguments: Any) -> Any:
        seen.append(_threads())
        return step(self, *arguments)

    monkeypatch.setattr(LocomotionStepper, "step", watched)
    with threadpool_limits(limits=2, user_api="blas"):
        before = _threads()
        pawn.stepper.advance(pawn.start, pawn.stepper.initial_memory(), [], 1.0 / 60.0)
        assert seen == [{1}] and before == {2} and _threads() == {2}
