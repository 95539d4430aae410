"""Takes of a motion: after a fall, the motion is simulated again, and the first take without a fall is shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.jump import Jump
from egs_warp.motions.push import Push
from egs_warp.motions.script import motion
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.simulated_run import SimulatedRun, simulate
from egs_warp.pipelines.takes import simulate_takes
from tests.support.creatures import coarse_pawn

FRAMES = 16
"""Number of frames within which the stub in ``falls_above`` reports a fall."""


def falls_above(monkeypatch: pytest.MonkeyPatch, height: float) -> None:
    """Replace the detection of falls by one that reports a jump higher than ``height`` body heights as a fall."""

    def lying_note(monitor: FallMonitor, *_: Any) -> str | None:
        jump = monitor.sequence.done[-1].motion
        return "tilted by 90 degrees" if isinstance(jump, Jump) and jump.target.height > height else None

    monkeypatch.setattr(FallMonitor, "_lying_note", lying_note)


def positions(run: SimulatedRun) -> bytes:
    return run.trajectory.positions.tobytes()


def test_a_run_without_a_fall_has_one_take() -> None:
    run, takes = simulate_takes(coarse_pawn(), motion("jump"), frames=3)
    assert takes == () and positions(run) == positions(simulate(coarse_pawn(), "jump", frames=3))


def test_the_first_take_without_a_fall_is_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    falls_above(monkeypatch, 0.15)
    script, notes = motion("jump 0.5 0.2"), list[str]()
    run, takes = simulate_takes(
        *(coarse_pawn(), script), frames=FRAMES, parts=lambda: tmp_path / "parts", show_note=notes.append
    )
    changes = [None, "jump slower and softer", "jump slower, softer, lower and shorter"]
    assert [take.change for take in takes] == changes
    assert [take.state for take in takes] == [State.FALLEN, State.FALLEN, State.CUT_OFF]
    assert takes[0].note.startswith("fallen: tilted by 90 degrees at 0.") and takes[2].note == ""
    assert notes == [f"take {k}: {takes[k - 1].note}; take {k + 1}: {changes[k]}" for k in (1, 2)]
    assert run.sequence.done[0].asked == {"distance": 0.5, "height": 0.2}
    for _ in range(2):
        retake = script.retake(0)
        assert retake is not None
        script = retake[0]
    assert positions(run) == positions(simulate(coarse_pawn(), script, frames=FRAMES))


@pytest.mark.parametrize("get_up", [pytest.param(False, marks=pytest.mark.slow), True])
def test_if_all_takes_fall_the_first_one_goes_on(get_up: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """If all takes fall, the result is the first take, which continues after its fall."""
    falls_above(monkeypatch, 0.0)
    run, takes = simulate_takes(
        *(coarse_pawn(), motion("jump 0.5 0.2")), frames=FRAMES, get_up=get_up, parts=lambda: tmp_path / "parts"
    )
    assert [take.state for take in takes] == 3 * [State.FALLEN]
    assert [record.name for record in run.sequence.done] == (["jump", "get up"] if get_up else ["jump"])
    assert positions(run) == positions(simulate(coarse_pawn(), "jump 0.5 0.2", frames=FRAMES, get_up=get_up))


@pytest.mark.parametrize("arguments", [{"retakes": False}, {"pushes": (Push(0.0, np.array([0.01, 0.0, 0.0])),)}])
def test_a_fall_is_shown_if_it_is_wanted(arguments: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no retake after a fall if retakes are disabled, or if the body is pushed, perhaps in order to make it
    fall."""
    falls_above(monkeypatch, 0.0)
    run, takes = simulate_takes(coarse_pawn(), motion("jump"), frames=FRAMES, get_up=False, **arguments)
    assert takes == () and run.fallen is not None


def test_a_body_that_cannot_stand_has_one_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """No gentler form of the first motion changes the start."""
    falls_above(monkeypatch, 0.0)
    monkeypatch.setattr("egs_warp.pipelines.takes.start_overhang", lambda place: 0.1)
    lines: list[str] = []
    run, takes = simulate_takes(coarse_pawn(), motion("jump"), frames=FRAMES, get_up=False, show_note=lines.append)
    assert takes == () and lines == [] and run.fallen is not None


@pytest.mark.parametrize(
    ("height", "interrupted"), [pytest.param(0.15, 15, marks=pytest.mark.slow), (0.15, 30), (0.0, 42)]
)
def test_an_interrupted_take_is_continued(
    height: float, interrupted: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each take that falls has 11 steps. A continued run has the same bits, and solves no step twice."""
    falls_above(monkeypatch, height)
    script, advance = motion("jump 0.5 0.2"), LocomotionStepper.advance
    calls = 0

    def perform(folder: Path, *, resumed: bool, last: int = 1000) -> SimulatedRun:
        nonlocal calls
        calls = 0

        def counted(*arguments: Any) -> tuple[BodyState, Any, list[Any]]:
            nonlocal calls
            if calls == last:
                raise KeyboardInterrupt
            calls += 1
            return advance(*arguments)

        monkeypatch.setattr(LocomotionStepper, "advance", counted)
        resume = folder if resumed else None
        return simulate_takes(
            *(coarse_pawn(), script), frames=FRAMES + 10, get_up=False, parts=lambda: folder, resume=resume
        )[0]

    whole, count = positions(perform(tmp_path / "whole", resumed=False)), calls
    assert interrupted < count
    with pytest.raises(KeyboardInterrupt):
        perform(tmp_path / "parts", resumed=False, last=interrupted)
    assert positions(perform(tmp_path / "parts", resumed=True)) == whole
    assert calls <= count - interrupted + 10, "at most the steps of an unfinished part are solved again"
