"""Takes: parts of a live session, written as run folders in the format of ``egs-warp animate``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.io.atomic import atomic_write
from egs_warp.io.run_folder import MANIFEST, run_folder
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.request import MotionRequest
from egs_warp.motions.sequence import MotionRecord
from egs_warp.pipelines import render_data
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.report import GaussianCounts, report_of_run

MAX_TAKE_SECONDS = 120.0
"""Maximum length of a take in simulated time, s; a take that reaches it is ended."""
SCRIPT = "script.json"
"""File with the motions of a take."""


def script_text(requests: Sequence[MotionRequest]) -> str:
    """Return ``requests`` as a script that ``egs-warp animate --motion script.json`` can read."""
    styles = [{} if request.style is None else {"style": str(request.style)} for request in requests]
    layers = [
        [{"motion": layer.request.name, "at": layer.begin, **layer.request.asked} for layer in request.layers]
        for request in requests
    ]
    lines = [
        json.dumps({"motion": request.name, **request.asked, **style, **({"with": added} if added else {})})
        for request, style, added in zip(requests, styles, layers, strict=True)
    ]
    return "[\n" + ",\n".join(f"  {line}" for line in lines) + "\n]\n"


@dataclass
class SessionRecording:
    """Recorder of the steps of a live session."""

    creature: Creature
    """Creature of the session."""
    start: BodyState
    """State at the start of the recording."""
    reports: list[StepReport] = field(default_factory=list)
    """Reports of the recorded steps."""

    def __post_init__(self) -> None:
        stepper = self.creature.stepper
        gaps, _ = stepper.detector.gaps(self.start.positions)
        self._recorder = Recorder(
            stepper.body,
            stepper.muscles,
            stepper.geometry,
            self.start,
            float(gaps.min()),
            drag=stepper.settings.drag,
            frame=self.creature.frame,
            front=self.creature.front.direction,
        )

    @property
    def seconds(self) -> float:
        """Recorded simulated time, s."""
        return self.reports[-1].state.time - self.start.time if self.reports else 0.0

    def trajectory(self) -> Trajectory:
        """Return the recorded steps, or only the initial state if no step has been recorded."""
        return self._recorder.trajectory()

    def add(self, reports: Sequence[StepReport], *, kick: np.ndarray | None) -> None:
        """Append the steps of one time step.

        Args:
            reports: reports of the steps; there are several if the step was repeated with a smaller step size.
            kick: (N, 3) m/s, velocities that the user's pulls and pushes added before the first step; None if there
                were none.
        """
        self.reports += reports
        self._recorder.add(reports, kick=kick)

    def write(
        self,
        folder: Path,
        drawn_as: RenderData,
        records: Sequence[MotionRecord],
        requests: Sequence[MotionRequest],
        *,
        source: str,
        requested: Mapping[str, Any],
        drive_starts: Sequence[float] = (),
    ) -> Path:
        """Write trajectory, creature, report and script into the first free folder ``take-N``; return its path.

        Args:
            folder: parent folder.
            drawn_as: data from which the creature is rendered.
            records: all motions of the session; only motions that start during the recording are written.
            requests: request of each motion.
            source: name of the capture, for the report.
            requested: options of the session, for the report.
            drive_starts: times in s at which the user started to drive the body.
        """
        trajectory = self.trajectory()
        recorded = [
            (entry, request)
            for entry, request in zip(records, requests, strict=True)
            if trajectory.time[0] - 1e-9 <= entry.start_time < trajectory.time[-1]
        ]
        has_kicks = len(trajectory.kick_step) > 0
        notes = [f"the user pulled or pushed the body; {SCRIPT} does not repeat this"] if has_kicks else []
        if drive_starts:
            notes.append(f"the user drove the body; {SCRIPT} does not repeat this")
        report = report_of_run(
            *(self.creature, trajectory, self.reports, np.arange(len(trajectory.time))),
            *([entry for entry, _ in recorded], energy_balance(trajectory)),
            gaussians=GaussianCounts.of(self.creature, split=drawn_as.splats.count),
            drawing={},
            source=source,
            notes=notes,
            seed=0,
            asked=requested,
        )
        path = _next_folder(folder)
        with run_folder(path) as run:
            trajectory.save(run.file("trajectory.npz"))
            drawn_as.save(run.file(render_data.FILE))
            with atomic_write(run.file(SCRIPT)) as temporary:
                temporary.write_text(script_text([request for _, request in recorded]))
            report.write(run.file("report.json"))
            run.finish()
        return path


def _next_folder(folder: Path) -> Path:
    """Return the first folder ``take-N`` that does not contain a finished run."""
    number = 1
    while (folder / f"take-{number}" / MANIFEST).exists():
        number += 1
    return folder / f"take-{number}"
