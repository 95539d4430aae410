"""One run of a creature, as one of many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.push import Push
from egs_warp.motions.script import Script
from egs_warp.motions.style import Style
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.report import GaussianCounts, Report, report_of_run
from egs_warp.pipelines.simulated_run import SimulatedRun, simulate

RunSummary: TypeAlias = tuple[Report, np.ndarray, Trajectory]
"""Of a run: report, index into the trajectory's times for each frame of a video, and trajectory."""


@dataclass(frozen=True)
class Job:
    """One run: what ``simulate`` takes, under the same names, and the ground."""

    motion: Script
    friction: float | None = None
    """Of the ground (``Creature.with_friction``), if not the creature's own."""
    frames: int | None = None
    max_seconds: float | None = None
    """Seconds."""
    step: float | None = None
    """Seconds."""
    style: Style | None = None
    pushes: tuple[Push, ...] = ()
    get_up: bool = True
    activations: np.ndarray | None = None
    """(steps, M) metres."""

    def run(
        self, creature: Creature, *, progress: Callable[[int, int], object] = lambda done, expected: None
    ) -> SimulatedRun:
        """The run alone, here."""
        if self.friction is not None:
            creature = creature.with_friction(self.friction)
        return self.run_on_ground(creature, progress=progress)

    def run_on_ground(
        self, creature: Creature, *, progress: Callable[[int, int], object] = lambda done, expected: None
    ) -> SimulatedRun:
        """The run of a ``creature`` that stands on its ground already."""
        asked = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in ("motion", "friction")}
        return simulate(creature, self.motion, **asked, progress=progress)

    def outcome(self, creature: Creature, performance: SimulatedRun) -> RunSummary:
        """What is told of the run: report, frames and trajectory."""
        simulation = performance.simulation
        report = report_of_run(
            *(creature, simulation.trajectory, simulation.reports, simulation.frames),
            *(performance.sequence.done, energy_balance(simulation.trajectory)),
            gaussians=GaussianCounts.of(creature),
            drawing={},
            source="",
            notes=performance.cut_short(),
            seed=0,
            asked=self._asked(),
            ending=performance.ending,
        )
        return report, simulation.frames, simulation.trajectory

    def _asked(self) -> dict[str, Any]:
        """``asked`` of the report."""
        given = {name: getattr(self, name) for name in ("friction", "frames", "longest", "step", "get_up")}
        return {**given, "pushes": len(self.pushes), "activations": self.activations is not None}
