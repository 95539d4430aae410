"""Largest push that a body withstands, found by bisection, and the aims."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest

from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of


@pytest.mark.parametrize("borne", [0.0, 0.05, 0.35, 3.1, 3.15])
def test_halving_finds_the_largest_push(script: Any, monkeypatch: pytest.MonkeyPatch, borne: float) -> None:
    pushes: ModuleType = script("pushes")
    asked: list[float] = []

    def stood(_: object, line: str) -> dict[str, Any]:
        asked.append(float(line.split()[1]))
        return {"withstood": asked[-1] < borne + 1e-9, "broken": None}

    monkeypatch.setattr(pushes, "stood", stood)
    size, tried = pushes.largest(None, "0.3 {} left")
    assert size == pytest.approx(borne) and len(tried) == len(set(asked)) == 6
    assert pushes.aims([{"largest": size, "tried": tried}]) == {"audit": True, "bear_0.1": borne >= 0.1}
    assert not pushes.aims([{"largest": size, "tried": [*tried, {"broken": "audit"}]}])["audit"]


def test_a_pushed_body_is_judged_by_its_soles(script: Any) -> None:
    """The aim requires at least 14 bodies, all of which withstand the push."""
    gaits: ModuleType = script("gaits")
    assert gaits._push_failure({"tilt_degrees": 2.0, "sole_shift": 0.02}) is None
    assert gaits._push_failure({"tilt_degrees": 20.0, "sole_shift": 0.02}) == "leans: tilt 20 degrees"
    assert gaits._push_failure({"tilt_degrees": 2.0, "sole_shift": 0.4}) == "a sole was 0.40 body heights off"
    rows = [{"body": str(k), "cell": "push", "success": True, "fallen": None} for k in range(14)]
    found = gaits.summary(rows, whole=True)
    assert found["aims"]["pushes"] is True and "pushes" not in found["why_null"]
    assert gaits.summary([*rows, rows[0] | {"success": False}], whole=True)["aims"]["pushes"] is False
    told = gaits.summary(rows[:3], whole=True)["why_null"]["pushes"]
    assert told == "not all cells of 14 bodies, or of the unseen ones, were run"
    unseen = [rows[0] | {"body": name} for name in gaits.UNSEEN]
    assert gaits.summary(unseen, whole=True)["aims"]["pushes"] is True
    others = [row | {"cell": "walk"} for row in rows]
    assert gaits.summary(others, whole=True)["why_null"]["pushes"] == "no such cells were run"
