"""End state of a run in the report, the summary and the exit status. All files are written for every state."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from egs_warp import cli
from egs_warp.assets import pawn
from egs_warp.fem.implicit_step import UnsolvableStepError
from egs_warp.io import write_ply
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.locomotion.trajectory import MotionOutcome
from egs_warp.motions.act import ActOutcome
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.gestures import GestureOutcome
from egs_warp.motions.sequence import JudgedOutcome
from egs_warp.pipelines.animate import AnimateOptions, animate
from egs_warp.pipelines.end_state import EndCause, State, falls_at_end
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.ground_coverage import ENDS_OUTSIDE_GROUND
from egs_warp.pipelines.report import motion_reports
from tests.support.coarse import NODES, coarse_maker
from tests.support.flights import rigid_flight


def reached(distance: float = 0.0, turn: float = 0.0, *, height: float = 0.1, tilt: float = 0.0) -> MotionOutcome:
    return MotionOutcome(distance, height, turn, tilt, 0.0)


def entry(*, resting: bool = True, fell: str | None = None, got_up: bool = False, **asked: float) -> Any:
    motion = SimpleNamespace(is_at_rest=resting)
    return cast(Any, SimpleNamespace(asked=asked, motion=motion, fall_note=fell, got_up=got_up))


SIDE, UP = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("plane", "normal", "step", "weights", "state"),
    [
        (-2, SIDE, 3, 0.5, State.GOT_UP),
        (-2, SIDE, 3, 0.001, State.NOT_AS_REQUESTED),
        (-2, SIDE, 15, 0.5, State.NOT_AS_REQUESTED),
        (-2, UP, 3, 0.5, State.NOT_AS_REQUESTED),
        (-1, SIDE, 3, 0.5, State.NOT_AS_REQUESTED),
        (0, SIDE, 3, 0.5, State.NOT_AS_REQUESTED),
    ],
    ids=["pushed", "touched", "pushed after the fall", "carried", "by itself", "by the ground"],
)
def test_a_body_that_another_body_pushed_over_got_up(
    plane: int, normal: tuple[float, float, float], step: int, weights: float, state: State
) -> None:
    """The first motion, in which the body falls, ends after 10 of the 20 steps."""
    t = rigid_flight()
    t = replace(
        t,
        world_index=0,
        contact_step=np.array([step], np.int32),
        contact_nodes=t.tets[:1],
        contact_weights=np.full((1, 4), 0.25),
        contact_plane=np.array([plane], np.int32),
        contact_normal=np.array([normal]),
        contact_force=weights * t.node_mass.sum() * 9.81 * np.array([normal]),
        contact_gap=np.zeros(1),
    )
    motion = SimpleNamespace(
        is_at_rest=False, outcome_record=lambda *_: None, plan_record=lambda: None, notes=lambda: ()
    )
    records = [
        SimpleNamespace(
            name=name,
            asked={},
            motion=motion,
            start_time=start,
            fall_note=fell,
            got_up=True,
            measured=lambda *_: reached(),
        )
        for name, start, fell in (("jump", 0.0, "tilted"), ("stand", t.time[10], None))
    ]
    reports = motion_reports(t, cast(Any, records), EndCause())
    assert reports[0].state is state


ON_FEET = EndCause(has_time_limit=True, base=SupportKind.FEET)


@pytest.mark.parametrize(
    ("ending", "of", "result", "last", "state", "why"),
    [
        (EndCause(), entry(distance=0.5), reached(0.41), True, State.DONE, []),
        (EndCause(), entry(distance=0.5, resting=False), reached(), True, State.CUT_OFF, []),
        (
            *(ON_FEET, entry(distance=0.5, resting=False), reached(), True, State.NOT_AS_REQUESTED),
            ["not as requested: not at rest within the time limit of the motion"],
        ),
        (
            *(EndCause(), entry(distance=0.5), reached(0.39), False, State.NOT_AS_REQUESTED),
            ["not as requested: distance 0.39 of 0.5 body heights"],
        ),
        (EndCause(), entry(distance=5.0), reached(4.6), False, State.DONE, []),
        (
            *(EndCause(), entry(heading_degrees=-90.0, distance=0.0), reached(0.0, 8.0), True, State.NOT_AS_REQUESTED),
            ["not as requested: heading 8 of -90 degrees"],
        ),
        (EndCause(), entry(heading_degrees=-90.0, distance=0.0), reached(0.0, -80.1), True, State.DONE, []),
        (
            *(EndCause(), entry(distance=0.5, height=0.2), reached(0.2, height=0.14), True, State.NOT_AS_REQUESTED),
            ["not as requested: distance 0.2 of 0.5 body heights, height 0.14 of 0.2 body heights"],
        ),
        (EndCause(), entry(height=0.2), reached(height=0.5), True, State.DONE, []),
        (
            *(ON_FEET, entry(), reached(tilt=31.0), True, State.FALLEN),
            ["fallen: at the end it is tilted by 31 degrees"],
        ),
        (
            *(ON_FEET, entry(resting=False), reached(tilt=61.0), False, State.FALLEN),
            ["fallen: at the end it is tilted by 61 degrees"],
        ),
        (ON_FEET, entry(), reached(tilt=29.0), True, State.DONE, []),
        (EndCause(base=SupportKind.ROUND_BASE), entry(), reached(tilt=90.0), True, State.DONE, []),
        (
            *(EndCause(is_pushed=True), entry(resting=False, fell="tilted", got_up=True), reached(), False),
            *(State.GOT_UP, ["fallen: tilted; it got up again"]),
        ),
        (
            *(EndCause(), entry(resting=False, fell="tilted", got_up=True), reached(), False),
            *(State.NOT_AS_REQUESTED, ["fallen: tilted; it got up again"]),
        ),
        (
            *(EndCause("tilted"), entry(resting=False, fell="tilted"), reached(), False, State.FALLEN),
            ["fallen: tilted; it did not get up"],
        ),
        (EndCause("tilted"), entry(resting=False), reached(), True, State.FALLEN, ["fallen: tilted"]),
        (
            *(EndCause(unsupported="it floats"), entry(distance=0.5), reached(0.1), True, State.NOT_AS_REQUESTED),
            ["not as requested: distance 0.1 of 0.5 body heights, it floats"],
        ),
        (EndCause(unsupported="it floats"), entry(), reached(), False, State.DONE, []),
        (
            *(EndCause(end_stretch=6.4), entry(), reached(), True, State.NOT_AS_REQUESTED),
            ["not as requested: parts of the body end stretched or compressed by a factor of 6.4"],
        ),
        (
            *(EndCause(end_stretch=float("inf")), entry(), reached(), True, State.NOT_AS_REQUESTED),
            ["not as requested: a part of the body has collapsed"],
        ),
        (EndCause(end_stretch=1.6), entry(), reached(), True, State.DONE, []),
        (EndCause(end_stretch=6.4), entry(), reached(), False, State.DONE, []),
        (EndCause(end_stretch=6.4), entry(resting=False), reached(), True, State.CUT_OFF, []),
        (EndCause(unsupported="it floats"), entry(resting=False), reached(), True, State.CUT_OFF, []),
        (EndCause("tilted"), entry(), reached(), False, State.DONE, []),
        (
            *(EndCause("tilted", True), entry(resting=False), reached(), True, State.STOPPED),
            ["stopped: the next step could not be solved, however short; the run ends before it"],
        ),
    ],
)
def test_each_motion_has_a_state(
    ending: EndCause, of: Any, result: MotionOutcome, last: bool, state: State, why: list[str]
) -> None:
    assert ending.of(of, result, last=last) == (state, why)


@pytest.mark.parametrize(
    ("base", "state"), [(SupportKind.FEET, State.NOT_AS_REQUESTED), (SupportKind.SINGLE_BASE, State.DONE)]
)
def test_feet_that_slide_are_reported(base: SupportKind, state: State) -> None:
    result, why = EndCause(base=base).of(entry(), reached(), SimpleNamespace(slip=0.35), last=True)
    assert result is state
    assert why == (["not as requested: feet slide by 35 % of a stride"] if state is State.NOT_AS_REQUESTED else [])


@pytest.mark.parametrize(("angle", "state"), [(19.0, State.DONE), (11.0, State.NOT_AS_REQUESTED)])
def test_a_gesture_that_is_too_small_is_reported(angle: float, state: State) -> None:
    """A motion is not as requested if its gesture is too small, or if feet slide."""
    gesture = GestureOutcome("nod", 20.0, angle, "angle", "degrees")
    outcome = ActOutcome((gesture,), cast(Any, SimpleNamespace(slip=0.0)))
    result, why = EndCause(base=SupportKind.FEET).of(entry(), reached(), outcome, last=True)
    assert result is state
    assert why == (["not as requested: nod angle 11 of 20 degrees"] if state is State.NOT_AS_REQUESTED else [])
    slides = ActOutcome((gesture,), cast(Any, SimpleNamespace(slip=0.35)))
    assert EndCause(base=SupportKind.FEET).of(entry(), reached(), slides, last=True)[0] is State.NOT_AS_REQUESTED


def test_the_motion_below_gestures_is_judged() -> None:
    """Also below gestures in two layers, as in a sneak with a nod; a motion that has not ended is not judged."""
    failed = JudgedOutcome(("heading 10 of 40 degrees",))
    nested = ActOutcome((), ActOutcome((GestureOutcome("nod", 20.0, 11.0, "angle", "degrees"),), failed))
    for outcome, missed in (
        (ActOutcome((), failed), failed.failures),
        (nested, ("nod angle 11 of 20 degrees", *failed.failures)),
    ):
        result = EndCause().of(entry(), reached(), outcome, last=True)
        assert result == (State.NOT_AS_REQUESTED, [f"not as requested: {', '.join(missed)}"])
    assert EndCause().of(entry(resting=False), reached(), ActOutcome((), failed), last=True) == (State.CUT_OFF, [])


@pytest.mark.parametrize(
    ("carried", "until", "hanging", "falls"),
    [(1.0, 60, 0.0, False), (0.0, 60, 0.0, True), (1.0, 40, 0.0, True), (0.0, 60, 1.0, False)],
)
def test_a_body_that_nothing_carries_in_its_last_frames_falls(
    carried: float, until: int, hanging: float, falls: bool
) -> None:
    """The contact carries a fraction of the weight of 20 N in the steps before ``until``, of 60 steps of 1/60 s, and a
    joint another fraction. A body of 1 m must be carried in the last 0.16 s."""
    steps = np.arange(60)[:until]
    trajectory = SimpleNamespace(
        time=np.arange(61) / 60.0,
        dt=np.full(60, 1.0 / 60.0),
        gravity=np.array([0.0, 0.0, -10.0]),
        height=1.0,
        node_mass=np.ones(2),
        contact_step=steps,
        contact_force=np.outer(np.full(len(steps), 20.0 * carried), [0.3, 0.0, 1.0]),
        joint_step=np.arange(60),
        joint_force=np.outer(np.full(60, 20.0 * hanging), [0.0, 0.3, 1.0]),
    )
    assert falls_at_end(cast(Any, trajectory)) is falls


def test_a_body_that_ends_beyond_the_captured_ground_is_not_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egs_warp.pipelines.animate.ground_coverage_warning", lambda *_, **__: ("it floats",))
    monkeypatch.setattr("egs_warp.pipelines.animate.make_checked_creature", coarse_maker(NODES))
    report = animate(
        pawn(gaussian_count=1000, device="cpu").cloud,
        tmp_path / "out",
        motion="stand 0.1",
        up="z",
        options=AnimateOptions(size=64),
        quiet=True,
    )
    assert report.state is State.NOT_AS_REQUESTED and report.state.is_failure
    line = report.summary().splitlines()[0]
    assert line.startswith("not as requested: stand: ") and line.endswith(ENDS_OUTSIDE_GROUND)


def test_a_run_ends_in_the_worst_state_of_its_motions() -> None:
    assert State.worst(()) is State.DONE
    assert State.worst((State.FALLEN, State.DONE)) is State.FALLEN
    assert State.worst((State.FALLEN, State.STOPPED, State.CUT_OFF)) is State.STOPPED
    assert [state for state in State if not state.is_failure] == [State.DONE, State.CUT_OFF, State.GOT_UP]


@pytest.mark.parametrize("after", [*(pytest.param(step, marks=pytest.mark.slow) for step in (0, 3)), "fall"])
def test_a_run_that_stops_or_falls_writes_all_of_its_files(
    after: int | str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("egs_warp.pipelines.animate.make_checked_creature", coarse_maker(NODES))
    advance, calls = LocomotionStepper.advance, iter(range(1000))

    def failing(*given: Any) -> Any:
        if next(calls) == after:
            raise UnsolvableStepError("singular")
        return advance(*given)

    monkeypatch.setattr(LocomotionStepper, "advance", failing)
    if after == "fall":
        monkeypatch.setattr(FallMonitor, "_lying_note", lambda *_: "tilted by 90 degrees")
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=1000, device="cpu").cloud)
    out = tmp_path / "out"
    flags = ["--up", "z", "--size", "32", "--motion", "jump, twist", "--no-get-up", "--out", str(out)]
    assert cli.main(["animate", str(tmp_path / "pawn.ply"), *flags]) == 3
    said = capsys.readouterr()
    state = "fallen" if after == "fall" else "stopped"
    result, verdict, film = said.out.splitlines()
    reason = "tilted by 90 degrees" if after == "fall" else "the next step could not be solved"
    assert result.startswith(f"{state}: jump: distance ") and f"; {reason}" in result
    assert verdict.startswith("audit: ") and film.startswith(f"film: {out / 'motions.mp4'} (")
    # Notes are printed once, when they are known.
    assert said.err.count("1 of 2 motions did not begin: twist") == 1 == said.err.count("front is taken to be")
    assert "cut off" not in said.out + said.err
    report = json.loads((out / "report.json").read_text())
    assert report["state"] == state and [motion["state"] for motion in report["motion"]] == [state]
    assert json.loads((out / "manifest.json").read_text())["finished"]
    assert {"motions.mp4", "sheet.png", "plots.png", "trajectory.npz", "creature.npz"} <= set(os.listdir(out))
    run = FinishedRun.read(out)
    if isinstance(after, int):
        assert len(run.trajectory.dt) == after and len(run.steps) == after + 1
    assert cli.main(["resume", str(out)]) == 3
    assert capsys.readouterr().out == f"{out}: this run has finished\n"
