"""Job: the arguments of one run among many runs of a creature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from egs_warp.checked_calls import Positive, checked_constructor, checked_method
from egs_warp.locomotion.rollout import RunSteps, StepSize, run_with
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.push import Push
from egs_warp.motions.script import Script, check_style, motion
from egs_warp.motions.style import Style
from egs_warp.pipelines.captured_body import Friction
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.report import JsonValue, Report
from egs_warp.pipelines.simulated_run import SimulatedRun, check_frames, simulation_steps
from egs_warp.short_repr import short_repr

RunSummary: TypeAlias = tuple[Report, np.ndarray, Trajectory]
"""Report of a run; index (n,) of the trajectory's state for each frame of a video; and trajectory."""


@checked_constructor
@dataclass(frozen=True)
class Job:
    """Arguments of one run: those of ``simulate``, under the same names, and the friction of the ground."""

    __repr__ = short_repr

    motion: Script | str
    """The motion, as a script or as its text."""
    friction: Friction | None = None
    """Coulomb coefficient of the ground (``Creature.with_friction``); None keeps the friction of the creature."""
    frames: int | None = None
    """Number of frames at 60 Hz, of which the first shows the body at rest; None simulates until the body has come to
    rest."""
    max_seconds: Positive | None = None
    """Time limit of the motion, s; None uses the motion's own limit."""
    step: StepSize | None = None
    """Maximum step size, s; None uses the default."""
    style: Style | None = None
    """Style of jumps; None uses the default."""
    pushes: tuple[Push, ...] = ()
    """Pushes during the run."""
    get_up: bool = True
    """True to get up and continue if the body falls."""
    activations: np.ndarray | None = None
    """(steps, M) m, prescribed muscle activations; None lets the motion plan them."""

    def __post_init__(self) -> None:
        check_frames(self.frames)
        check_style(self.style, [motion(self.motion) if isinstance(self.motion, str) else self.motion])

    @checked_method
    def run(
        self, creature: Creature, *, progress: Callable[[int, int], object] = lambda done, expected: None
    ) -> SimulatedRun:
        """Simulate the job in this process; ``progress`` is called with the numbers of finished and of expected
        frames."""
        if self.friction is not None:
            creature = creature.with_friction(self.friction)
        return run_with(creature.stepper, self.steps(creature, progress=progress))

    def steps(
        self, creature: Creature, *, progress: Callable[[int, int], object] = lambda done, expected: None
    ) -> RunSteps[SimulatedRun]:
        """Return a generator of the solver steps (``simulation_steps``) of a ``creature`` that already stands on ground
        with the job's friction."""
        options = {
            name: getattr(self, name) for name in self.__dataclass_fields__ if name not in ("motion", "friction")
        }
        return simulation_steps(creature, self.motion, **options, progress=progress)

    def outcome(self, performance: SimulatedRun) -> RunSummary:
        """Return report, frames and trajectory of the run."""
        simulation = performance.simulation
        report = performance.report(asked=self._requested_options())
        return report, simulation.frames, simulation.trajectory

    def _requested_options(self) -> dict[str, JsonValue]:
        """Return the requested options for the entry ``asked`` of the report."""
        return {
            "friction": self.friction,
            "frames": self.frames,
            "max_seconds": self.max_seconds,
            "step": self.step,
            "style": None if self.style is None else str(self.style),
            "get_up": self.get_up,
            "pushes": len(self.pushes),
            "activations": self.activations is not None,
        }
