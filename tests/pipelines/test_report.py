"""Report of a run: times of stages, versions of packages, and lines of the summary."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from egs_warp.locomotion.audit import Audit
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import MotionOutcome
from egs_warp.motions.act import ActOutcome
from egs_warp.motions.footfalls import Footfalls
from egs_warp.motions.gestures import GestureOutcome
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.report import MotionReport, Report, StageTime, stage_times, versions, written_audit


def test_a_frame_without_a_stage_spends_no_time_in_it() -> None:
    """Three frames have two, one and one steps, and only the last step is replanned. The times of a frame are sums over
    its steps."""
    spent = [{"predict": 3.0}, {"predict": 5.0}, {"predict": 1.0}, {"predict": 6.0, "replan": 9.0}]
    steps = [cast(StepReport, SimpleNamespace(milliseconds=stages)) for stages in spent]
    timing = stage_times(steps, np.array([0, 2, 3, 4]), {"render": [2.0, 4.0], "split": []})
    assert timing == {"predict": StageTime(5.0, 8.0), "replan": StageTime(3.0, 9.0), "render": StageTime(3.0, 4.0)}


def test_a_package_without_metadata_is_reported() -> None:
    """The package is not installed, or was copied without its ``dist-info``."""
    told = versions(("numpy", "egs-warp-is-no-such-package"))
    assert told["numpy"] == np.__version__ and told["egs-warp-is-no-such-package"] == "no metadata"


def motion_report(name: str, asked: dict[str, float], state: State = State.DONE, *notes: str, **reached: float) -> Any:
    measured = {"distance": 0.0, "height": 0.0, "heading_degrees": 0.0, "tilt_degrees": 1.2, "airborne_frames": 0.0}
    return MotionReport(name, asked, cast(Any, None), MotionOutcome(**measured | reached), state, None, notes)


def test_the_result_is_one_line_without_exponents() -> None:
    """The result lists measured and requested values of each motion, and combines equal consecutive motions. A failure
    comes first."""
    jump = motion_report("jump", {"distance": 0.5, "height": 0.2}, distance=0.4921, height=1.98e-1)
    hops = [
        motion_report("hop", {"distance": 0.7, "height": 0.3, "square": k}, distance=0.7 + 0.01 * k) for k in (1, 2)
    ]
    twist = motion_report(
        "twist", {"heading_degrees": 180.0, "distance": 0.0}, State.FALLEN, "fallen: it tripped", tilt_degrees=88
    )
    report = dataclasses.replace(_report(), motion=(jump, *hops, twist))
    result, verdict = report.summary().splitlines()
    assert result == (
        "fallen: jump: distance 0.49 of 0.5 body heights, height 0.2 of 0.2 body heights, tilt 1 degrees, then"
        " hop x2: distance 0.71 to 0.72 of 0.7 body heights, height 0 of 0.3 body heights, tilt 1 degrees, then"
        " twist: heading 0 of 180 degrees, tilt 88 degrees; it tripped"
    )
    assert verdict == "audit: FAILED: penetration 3.0 times its limit"
    assert repr(report) == f"Report('pawn', {result!r})"


def test_gestures_are_in_the_result_beside_the_motion_below() -> None:
    nod = GestureOutcome("nod", 20.0, 19.46, "angle", "degrees")
    footfalls = Footfalls(slip=0.01, sole_shift=0.02, landings=4)
    walk = dataclasses.replace(
        motion_report("walk", {"distance": 1.0}, distance=0.998), also_reached=ActOutcome((nod,), footfalls)
    )
    alone = dataclasses.replace(motion_report("nod", {}), also_reached=ActOutcome((nod,), None))
    result, _ = dataclasses.replace(_report(), motion=(walk, alone)).summary().splitlines()
    assert result == (
        "walk: distance 1 of 1 body heights, nod angle 19 of 20 degrees, tilt 1 degrees, then"
        " nod: angle 19 of 20 degrees, tilt 1 degrees"
    )
    written = dataclasses.replace(walk, planned=footfalls).to_json()["reached"]
    assert isinstance(written, dict) and "below" not in written
    assert (written["slip"], written["landings"], written["distance"]) == (0.01, 4, 0.998)
    assert list(written["gestures"]) == [dataclasses.asdict(nod)]  # pyright: ignore[reportArgumentType]


def test_a_missed_value_is_in_the_result_once() -> None:
    sway = GestureOutcome("sway", 0.05, 0.037, "size", "body heights")
    missed = "not as requested: sway size 0.037 of 0.05 body heights"
    alone = dataclasses.replace(
        motion_report("sway", {}, State.NOT_AS_REQUESTED, missed), also_reached=ActOutcome((sway,), None)
    )
    notes = "not as requested: distance 0.2 of 0.5 body heights, it floats", "the feet slipped"
    hop = motion_report("hop", {"distance": 0.5}, State.NOT_AS_REQUESTED, *notes, distance=0.2)
    result, _ = dataclasses.replace(_report(), motion=(alone, hop)).summary().splitlines()
    assert result == (
        "not as requested: sway: size 0.037 of 0.05 body heights, tilt 1 degrees, then"
        " hop: distance 0.2 of 0.5 body heights, tilt 1 degrees; it floats; the feet slipped"
    )


def test_values_that_are_not_finite_are_null_in_the_file() -> None:
    checked = dataclasses.replace(_report().audit, end_stretch=float("inf"), energy_residual=float("nan"))
    assert written_audit(checked) == dataclasses.asdict(checked) | {"end_stretch": None, "energy_residual": None}


def _report() -> Report:
    values: Any = {field.name: 0 for field in dataclasses.fields(Audit)} | {"penetration": 0.03}
    report: Any = {field.name: None for field in dataclasses.fields(Report)}
    return Report(**report | {"source": "pawn", "motion": (), "audit": Audit(**values)})
