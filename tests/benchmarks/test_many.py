"""The figures of many runs: the rate of the middle, the aim of a GPU; and rows that outlive an error."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest

from tests.support.scripts import BENCHMARKS, module_of
from tests.support.tasks import half


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("many")


def test_the_rate_is_that_of_the_middle(many: ModuleType) -> None:
    """Slow to start and to end, ten frames a second between."""
    seen = [(0.0, 0), (30.0, 10), *((30.0 + 0.1 * k, 10 + k) for k in range(1, 90)), (80.0, 100)]
    (first, early), (last, late) = many.window(seen)
    assert (early, late) == (15, 85)
    assert (late - early) / (last - first) == pytest.approx(10.0)


def row(nodes: int, rate: float) -> dict[str, Any]:
    return {"nodes": nodes, "rate": rate}


def test_the_aim_is_one_gpus(many: ModuleType) -> None:
    rows = [row(253, 1900.0), row(253, 2100.0), row(541, 650.0)]
    on_cpu = many.summary(rows, "cpu")
    assert on_cpu["aims"] == {"many_2000": None}
    assert on_cpu["why_null"]["many_2000"] == (
        "a GPU's aim: a batch of bodies in one launch is not built; processes of this CPU make 2100.0 steps a second at"
        " 250 nodes and 650.0 steps a second at 541 nodes"
    )
    assert many.summary(rows, "cuda:0")["aims"] == {"many_2000": True}
    assert many.summary([*rows[:2], row(541, 590.0)], "cuda:0")["aims"] == {"many_2000": False}
    assert many.summary([rows[0], rows[2]], "cuda:0")["aims"] == {"many_2000": False}
    assert many.summary(rows[:2], "cuda:0")["why_null"] == {"many_2000": "not both cages were run"}


def test_rows_outlive_the_error_of_one(many: ModuleType) -> None:
    harness = __import__("harness")
    found = []
    with pytest.raises(RuntimeError, match=r"^\(7, 0\): ZeroDivisionError: division by zero$"):
        for one in harness.rows_of(half, [(7, 0), (8, 2), (9, 3)], 1):
            found.append(one)
    assert found == [{"share": 4.0}, {"share": 3.0}]
