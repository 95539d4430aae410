"""Throughput of many processes: the frame rate over the middle frames, and result rows of tasks that continue after an
error."""

from __future__ import annotations

from types import ModuleType

import pytest

from tests.support.scripts import BENCHMARKS, module_of
from tests.support.tasks import half


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("process_scaling")


def test_the_rate_is_that_of_the_middle(many: ModuleType) -> None:
    """The run is slow at its start and at its end; in between it makes ten frames per second."""
    seen = [(0.0, 0), (30.0, 10), *((30.0 + 0.1 * k, 10 + k) for k in range(1, 90)), (80.0, 100)]
    (first, early), (last, late) = many.window(seen)
    assert (early, late) == (15, 85)
    assert (late - early) / (last - first) == pytest.approx(10.0)


def test_rows_outlive_the_error_of_one(many: ModuleType) -> None:
    harness = __import__("harness")
    found = []
    with pytest.raises(RuntimeError, match=r"^\(7, 0\): ZeroDivisionError: division by zero$"):
        for one in harness.rows_of(half, [(7, 0), (8, 2), (9, 3)], 1):
            found.append(one)
    assert found == [{"share": 4.0}, {"share": 3.0}]
