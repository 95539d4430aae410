"""A creature moves: motions by name become what its body does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from egs_warp.locomotion import rollout
from egs_warp.locomotion.rollout import FRAME_RATE, Simulation
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import Script
from egs_warp.motions.sequence import MotionSequence, Place
from egs_warp.pipelines.creature import Creature, first_place


@dataclass(frozen=True)
class Performance:
    """What a creature did."""

    creature: Creature
    place: Place
    """Where it stood at the start."""
    sequence: MotionSequence
    """The motions that it went through."""
    simulation: Simulation

    @property
    def trajectory(self) -> Trajectory:
        """Every solver step."""
        return self.simulation.trajectory

    @property
    def frames(self) -> np.ndarray:
        """(n, N, 3) metres: the nodes of the cage in each frame of a video at 60 Hz."""
        return self.trajectory.positions[self.simulation.frames]


def simulate(
    creature: Creature,
    motion: Script,
    *,
    frames: int | None = None,
    forward: np.ndarray | None = None,
    step: float | None = None,
    progress: Callable[[int], object] = lambda frame: None,
) -> Performance:
    """Run ``motion`` for ``frames`` at 60 Hz, or else until the body has come to rest or the motion is cut off.

    ``forward`` (3,) is the way of the motion, the long axis of the footprint if not given; ``step`` the seconds of a
    solver step, if not the usual. ``progress`` is told each frame done. Raises ``UserError`` for a motion that the body
    cannot do.
    """
    place = first_place(creature, forward, step=step)
    motion.check(place)
    sequence = MotionSequence(place, motion.parts(creature.body.height))
    # A frame is as long as a step that is longer than it.
    share = 1.0 if step is None else min(1.0, 1.0 / (FRAME_RATE * step))
    simulation = rollout.simulate(
        creature.stepper,
        creature.geometry,
        creature.start,
        sequence,
        frames=frames or round(share * motion.frames()),
        step=step,
        finished=lambda: frames is None and sequence.finished,
        progress=progress,
    )
    return Performance(creature, place, sequence, simulation)
