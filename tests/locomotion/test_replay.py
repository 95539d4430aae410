"""Resumption of interrupted runs, which become bitwise equal to uninterrupted ones, and one-line errors for
incompatible inputs."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.locomotion.objectives import AngularMomentumObjective, LoadObjective, no_slip_contacts, node_velocities
from egs_warp.locomotion.replay import Replay, digest
from egs_warp.locomotion.rollout import RolloutResult
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import box_mesh, coarse_stool
from tests.support.runs import roll_out
from tests.support.slides import slide
from tests.support.stances import FORWARD

FRAMES, CUT = 36, 28
"""Number of frames of the run, and the step, during the thrust, at which it is interrupted."""


class KilledError(Exception):
    """Raised in a run to end it like a kill."""


def block() -> CoarseCreature:
    """Return a new creature of 45 nodes, without state of an earlier run."""
    return coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD)


def walker() -> CoarseCreature:
    """Return a new stool."""
    return coarse_creature(coarse_stool(), forward=np.array([1.0, 0.0, 0.0]))


def run(made: CoarseCreature, script: str = "jump", *, killed_at: int | None = None, **given: Any) -> RolloutResult:
    def progress(frame: int) -> None:
        if frame == killed_at:
            raise KilledError

    sequence = MotionSequence(made.place, motion(script).parts(made.place.body.height))
    return roll_out(made.stepper, made.start, sequence, frames=FRAMES, progress=progress, **given)


@cache
def uninterrupted() -> RolloutResult:
    return run(block())


BODIES = {"jump": block, "walk 0.1": walker}


@pytest.fixture(scope="module")
def cut_off_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the parts of an interrupted jump."""
    parts = tmp_path_factory.mktemp("cut") / "parts"
    with pytest.raises(KilledError):
        run(block(), killed_at=CUT, parts=lambda: parts)
    return parts


@pytest.fixture
def cut_off(cut_off_once: Path, tmp_path: Path) -> Path:
    """Return a copy of the parts, for one test."""
    return shutil.copytree(cut_off_once, tmp_path / "parts")


def same_steps(one: tuple[StepReport, ...], other: tuple[StepReport, ...]) -> bool:
    """Assert that all arrays are equal except for the timings."""

    def bits(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: bits(v) for name, v in value.items() if name != "milliseconds"}
        return value.toarray().tobytes() if hasattr(value, "toarray") else np.asarray(value).tobytes()

    return len(one) == len(other) and all(bits(asdict(a)) == bits(asdict(b)) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("script", ["jump", pytest.param("walk 0.1", marks=pytest.mark.slow)])
def test_a_run_continues_to_the_same_bits(
    script: str, cut_off: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The resumed run solves only the steps that were not recorded."""
    body, folder = BODIES[script], cut_off
    whole = uninterrupted() if script == "jump" else run(body(), script)
    if script != "jump":
        folder = tmp_path / script
        with pytest.raises(KilledError):
            run(body(), script, killed_at=CUT, parts=lambda: folder)
    parts = sorted(os.listdir(folder))
    assert parts[:3] == ["start.npz", "steps-000000.npz", "steps-000001.npz"]
    solved: list[float] = []
    advance = LocomotionStepper.advance

    def counted(stepper: LocomotionStepper, state: Any, *rest: Any) -> Any:
        solved.append(state.time)
        return advance(stepper, state, *rest)

    monkeypatch.setattr(LocomotionStepper, "advance", counted)
    resumed = run(body(), script, parts=lambda: folder, resume=folder)
    assert len(solved) == len(whole.reports) - 10 * (len(parts) - 1)
    assert same_steps(resumed.reports, whole.reports)
    assert (resumed.frames == whole.frames).all()
    for name in whole.trajectory.__dataclass_fields__:
        assert np.array_equal(getattr(resumed.trajectory, name), getattr(whole.trajectory, name)), name
    # This also holds for a run that was interrupted after its last step.
    solved.clear()
    again = run(body(), script, parts=lambda: folder, resume=folder)
    assert same_steps(again.reports, whole.reports) and solved == []


@pytest.mark.slow
def test_a_run_continues_from_any_of_its_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is interrupted after each step and has the same bits, so all state that persists between steps is
    recorded."""
    monkeypatch.setattr("egs_warp.locomotion.recorder._MIN_STEPS_PER_PART", 1)
    whole = run(block(), parts=lambda: tmp_path / "whole")
    parts = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert len(parts) == 1 + len(whole.reports)
    for kept in range(1, len(parts) - 1):
        folder = tmp_path / str(kept)
        folder.mkdir()
        for name in parts[: kept + 1]:
            shutil.copy(tmp_path / "whole" / name, folder)
        resumed = run(block(), parts=lambda folder=folder: folder, resume=folder)
        assert same_steps(resumed.reports, whole.reports), kept


def test_parts_of_divided_steps_are_joined(tmp_path: Path) -> None:
    """Some steps are divided because they do not converge; all parts of a step have the same digest."""
    slid = slide()
    recorder = slid.recorder(folder=lambda: tmp_path)
    reports = slid.reports
    for asked, (first, last) in enumerate([(0, 1), (1, 5), (5, 6), (6, 14), (14, 24)]):
        recorder.add(reports[first:last], request_digest=asked)
    recorder.trajectory()
    replay = Replay(tmp_path, recorder.start)
    found = [replay.step(asked) for asked in range(5)]
    assert [len(done) for done in found] == [1, 4, 1, 8, 10] and replay.step(5) == []
    assert same_steps(tuple(report for done in found for report in done), reports)
    assert found[1][0].milliseconds == reports[1].milliseconds


def test_another_run_is_refused(cut_off: Path) -> None:
    other = coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.01)), forward=FORWARD)
    for made, script in ((other, "jump"), (block(), "jump 0.6")):
        with pytest.raises(UserError, match="belongs to another run: capture, flags, program or"):
            run(made, script, parts=lambda: cut_off, resume=cut_off)


