"""Takes of a run: if the body falls, the motion is simulated again in a gentler form (docs/motions/retakes.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.motions.fall_monitor import start_overhang
from egs_warp.motions.push import Push
from egs_warp.motions.script import Script
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.report import Take, motion_reports
from egs_warp.pipelines.simulated_run import SimulatedRun, simulate

MAX_TAKES = 3
"""Maximum number of takes of a run."""


def simulate_takes(
    creature: Creature,
    script: Script,
    *,
    retakes: bool = True,
    pushes: Sequence[Push] = (),
    get_up: bool = True,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    show_note: Callable[[str], object] = lambda note: None,
    **options: Any,
) -> tuple[SimulatedRun, tuple[Take, ...]]:
    """Simulate a script with ``simulate``. If the body falls, simulate it again with a gentler form of the motion in
    which it fell, up to ``MAX_TAKES`` times in all.

    The result is the first take in which the body does not fall. If it falls in every take, the result is the first
    take, continued after its fall. A run with pushes has one take, because a push may be intended to topple the body.
    A body that cannot stand at the start (``start_overhang``) and falls in its first motion has one take as well: every
    take has the same start, and the gentler forms leave it there for longer.

    Args:
        creature: The creature at rest.
        script: The motions.
        retakes: False to simulate only one take.
        pushes: Pushes during the run.
        get_up: True to get up and continue if the body falls in all takes.
        parts: Function that returns the folder into which finished steps are written; later takes are written into its
            subfolders.
        resume: Folder with the finished steps of an interrupted run to continue.
        show_note: Called with a line for the user before each retake.
        options: Other arguments of ``simulate``.

    Returns:
        The run, and its takes in order; no takes if there was only one.

    Raises:
        UserError: As for ``simulate``.
    """
    perform = partial(simulate, creature, pushes=pushes, **options)
    if pushes or not retakes:
        return perform(script, get_up=get_up, parts=parts, resume=resume), ()
    takes: list[Take] = []
    first, current, change = None, script, None
    while len(takes) < MAX_TAKES:
        folder = "" if first is None else f"take-{len(takes) + 1}"
        run = perform(current, ends_at_fall=True, **_recording(parts, resume, folder))
        first = first or run
        take, failed = _judged(run, change)
        takes.append(take)
        if failed is None:
            return run, tuple(takes) if len(takes) > 1 else ()
        if failed == 0 and start_overhang(run.place) > 0.0:
            break
        retake = current.retake(failed)
        if len(takes) == MAX_TAKES or retake is None or not _can_begin(retake[0], run):
            break
        current, change = retake
        show_note(f"take {len(takes)}: {take.note}; take {len(takes) + 1}: {change}")
    assert first is not None
    if first.fallen is not None:
        # Replay the recorded steps up to the fall.
        recording = _recording(parts, resume, "shown")
        if parts is not None and recording["resume"] is None:
            recording["resume"] = parts()
        first = perform(script, get_up=get_up, **recording)
    return first, tuple(takes) if len(takes) > 1 else ()


def _judged(run: SimulatedRun, change: str | None) -> tuple[Take, int | None]:
    """Return a take, and the index of the first motion in which the body fell; None if it did not fall."""
    reports = motion_reports(run.trajectory, run.sequence.done, run.ending)
    for index, report in enumerate(reports):
        if report.state is State.FALLEN:
            *causes, fall = report.notes
            return Take(change, report.state, "; ".join([fall, *causes])), index
    return Take(change, State.worst(tuple(report.state for report in reports)), ""), None


def _can_begin(script: Script, run: SimulatedRun) -> bool:
    """Return True if the body can perform all motions of ``script``; for example, a gentler walk may have too many
    steps."""
    try:
        script.check(run.place)
    except UserError:
        return False
    return True


def _recording(parts: Callable[[], Path] | None, resume: Path | None, folder: str) -> dict[str, Any]:
    """Return the arguments ``parts`` and ``resume`` of ``simulate`` for the ``folder`` of a take."""
    recorded = None if resume is None else resume / folder
    return {
        "parts": None if parts is None else lambda: parts() / folder,
        "resume": recorded if recorded is not None and any(recorded.glob("*.npz")) else None,
    }
