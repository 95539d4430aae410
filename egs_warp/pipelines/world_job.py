"""World job: the arguments of one run among many runs of a world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from egs_warp.checked_calls import Positive, checked_constructor, checked_method
from egs_warp.locomotion.rollout import StepSize
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.push import Push
from egs_warp.motions.script import Script, check_style
from egs_warp.motions.style import Style
from egs_warp.motions.towards import script_without_others
from egs_warp.pipelines.report import Report
from egs_warp.pipelines.simulated_run import SimulatedRun, check_frames, report_of_body
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_run import WorldRun, simulate_world
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class BodyOutcome:
    """Result of one body of a world job."""

    __repr__ = short_repr

    report: Report
    """Report, as ``write_world`` writes it."""
    frames: np.ndarray
    """(n,) Index of the trajectory's state for each frame of a video at 60 Hz."""
    trajectory: Trajectory
    """All solver steps, in the frame of the world."""
    stopped: bool
    """True if the run of the world ended at a step that could not be solved."""


WorldSummary: TypeAlias = Mapping[str, BodyOutcome]
"""Results of all bodies by name."""


@checked_constructor
@dataclass(frozen=True)
class WorldJob:
    """Arguments of one run of a world: those of ``simulate``, under the same names."""

    __repr__ = short_repr

    motions: Mapping[str, Script | str] = field(default_factory=dict)
    """Motions by the names of the creatures; the other creatures stand."""
    frames: int | None = None
    """Number of frames at 60 Hz, of which the first shows the bodies at rest; None simulates until all bodies have come
    to rest."""
    max_seconds: Positive | None = None
    """Time limit of the script of each creature, s; None uses the script's own limit."""
    step: StepSize | None = None
    """Maximum step size, s; None uses the default."""
    style: Style | None = None
    """Style of jumps; None uses the default."""
    pushes: Mapping[str, tuple[Push, ...]] = field(default_factory=dict)
    """Pushes by the names of the creatures."""
    get_up: bool = True
    """True to let a creature that falls try to get up and continue."""

    def __post_init__(self) -> None:
        check_frames(self.frames)
        # Motions towards other bodies have no style.
        scripts = [one if isinstance(one, Script) else script_without_others(one) for one in self.motions.values()]
        check_style(self.style, scripts)

    @checked_method
    def run(self, world: World, *, progress: Callable[[int, int], object] = lambda done, expected: None) -> WorldRun:
        """Simulate the job in this process; ``progress`` is called with the numbers of finished and of expected
        frames."""
        return simulate_world(
            world,
            self.motions,
            frames=self.frames,
            max_seconds=self.max_seconds,
            step=self.step,
            style=self.style,
            pushes=self.pushes,
            get_up=self.get_up,
            progress=progress,
        )

    def outcome(self, run: WorldRun) -> WorldSummary:
        """Return report, frames and trajectory of each body."""
        outcomes = {}
        for name, result in run.bodies.items():
            notes = result.unfinished_note() if isinstance(result, SimulatedRun) else ()
            report = report_of_body(result, notes=notes)
            outcomes[name] = BodyOutcome(report, result.simulation.frames, result.trajectory, run.stopped)
        return outcomes
