"""Simulation of a world: creatures perform their motions, props are passive, and all bodies advance in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from egs_warp.errors import CaptureWarning, UserError, warn_user
from egs_warp.fem.body import BodyState
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.rollout import FRAME_RATE, BodyRun, RolloutResult
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import FIRST_PART, Trajectory
from egs_warp.locomotion.world_rollout import roll_out_world, world_steps
from egs_warp.motions.other_body import OtherBody
from egs_warp.motions.push import Push
from egs_warp.motions.script import Script, check_style
from egs_warp.motions.sequence import MotionRecord
from egs_warp.motions.stance import RestDetector
from egs_warp.motions.style import Style
from egs_warp.motions.towards import script_among
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.end_state import EndCause
from egs_warp.pipelines.finished_run import PARTS
from egs_warp.pipelines.prop import Prop
from egs_warp.pipelines.simulated_run import BodyResult, Performer, SimulatedRun, check_frames
from egs_warp.pipelines.world import BodyKey, PlacedBody, World
from egs_warp.short_repr import short_repr

OtherKey = TypeVar("OtherKey", bound=PlacedBody | str)
STANDING = "stand"
"""Motion of a creature for which no motion is given."""
_PROP_TIME = 10.0
"""Time in which props have to come to rest, s: after the time limit of the last motion, or in total if there are no
creatures."""


@dataclass(frozen=True)
class PropRun:
    """Result of a prop in a world."""

    __repr__ = short_repr

    prop: Prop
    simulation: RolloutResult
    """Trajectory and reports of all steps."""

    @property
    def body(self) -> Prop:
        """The prop, as the body of a world (``BodyResult``)."""
        return self.prop

    @property
    def records(self) -> Sequence[MotionRecord]:
        """Records of the motions, of which a prop has none."""
        return ()

    @property
    def ending(self) -> EndCause:
        """Cause that ended the run early, if any."""
        return EndCause(stopped=self.simulation.stopped)

    @property
    def trajectory(self) -> Trajectory:
        """Every solver step, in the frame of the world."""
        return self.simulation.trajectory

    @property
    def frames(self) -> np.ndarray:
        """(n, 4, 3) m, nodes of the tetrahedron in each frame of a video at 60 Hz."""
        return self.trajectory.positions[self.simulation.frames]


@dataclass(frozen=True)
class WorldRun:
    """Result of ``simulate`` for a world: the result of each body."""

    world: World
    bodies: Mapping[str, SimulatedRun | PropRun]
    """Results by the names of the bodies, in the order in which the bodies were added."""

    def __repr__(self) -> str:
        return f"WorldRun({', '.join(f'{name}: {run!r}' for name, run in self.bodies.items())})"

    def __getitem__(self, member: PlacedBody | str) -> SimulatedRun | PropRun:
        """Return the result of one body."""
        return self.bodies[member if isinstance(member, str) else member.name]

    @property
    def results(self) -> Sequence[BodyResult]:
        """Results of all bodies."""
        return tuple(self.bodies.values())

    @property
    def time(self) -> np.ndarray:
        """(n,) s, time of each frame of a video."""
        first = self.results[0].simulation
        return first.trajectory.time[first.frames]

    @property
    def stopped(self) -> bool:
        """True if the run ended at a step that could not be solved."""
        return self.results[0].simulation.stopped


class PassiveMotion:
    """Motion of a prop, without objectives. It detects when the prop is at rest, or at the end of its path."""

    def __init__(self, prop: Prop, path: RigidPath | None) -> None:
        self._rest, self._path_end = RestDetector(prop.body), None if path is None else path.end
        self.is_at_rest = False
        """True as soon as the fastest node has been slow for a while (``RestDetector``), or the end of the path has
        been reached. For a repeated path, which has no end, it is always True."""

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Update ``is_at_rest`` and return no objectives."""
        if self._path_end is not None:
            self.is_at_rest = state.time >= self._path_end
            return []
        fastest = int(np.argmax(np.linalg.norm(state.velocities, axis=1)))
        self.is_at_rest = self._rest.update(state.velocities[fastest], state.time)
        return []


