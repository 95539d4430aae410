"""``simulate``: the motions of one creature, or of all bodies of a world."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import overload

import numpy as np

from egs_warp.checked_calls import Positive
from egs_warp.errors import UserError, warn_user
from egs_warp.locomotion.rollout import StepSize
from egs_warp.motions.push import Push
from egs_warp.motions.script import Script
from egs_warp.motions.style import Style
from egs_warp.pipelines import simulated_run
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.simulated_run import SimulatedRun
from egs_warp.pipelines.world import BodyKey, World
from egs_warp.pipelines.world_run import OtherKey, WorldRun, simulate_world


@overload
def simulate(
    creature: Creature,
    motion: Script | str,
    *,
    frames: int | None = ...,
    max_seconds: Positive | None = ...,
    step: StepSize | None = ...,
    style: Style | None = ...,
    pushes: Sequence[Push] = ...,
    get_up: bool = ...,
    ends_at_fall: bool = ...,
    activations: np.ndarray | None = ...,
    parts: Callable[[], Path] | None = ...,
    resume: Path | None = ...,
    progress: Callable[[int, int], object] = ...,
) -> SimulatedRun: ...


@overload
def simulate(
    creature: World,
    motion: Mapping[BodyKey, Script | str],
    *,
    frames: int | None = ...,
    max_seconds: Positive | None = ...,
    step: StepSize | None = ...,
    style: Style | None = ...,
    pushes: Mapping[OtherKey, Sequence[Push]] = ...,
    get_up: bool = ...,
    progress: Callable[[int, int], object] = ...,
) -> WorldRun: ...


def simulate(
    creature: Creature | World,
    motion: Script | str | Mapping[BodyKey, Script | str],
    *,
    frames: int | None = None,
    max_seconds: Positive | None = None,
    step: StepSize | None = None,
    style: Style | None = None,
    pushes: Sequence[Push] | Mapping[OtherKey, Sequence[Push]] = (),
    get_up: bool = True,
    ends_at_fall: bool = False,
    activations: np.ndarray | None = None,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> SimulatedRun | WorldRun:
    """Simulate a motion of a creature, or the motions of the creatures of a world.

    In a world, all bodies advance in lockstep, with the smallest time step that any of them needs. A creature without a
    motion stands. The run ends when all motions have ended and the props are at rest.

    Args:
        creature: The creature at rest, or the world.
        motion: The motion or motions, as a script or as its text (``egs_warp.motions.script``); for a world, a mapping
            from creatures or their names to motions.
        frames: Number of frames at 60 Hz, the first at rest; None runs until the bodies have come to rest or fallen, or
            the time limit is reached.
        max_seconds: Time limit of the script of each creature, s; None uses the script's own limit.
        step: Maximum step size, s; None uses the default.
        style: Style of jumps; None uses the default.
        pushes: Pushes during the run; for a world, a mapping from creatures or their names to pushes.
        get_up: True to let a creature that falls try to get up and continue.
        ends_at_fall: True to end the run at the step at which a fall is detected; not for a world.
        activations: (steps, M) m, prescribed muscle activations of each solver step. The motion then only defines the
            measured values, and the run ends with the last row; not for a world.
        parts: Function that returns the folder into which finished steps are written; None writes no steps. Not for a
            world.
        resume: Folder with the finished steps of an interrupted run to continue; not for a world.
        progress: Called after each frame with the number of finished frames and the number expected in total.

    Raises:
        UserError: A body cannot perform its motion, no motion has a ``style``, an argument is invalid, or ``resume``
            belongs to another run.

    Warns:
        UserWarning: The ``overlap`` of the style exceeds that of the creature, which alone has an effect.
    """
    _warn_of_overlap(creature, style)
    common = {"frames": frames, "max_seconds": max_seconds, "step": step, "style": style, "get_up": get_up}
    if isinstance(creature, World):
        if ends_at_fall or activations is not None or parts is not None or resume is not None:
            raise UserError("world: ends_at_fall, activations, parts and resume are for one creature; leave them out")
        if not isinstance(motion, Mapping) or not (isinstance(pushes, Mapping) or len(pushes) == 0):
            raise UserError("world: give motions and pushes by body, such as {knight: 'jump'}")
        pushes_on = pushes if isinstance(pushes, Mapping) else {}
        return simulate_world(creature, motion, pushes=pushes_on, progress=progress, **common)
    if isinstance(motion, Mapping) or isinstance(pushes, Mapping):
        raise UserError("motion: motions by body are for a world; give one script for a creature")
    return simulated_run.simulate(
        creature,
        motion,
        pushes=pushes,
        ends_at_fall=ends_at_fall,
        activations=activations,
        parts=parts,
        resume=resume,
        progress=progress,
        **common,
    )


def _warn_of_overlap(creature: Creature | World, style: Style | None) -> None:
    bodies = [member.body for member in creature.members] if isinstance(creature, World) else [creature]
    overlap = max((body.overlap for body in bodies if isinstance(body, Creature)), default=0.0)
    if style is not None and style.overlap > overlap:
        warn_user(
            f"simulate: the overlap {style.overlap:g} of the style has no effect, because softness is a property of the"
            f" body; make the creature with CreatureOptions(overlap={style.overlap:g})"
        )