def test_a_damaged_part_is_reported_and_can_be_left_out(cut_off: Path) -> None:
    second = cut_off / "steps-000001.npz"
    good = second.read_bytes()
    for bad in (good[:-40], good[: len(good) // 2] + b"\x55" + good[len(good) // 2 + 1 :], b"", b"text"):
        second.write_bytes(bad)
        with pytest.raises(UserError, match=r"steps-000001\.npz: is damaged \(.*\); remove it and the parts after it"):
            run(block(), parts=lambda: cut_off, resume=cut_off)
    second.unlink()
    assert same_steps(run(block(), parts=lambda: cut_off, resume=cut_off).reports, uninterrupted().reports)
    (cut_off / "steps-000000.npz").unlink()
    with pytest.raises(UserError, match=r"steps-000000\.npz: is missing; remove the parts after it to continue"):
        run(block(), parts=lambda: cut_off, resume=cut_off)
    (cut_off / "start.npz").unlink()
    with pytest.raises(UserError, match=r"start\.npz: is missing; begin the run again"):
        run(block(), parts=lambda: cut_off, resume=cut_off)


def test_a_pushed_run_continues_and_another_push_is_refused(tmp_path: Path) -> None:
    """The push precedes the interruption. A push does not change the objectives of its step, so the digest must include
    it."""
    made = block()

    def pushed(size: float) -> Any:
        kick = np.tile([0.3 * size, 0.1 * size, 0.0], (len(made.place.standing), 1))
        return lambda time, dt: kick if 0.0 <= time - 0.2 < dt else None

    whole, parts = run(block(), kicks=pushed(1.0)), tmp_path / "parts"
    assert len(whole.trajectory.kick_step) == 1
    with pytest.raises(KilledError):
        run(block(), killed_at=CUT, parts=lambda: parts, kicks=pushed(1.0))
    assert Trajectory.load(parts).kick_step.tolist() == whole.trajectory.kick_step.tolist()
    again = run(block(), parts=lambda: parts, resume=parts, kicks=pushed(1.0))
    assert same_steps(again.reports, whole.reports)
    for name in whole.trajectory.__dataclass_fields__:
        assert np.array_equal(getattr(again.trajectory, name), getattr(whole.trajectory, name)), name
    for other in (pushed(1.1), lambda time, dt: None):
        with pytest.raises(UserError, match="belongs to another run"):
            run(block(), resume=parts, kicks=other)


def test_a_full_disk_while_a_part_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is one line; earlier parts remain on disk, and the run can be continued from them."""
    replace = os.replace
    for number in (0, 2):
        parts, calls = tmp_path / str(number), iter(range(100))

        def failing(source: Path, target: Path, *, number: int = number, calls: Any = calls) -> None:
            if next(calls) == number:
                raise OSError(errno.ENOSPC, "No space left on device")
            replace(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", failing)
            with pytest.raises(UserError, match=r"npz: cannot be written \(No space left on device\)"):
                run(block(), parts=lambda parts=parts: parts)
        assert len(os.listdir(parts)) == number
        resume = parts if number else None
        again = run(block(), parts=lambda parts=parts: parts, resume=resume)
        assert same_steps(again.reports, uninterrupted().reports)


def test_digests_distinguish_objectives() -> None:
    slid = slide()
    body, contacts = slid.stepper.body, slid.reports[-1].contacts
    still = np.zeros((len(body.node_mass), 3))
    many = [
        [],
        [AngularMomentumObjective(np.zeros(3), 1.0)],
        [AngularMomentumObjective(np.array([0.0, 0.0, 1e-300]), 1.0)],
        [AngularMomentumObjective(np.zeros(3), 1.0 + 1e-15)],
        [node_velocities(body, still, 1.0)],
        [LoadObjective(np.array([1, 2]), 1.0)],
        [LoadObjective(np.array([1, 3]), 1.0)],
        [no_slip_contacts(contacts, np.ones(contacts.count), 1.0)],
        [no_slip_contacts(contacts, np.arange(contacts.count), 1.0)],
    ]
    assert len({digest(objectives) for objectives in many}) == len(many)
    assert digest(many[4]) == digest([node_velocities(body, still.copy(), 1.0)])
