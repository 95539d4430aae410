"""Benchmark of parallel worlds: aims, reasons for aims that are None, and the row of a small run."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest
import torch

from tests.support.creatures import coarse_pawn
from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def many_worlds(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("many_worlds")


def row(nodes: int, rate: float, apart: float | None = 1e-12, steps: int = 30) -> dict[str, Any]:
    return {"nodes": nodes, "rate": rate, "apart": apart, "steps": steps}


def test_the_target_rate_is_for_both_cages_on_a_gpu(many_worlds: ModuleType) -> None:
    rows = [row(253, 1900.0), row(253, 2100.0), row(568, 650.0)]
    found = many_worlds.summary(rows, "cuda:0")
    assert found["aims"] == {"many_2000": True, "many_planned": None, "many_alike": True}
    assert found["why_null"] == {"many_planned": "needs runs of both cages"}
    slow = many_worlds.summary([*rows[:2], row(568, 590.0)], "cuda:0")
    assert slow["aims"]["many_2000"] is False
    assert many_worlds.summary([rows[0], rows[2]], "cuda:0")["aims"]["many_2000"] is False
    assert many_worlds.summary(rows[:2], "cuda:0")["why_null"]["many_2000"] == "needs runs of both cages"
    assert many_worlds.summary(rows, "cpu")["why_null"]["many_2000"] == "needs a GPU"


def test_planned_rows_have_a_target_of_their_own(many_worlds: ModuleType) -> None:
    planned = [{**row(253, 2600.0), "planned": True}, {**row(568, 690.0), "planned": True}]
    found = many_worlds.summary(planned, "cuda:0")["aims"]
    assert found["many_planned"] is False and found["many_2000"] is None
    planned[1]["rate"] = 710.0
    assert many_worlds.summary(planned, "cuda:0")["aims"]["many_planned"] is True


def test_all_that_were_run_alone_for_long_enough_must_be_alike(many_worlds: ModuleType) -> None:
    rows = [row(253, 1.0), row(253, 1.0, 2e-9), row(253, 1.0, None)]
    assert many_worlds.summary(rows, "cpu")["aims"]["many_alike"] is False
    assert many_worlds.summary(rows[:1], "cpu")["aims"]["many_alike"] is True
    few = [row(253, 1.0, 1e-16, 29), row(253, 1.0, None)]
    assert many_worlds.summary(few, "cpu")["why_null"]["many_alike"] == "no world was run alone for 30 steps"


@pytest.mark.slow
def test_a_row_has_rate_stage_times_and_deviation(many_worlds: ModuleType) -> None:
    creature = coarse_pawn()
    jump = many_worlds.recorded(creature, 2)
    assert jump.shape == (2, creature.muscles.segment_count)
    found = many_worlds.measure(creature, jump, 3, alone=2, panel=96, chunk_bytes=2**20)
    assert found["worlds"] == 3 and found["steps"] == 2 and found["rate"] > 0.0 and found["halved"] == 0
    assert set(found["stages"]) == {*many_worlds.STAGES, "rest"}
    planning = {"program", "search", "objectives"}
    assert all(value > 0.0 for name, value in found["stages"].items() if name not in planning)
    assert found["apart"] < 1e-12


@pytest.mark.slow
def test_a_planned_row_has_rate_stage_times_and_deviation(many_worlds: ModuleType) -> None:
    found = many_worlds.measure_planned(coarse_pawn(), 2, steps=3, alone=2, panel=96, chunk_bytes=2**20)
    assert found["rate_without_objectives"] > found["rate"] > 0.0 and found["halved"] == 0
    assert min(found["stages"].values()) > 0.0 and found["apart"] < 1e-9


def test_matrices_are_factored_with_every_panel(many_worlds: ModuleType) -> None:
    rows = many_worlds.matrices(40, 2, torch.device("cpu"))
    assert [row["panel"] for row in rows] == [None, *many_worlds.PANELS]
    assert min(row["factor"] for row in rows) > 0.0 and all(row["solve_96"] > 0.0 for row in rows[1:])
