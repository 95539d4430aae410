"""Comparison of OSQP's iterations as kernels with OSQP, on programs of a coarse body's steps."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.locomotion.admm import DenseQp
from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        return module_of("qp_kernels")


@pytest.fixture(scope="module")
def programs(benchmark: ModuleType) -> list[Any]:
    """Programs of the first steps of a jump."""
    return benchmark.recorded(pawn, 60, "jump", limit=14, seed=0)


@pytest.mark.slow
def test_recorded_programs_end_as_in_osqp(benchmark: ModuleType, programs: list[Any], device: str) -> None:
    """Both solvers end with the same status, and their solutions differ by at most 1e-6 of the largest |x|.

    This holds for ADMM run to full accuracy, for 50 iterations, and for the complete solve of the engine.
    """
    assert (
        len(programs) == 14
        and any(one.skip_splitting for one in programs)
        and not all(one.skip_splitting for one in programs)
    )
    everything, alone = benchmark.full(programs, device)
    assert everything["programs"] == everything["solved"] == alone["programs"] == 14 and alone["motion"] == "pawn jump"
    assert not everything["unlike"] and 0.0 < everything["worst"] <= 1e-6
    # Rounding accumulates over tens of thousands of iterations.
    assert everything["same_iterations"] >= 13
    for row in (benchmark.few(programs, device), benchmark.whole(programs, device)):
        assert not row["unlike"] and row["worst"] <= 1e-6


def test_non_unique_solutions_are_compared_by_their_values(benchmark: ModuleType) -> None:
    """Compare optima of min (x1 + x2 - 1)^2, which form a line; the rows of A distinguish points."""
    P, q = 2.0 * np.ones((2, 2)), np.full(2, -2.0)
    bounds = np.array([0.0]), np.array([np.inf])
    one = benchmark.Recorded("", DenseQp(P, q, np.array([[1.0, 1.0]])), *bounds, None, False)
    assert one.flat
    assert benchmark.relative_difference(one, np.array([1.0, 0.0]), np.array([0.0, 1.0])) == 0.0
    assert benchmark.relative_difference(one, np.array([1.0, 1.0]), np.array([0.0, 1.0])) == pytest.approx(1.0)
    sharp = benchmark.Recorded("", DenseQp(np.eye(2), q, np.eye(2)), *bounds, None, False)
    assert not sharp.flat and benchmark.relative_difference(sharp, np.array([1.0, 0.0]), np.array([1.0, 1e-3])) == 1e-3


def test_aims(benchmark: ModuleType) -> None:
    row = {"kind": "full", "motion": "all", "programs": 1000, "unlike": [], "worst": 1e-7}
    assert benchmark.aims([row], "cuda:0")[0] == {"gpu_equal": True, "cpu_equal": None, "thousand": True}
    assert benchmark.aims([row], "cpu")[1] == {"gpu_equal": "the kernels ran on cpu"}
    for wrong in ({"worst": 2e-6}, {"unlike": ["3: SOLVED LIMIT"]}):
        assert benchmark.aims([row | wrong | {"programs": 999}], "cpu")[0] == {
            "cpu_equal": False,
            "gpu_equal": None,
            "thousand": False,
        }
