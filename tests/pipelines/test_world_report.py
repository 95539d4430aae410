"""Report of a world, which names each body and each pair whose audit fails."""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

from egs_warp.locomotion.audit import Audit
from egs_warp.locomotion.world_audit import PairAudit, WorldAudit
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.world_report import Penetration, WorldReport


def _report(*, momentum: float = 0.0, body: dict[str, float] | None = None, **pair: float) -> WorldReport:
    numbers: dict[str, Any] = {each.name: 0 for each in fields(Audit)} | (body or {})
    audit = Audit(**numbers)
    row: Any = SimpleNamespace(audit=audit, state=State.DONE)
    values: dict[str, Any] = {each.name: 0.0 for each in fields(PairAudit)} | {"bodies": (0, 1)} | pair
    world = WorldAudit(momentum, 0.0, (PairAudit(**values),))
    return WorldReport({"king": row, "box": row}, {"king": "jumped", "box": "fell"}, world, stopped=False)


def test_a_correct_world_passes() -> None:
    report = _report(penetration=0.01, friction_work=-3.0)
    assert report.summary().splitlines() == ["king: jumped", "box: fell", "audit: passed"]
    written: Any = report.to_json()
    assert written["verdict"] == "audit: passed" and written["bodies"]["king"]["audit"] == "audit: passed"
    (pair,) = written["audit"]["pairs"]
    assert pair["bodies"] == ["king", "box"] and pair["friction_work"] == -3.0


def test_each_failure_is_one_line() -> None:
    report = _report(momentum=float("nan"), body={"energy_residual": 3e-6}, penetration=0.02, unmatched_contacts=2)
    assert report.summary().splitlines()[2:] == [
        "king: audit: FAILED: energy_residual 3.0 times its limit",
        "box: audit: FAILED: energy_residual 3.0 times its limit",
        "world: audit: FAILED: momentum_residual nan times its limit",
        "king and box: audit: FAILED: unmatched_contacts 2, not 0, penetration 2.0 times its limit",
    ]


def test_the_penetration_of_two_bodies_is_one_line_with_its_time() -> None:
    """The audits of both bodies contain it. A penetration of the ground is in the line of its body."""
    both = Penetration(("king", "box"), 1.25, 0.017)
    report = _report(body={"penetration": 0.017}, penetration=0.007)
    report = replace(report, penetrations={"king": both, "box": replace(both, bodies=("box", "king"))})
    (line,) = report.failures()
    assert line.startswith("king and box: audit: FAILED: penetration 1.7 times its limit, 1.7 cm deep at 1.25 s; look ")
    written: Any = report.to_json()
    assert [row["audit"] for row in written["bodies"].values()] == ["audit: passed"] * 2
    ground = replace(report, penetrations={"king": both, "box": replace(both, bodies=("box",))})
    assert [line.partition(":")[0] for line in ground.failures()] == ["box", "king and box"]


def test_a_penetration_without_an_audited_pair_stays_at_its_body() -> None:
    """The failure of a body is not lost if the audit has no pair of the two bodies."""
    report = _report(body={"penetration": 0.017})
    report = replace(report, penetrations={name: Penetration((name, "ramp"), 1.25, 0.017) for name in ("king", "box")})
    assert [line.partition(" 1.7 cm")[0] for line in report.failures()] == [
        f"{name}: audit: FAILED: penetration 1.7 times its limit," for name in ("king", "box")
    ]


def test_a_body_with_self_contact_is_paired_with_itself() -> None:
    bodies: Any = (1, 1)
    report = _report(bodies=bodies, penetration=0.02)
    assert report.failures() == ["box and itself: audit: FAILED: penetration 2.0 times its limit"]
    written: Any = report.to_json()
    assert written["audit"]["pairs"][0]["bodies"] == ["box", "box"]
