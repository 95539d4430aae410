"""Power-law fits, bins and aims of the benchmark of frame times."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest

from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def frame(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("frame")


def records(scale: float = 1.0) -> list[dict[str, Any]]:
    """Return records of steps with n nodes and c contacts, in which ``solve`` takes ``scale`` 1e-3 n^1.5 c^0.5 ms and
    ``qp`` takes 0.1 c ms."""
    made = []
    for nodes in (250, 541, 1000):
        for contacts in (0, 4, 8, 12, 30):
            stages = {"solve": scale * 1e-3 * nodes**1.5 * contacts**0.5, "qp": 0.1 * contacts}
            made.append(
                {"nodes": nodes, "contacts": contacts, "stages": stages, "total": sum(stages.values()), "wall_ms": 1.0}
            )
    return made


def test_exponents_are_those_of_the_records(frame: ModuleType) -> None:
    found = frame.exponents(records())
    assert found["solve"] == pytest.approx([1.5, 0.5]) and found["qp"] == pytest.approx([0.0, 1.0], abs=1e-9)
    assert frame.exponents([one for one in records() if one["nodes"] == 250]) == {}


def test_steps_are_grouped_by_their_contacts(frame: ModuleType) -> None:
    rows = frame.by_contacts([one for one in records() if one["nodes"] == 541])
    assert [(row["contacts"], row["steps"]) for row in rows] == [("all", 5), ("1-8", 2), ("9-16", 1), ("17-32", 1)]
    assert rows[0]["worst"] == pytest.approx(max(one["total"] for one in records() if one["nodes"] == 541))


def test_aims(frame: ModuleType) -> None:
    """A step with 541 nodes takes 35.7 ms on average: less than a tenth of 360 ms, but more than a tenth of 350 ms. The
    aim holds for captures as well as for the pawn."""
    for old, fast in ((360.0, True), (350.0, False)):
        aims = frame.summary(records(), old, "cpu")["aims"]
        assert (aims["cpu_541"], aims["cpu_10x"], aims["cpu_250_realtime"]) == (True, fast, True)
        assert aims["gpu_541"] is aims["gpu_1000"] is aims["gpu_frame_60hz"] is None
    for mean, fast in ((35.0, True), (36.0, False)):
        captures = [{"body": "monkey", "nodes": 800, "mean": mean, "old_ms": 350.0}]
        assert frame.summary(records(), 360.0, "cpu", captures)["aims"]["cpu_10x"] == fast
    assert not frame.summary(records(2.0), 400.0, "cpu")["aims"]["cpu_541"]
    assert frame.summary(records(), None, "cpu")["why_null"]["cpu_10x"]


def test_aims_of_a_gpu(frame: ModuleType) -> None:
    """The records have mean times per step of 88 ms with 1,000 nodes and 35.7 ms with 541 at scale 1, and of 12.4 ms
    and 5.6 ms at scale 0.13."""
    slow, fast = (frame.summary(records(scale), None, "cuda:0")["aims"] for scale in (1.0, 0.13))
    assert slow["cpu_541"] is fast["cpu_541"] is None
    assert (slow["gpu_541"], slow["gpu_1000"], slow["gpu_frame_60hz"]) == (False, False, None)
    assert (fast["gpu_541"], fast["gpu_1000"]) == (True, True)
    for milliseconds, often in ((16.6, True), (16.8, False)):
        made = frame.summary(records(), None, "cuda:0", pictures={"frame": milliseconds})
        assert made["aims"]["gpu_frame_60hz"] == often
