"""A take: some seconds of a live session, kept as the folder of a run, as ``egs-warp animate`` writes one."""

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
from egs_warp.motions.request import MotionRequest
from egs_warp.motions.sequence import MotionRecord
from egs_warp.pipelines import render_data
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.report import GaussianCounts, report_of_run

MAX_TAKE_SECONDS = 120.0
"""Seconds of the creature's own time, after which a take ends by itself."""
SCRIPT = "script.json"


def script_text(requests: Sequence[MotionRequest]) -> str:
    """A script of motions, one after the other, for ``egs-warp animate --motion script.json``."""
    styles = [{} if request.style is None else {"style": str(request.style)} for request in requests]
    lines = [
        json.dumps({"motion": request.name, **request.asked, **style})
        for request, style in zip(requests, styles, strict=True)
    ]
    return "[\n" + ",\n".join(f"  {line}" for line in lines) + "\n]\n"


@dataclass
class SessionRecording:
    """Gathers the steps of a session from ``start`` on."""

    creature: Creature
    start: BodyState
    reports: list[StepReport] = field(default_factory=list)

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
        )

    @property
    def seconds(self) -> float:
        """Its length so far."""
        return self.reports[-1].state.time - self.start.time if self.reports else 0.0

    def add(self, reports: Sequence[StepReport], *, kick: np.ndarray | None) -> None:
        """The next steps, and (N, 3) m/s that the user's pulls and pushes gave the nodes as the first began."""
        self.reports += reports
        self._recorder.add(reports, kick=kick)

    def write(
        self,
        folder: Path,
        drawn_as: RenderData,
        begun: Sequence[MotionRecord],
        requests: Sequence[MotionRequest],
        *,
        source: str,
        asked: Mapping[str, Any],
        driven: Sequence[float] = (),
    ) -> Path:
        """Write trajectory, creature, report and script into the first free ``folder/take-N``, which it returns.

        ``begun`` are the motions of the session, ``requests`` how a script asks for them;
        ``driven`` the times, seconds, at which it was steered by speeds.
        """
        trajectory = self._recorder.trajectory()
        chosen = [
            (entry, request)
            for entry, request in zip(begun, requests, strict=True)
            if trajectory.time[0] - 1e-9 <= entry.start_time < trajectory.time[-1]
        ]
        touched = len(trajectory.kick_step) > 0
        notes = [f"the user pulled at it or pushed it, which {SCRIPT} does not repeat"] if touched else []
        if driven:
            notes.append(f"the user drove it, which {SCRIPT} does not repeat")
        report = report_of_run(
            *(self.creature, trajectory, self.reports, np.arange(len(trajectory.time))),
            *([entry for entry, _ in chosen], energy_balance(trajectory)),
            gaussians=GaussianCounts.of(self.creature, drawn_as.splats.count),
            drawing={},
            source=source,
            notes=notes,
            seed=0,
            asked=asked,
        )
        path = _next_folder(folder)
        with run_folder(path) as run:
            trajectory.save(run.file("trajectory.npz"))
            drawn_as.save(run.file(render_data.FILE))
            with atomic_write(run.file(SCRIPT)) as temporary:
                temporary.write_text(script_text([request for _, request in chosen]))
            report.write(run.file("report.json"))
            run.finish()
        return path


def _next_folder(folder: Path) -> Path:
    number = 1
    while (folder / f"take-{number}" / MANIFEST).exists():
        number += 1
    return folder / f"take-{number}"