def simulate_world(
    world: World,
    motions: Mapping[BodyKey, Script | str],
    *,
    frames: int | None = None,
    max_seconds: float | None = None,
    step: float | None = None,
    style: Style | None = None,
    pushes: Mapping[OtherKey, Sequence[Push]] | None = None,
    get_up: bool = True,
    parts: Callable[[str], Path] | None = None,
    resume: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> WorldRun:
    """Simulate a world; the other arguments are described at ``simulate``.

    Args:
        parts: Function that returns the folder for the finished steps of the body with the given name; None writes no
            steps.
        resume: Folder of an interrupted run of this world to continue; the steps are in the folders of the bodies.
    """
    check_frames(frames)
    if not world.members:
        raise UserError("world: it has no body; add a creature or a prop")
    for note in (*world.unused_frictions, *world.thin_parts):
        warn_user(note, CaptureWarning)
    scripts = world.by_name(motions, "motion")
    pushes_on = {} if pushes is None else world.by_name(pushes, "pushes")
    for name in [*scripts, *pushes_on]:
        if isinstance(world.member(name).body, Prop):
            raise UserError(f"{name}: it is a prop, which has no muscles, motion or pushes; make it with make_creature")
    dt, _ = world_steps([member.body.body for member in world.members], step)
    performers: dict[str, Performer] = {}
    performed: list[Script] = []
    passive: dict[str, PassiveMotion] = {}
    runs: list[BodyRun] = []
    index = {member.name: number for number, member in enumerate(world.members)}

    def others(name: str) -> dict[str, OtherBody]:
        """Return the bodies other than the creature ``name``, each with a function that returns its current state."""
        return {
            member.name: OtherBody(
                member.body.body, partial(_state_of, member, runs, index[member.name]), member.body.geometry
            )
            for member in world.members
            if member.name != name
        }

    def parts_of(name: str) -> Callable[[], Path] | None:
        """Return the function that returns the folder for the steps of a body."""
        return None if parts is None else partial(parts, name)

    def recorded(name: str) -> Path | None:
        """Return the folder of the recorded steps of a body; None if it has none."""
        folder = None if resume is None else resume / name / PARTS
        return folder if folder is not None and (folder / FIRST_PART).is_file() else None

    for member in world.members:
        name, body = member.name, member.body
        if isinstance(body, Creature):
            try:
                performed.append(_script(scripts.get(name, STANDING), body, others(name), dt))
                performer = performers[name] = Performer(
                    body,
                    performed[-1],
                    frames=frames,
                    max_seconds=max_seconds,
                    step=dt,
                    style=style,
                    pushes=pushes_on.get(name, ()),
                    get_up=get_up,
                )
            except UserError as error:
                raise UserError(f"{name}: {error}") from error
            motion, kicks, front = performer.watch, performer.kicks, body.front.direction
            runs.append(
                BodyRun(
                    *(body.stepper, body.start, motion),
                    place=body.frame,
                    front=front,
                    kicks=kicks,
                    index=index[name] if len(world.members) > 1 or member.self_contact else None,
                    parts=parts_of(name),
                    resume=recorded(name),
                )
            )
        else:
            motion = passive[name] = PassiveMotion(body, member.path)
            runs.append(
                BodyRun(
                    body.stepper,
                    body.start,
                    motion,
                    place=body.frame,
                    parts=parts_of(name),
                    resume=recorded(name),
                )
            )
    check_style(style, performed)
    settling = round(_PROP_TIME * FRAME_RATE) if passive and frames is None else 0
    limit = max([performer.frame_limit for performer in performers.values()], default=0) + settling
    path_ends = [member.path.end for member in world.members if member.path is not None]
    limit = max([limit, *(round(end * FRAME_RATE) + settling for end in path_ends)]) if frames is None else frames - 1

    def is_over() -> bool:
        at_rest = all(motion.is_at_rest for motion in passive.values())
        return frames is None and at_rest and all(performer.is_over for performer in performers.values())

    def report_progress(last: int) -> None:
        done = last + 1
        progress(done, max([performer.expected_frames(done) for performer in performers.values()], default=limit))

    results = roll_out_world(world.stepper(), runs, frames=limit, step=step, finished=is_over, progress=report_progress)
    bodies: dict[str, SimulatedRun | PropRun] = {}
    for member, result in zip(world.members, results, strict=True):
        if member.name in performers:
            bodies[member.name] = performers[member.name].result(result)
        else:
            assert isinstance(member.body, Prop)
            bodies[member.name] = PropRun(member.body, result)
    return WorldRun(world, bodies)


def _script(motion: Script | str, body: Creature, others: Mapping[str, OtherBody], dt: float) -> Script:
    """Return the script of a creature; its motions may be directed towards ``others``."""
    if isinstance(motion, Script):
        return motion
    return script_among(motion, others, initial_stance(body, step=dt))


def _state_of(member: PlacedBody, runs: Sequence[BodyRun], index: int) -> BodyState:
    """Return the current state of a body, or its start if it does not have a run yet."""
    return runs[index].state if index < len(runs) else member.body.start
