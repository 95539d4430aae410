"""Simulation of a creature that performs motions, and the resulting trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from egs_warp.errors import ArgumentError
from egs_warp.geometry.camera import FILMED_FROM, Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.rollout import (
    FRAME_RATE,
    REST_FRAMES,
    RolloutResult,
    RunSteps,
    rollout_steps,
    run_with,
    solver_steps,
)
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.push import Push, PushKicks
from egs_warp.motions.script import Script, check_style
from egs_warp.motions.script import motion as script
from egs_warp.motions.sequence import MotionRecord, MotionSequence, Stance
from egs_warp.motions.stand import or_stand
from egs_warp.motions.style import Style
from egs_warp.pipelines.captured_body import CapturedBody
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.end_state import EndCause
from egs_warp.pipelines.planned_path import planned_com
from egs_warp.pipelines.report import GaussianCounts, JsonValue, Report, report_of_run
from egs_warp.pipelines.shot import framed
from egs_warp.pipelines.time_estimate import RemainingFrames

FIELD_OF_VIEW = 30.0
"""Vertical field of view of the camera of a film, degrees."""
_MAX_GET_UP_TIME = 120.0
"""Maximum total time for getting up in one run, in units of sqrt(H / g)."""
MIN_FRAMES = 2
"""Minimum number of frames; the first one shows the body at rest."""
MAX_FRAMES = 216_000
"""Maximum number of frames that can be requested."""
_VERTICAL_COSINE = 0.9999
"""Cosine of the angle to the vertical above which a view is considered vertical."""
_SCENE_ELEVATION = 0.5
"""Ratio of the vertical to the horizontal component of the direction to the camera in a scene, so that its floor is
visible."""
_OCCLUSION_COSINE = 0.7
"""Cosine of the horizontal angle to the view direction above which Gaussians may hide the body."""
_OCCLUSION_TOLERANCE = 0.2
"""Difference of occlusion that is ignored, sr: about a tenth of a view, which a few floaters can cover."""
_OCCLUSION_DISTANCE = 2.5
"""Approximate distance of the camera, in sizes of the filmed volume; Gaussians farther away are behind the camera."""


class BodyResult(Protocol):
    """Result for one body of a run: a ``SimulatedRun`` for a creature, a ``PropRun`` for a prop."""

    @property
    def body(self) -> CapturedBody:
        """Body at the start."""
        ...

    @property
    def simulation(self) -> RolloutResult:
        """Trajectory and reports of all steps."""
        ...

    @property
    def records(self) -> Sequence[MotionRecord]:
        """Records of the motions that have started."""
        ...

    @property
    def ending(self) -> EndCause:
        """Cause that ended the last motion early, if any."""
        ...


@dataclass(frozen=True)
class SimulatedRun:
    """Result of ``simulate``."""

    creature: Creature
    place: Stance
    """Stance at the start."""
    sequence: MotionSequence
    """Motions of the run and their records."""
    simulation: RolloutResult
    """Trajectory and reports of all steps."""
    fallen: str | None = None
    """Description of the fall that ended the run; None if there was none."""
    pushes: tuple[Push, ...] = ()
    """Requested pushes."""
    has_frame_count: bool = False
    """True if the number of frames was prescribed."""

    def __repr__(self) -> str:
        names, time = ", ".join(record.name for record in self.sequence.done), self.trajectory.time
        end = " stopped" if self.simulation.stopped else " fallen" if self.fallen is not None else ""
        return (
            f"SimulatedRun({names or 'nothing'}: {len(self.simulation.frames)} frames, {time[-1] - time[0]:.2f} s{end})"
        )

    @property
    def body(self) -> Creature:
        """The creature, as the body of a world (``BodyResult``)."""
        return self.creature

    @property
    def records(self) -> Sequence[MotionRecord]:
        """Records of the motions that have started."""
        return self.sequence.done

    @property
    def ending(self) -> EndCause:
        """Cause that ended the last motion early, if any."""
        return EndCause(
            self.fallen,
            self.simulation.stopped,
            has_time_limit=not self.has_frame_count,
            is_pushed=bool(self.pushes),
            base=self.place.base(),
        )

    def unfinished_note(self) -> list[str]:
        """Return notes for the user about motions and pushes that did not take place because the run ended before
        them."""
        ended = self.fallen is not None or self.simulation.stopped
        unapplied = [push.unapplied_note(float(self.trajectory.time[-1])) for push in self.pushes]
        motion_note = self.sequence.unstarted_note() if ended else self.sequence.unfinished_note()
        return [*motion_note, *(line for line in unapplied if line is not None)]

    def report(self, *, asked: Mapping[str, JsonValue] | None = None) -> Report:
        """Return the report of the run without a film: requested and reached values, and the audit of all steps.

        ``asked`` contains the requested options for the report; None leaves them out.
        """
        return report_of_body(self, notes=self.unfinished_note(), asked=asked)

    @property
    def trajectory(self) -> Trajectory:
        """Every solver step, in the frame of the body."""
        return self.simulation.trajectory

    @property
    def frames(self) -> np.ndarray:
        """(n, N, 3) m, nodes of the cage in each frame of a video at 60 Hz, in the frame of the body."""
        return self.trajectory.positions[self.simulation.frames]

    def camera(self, size: int, view_from: np.ndarray | None = None, *, scene: GaussianCloud | None = None) -> Camera:
        """Return a fixed camera that shows the whole motion, by default from ahead and to the right of the body.

        Args:
            size: Width and height of the image, pixels.
            view_from: Direction (3,) to the camera, in the capture's frame; of several directions (n, 3), the one
                nearest to the default is used.
            scene: Gaussians around the creature, in the frame of the body; if they hide the body in the default view,
                the camera moves around it to the nearest clear side.
        """
        ground = self.place.ground
        local = ground.local(self.trajectory.positions).reshape(-1, 3)
        low, high = local.min(axis=0), local.max(axis=0)
        low[2] = min(low[2], 0.0)
        middle = 0.5 * (low + high)
        distance = float(np.linalg.norm(high - low))
        direction = self.place.view()
        if scene is not None:
            direction = self._clear_side(scene, middle, _OCCLUSION_DISTANCE * distance, direction)
        if view_from is not None:
            directions = np.atleast_2d(view_from) @ (ground.axes @ self.creature.frame.axes).T
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            direction = directions[int(np.argmax(directions[:, :2] @ FILMED_FROM[:2]))]
        direction /= np.linalg.norm(direction)
        # In a view from straight above or below, the body faces the top of the picture.
        upwards = ground.axes[0] if abs(direction[2]) > _VERTICAL_COSINE else ground.axes[2]
        camera = Camera.look_at(
            ground.world(middle + distance * direction),
            ground.world(middle),
            upwards,
            width=size,
            height=size,
            vertical_fov_degrees=FIELD_OF_VIEW,
        )
        return framed(camera, self.trajectory.positions.reshape(-1, 3))

    def _clear_side(self, scene: GaussianCloud, middle: np.ndarray, reach: float, usual: np.ndarray) -> np.ndarray:
        """Return the direction (3,) from ``middle`` (3,) to a camera that sees the body, ground axes.

        Eight directions are tested. The result is the direction nearest to ``usual`` (3,) among those whose occlusion
        by Gaussians nearer than ``reach`` (m) exceeds the minimum by at most ``_OCCLUSION_TOLERANCE``.
        """
        height = self.creature.body.height
        local = self.place.ground.local(scene.means.numpy().astype(np.float64)) - middle
        distances = np.linalg.norm(local, axis=1)
        standing = (local[:, 2] > 0.1 * height - middle[2]) & (distances > 1e-3 * height) & (distances < reach)
        log_areas = np.sort(scene.log_scales.numpy()[standing].astype(np.float64), axis=1)[:, 1:].sum(axis=1)
        hidden = 2.0 * np.pi * scene.opacities()[standing] * np.exp(log_areas) / distances[standing] ** 2
        level = local[standing, :2]
        ahead, left, _ = usual
        rotations = np.exp(0.25j * np.pi * np.array([0, 1, -1, 2, -2, 3, -3, 4]))
        sides = (ahead + 1j * left) * rotations
        directions = np.stack([sides.real, sides.imag], axis=1) / np.abs(sides)[:, None]
        blocked = hidden @ (level @ directions.T > _OCCLUSION_COSINE * np.linalg.norm(level, axis=1)[:, None])
        first = int(np.flatnonzero(blocked <= blocked.min() + _OCCLUSION_TOLERANCE)[0])
        return np.array([*directions[first], _SCENE_ELEVATION])


def report_of_body(
    result: BodyResult,
    *,
    notes: Sequence[str] = (),
    asked: Mapping[str, JsonValue] | None = None,
    unsupported: str | None = None,
) -> Report:
    """Return the report of one body that was not filmed.

    Args:
        result: The body and its steps.
        notes: Notes for the user.
        asked: Requested options of the run.
        unsupported: Reason why nothing supports the body at the end.
    """
    simulation = result.simulation
    return report_of_run(
        *(result.body, simulation.trajectory, simulation.reports, simulation.frames),
        *(result.records, energy_balance(simulation.trajectory)),
        gaussians=GaussianCounts.of(result.body),
        drawing={},
        source="",
        notes=notes,
        seed=0,
        asked=asked or {},
        ending=replace(result.ending, unsupported=unsupported),
    )


def check_frames(frames: int | None) -> None:
    """Raise ``ArgumentError`` for a number of frames that is too small or too large."""
    if frames is not None and frames < MIN_FRAMES:
        advice = f"give a whole number of at least {MIN_FRAMES}; the first picture is at rest"
        raise ArgumentError("frames", advice, value=frames)
    if frames is not None and frames > MAX_FRAMES:
        raise ArgumentError("frames", f"give at most {MAX_FRAMES} frames, which are an hour", value=frames)


class Performer:
    """Motions of one creature in a run: stance, sequence of motions, fall monitor and time limit."""

    def __init__(
        self,
        creature: Creature,
        motion: Script | str,
        *,
        frames: int | None = None,
        max_seconds: float | None = None,
        step: float | None = None,
        style: Style | None = None,
        pushes: Sequence[Push] = (),
        get_up: bool = True,
    ) -> None:
        """Prepare the motions; for the arguments see ``simulate``."""
        motion = script(motion) if isinstance(motion, str) else motion
        self.creature, self.pushes = creature, tuple(pushes)
        self.place = initial_stance(creature, step=step, style=style)
        expected = motion.check(self.place)
        self.sequence = MotionSequence(self.place, [or_stand(part) for part in motion.parts(creature.body.height)])
        self.watch = FallMonitor(self.sequence, self.place, gets_up=get_up)
        self.kicks = PushKicks(self.place, self.pushes)
        # If a time step is longer than 1/60 s, each frame consists of one step.
        self._frame = max(1.0 / FRAME_RATE, step or 0.0)
        self._limit = round(min(motion.frames(creature.body.height) / FRAME_RATE, max_seconds or np.inf) / self._frame)
        self._max_frames = self._limit if frames is None else frames - 1
        self._frames = frames
        # The maximum time for getting up is added to the time limit.
        self._get_up_frames = (
            round(_MAX_GET_UP_TIME * creature.body.time_unit / self._frame) if get_up and frames is None else 0
        )
        self._remaining = RemainingFrames(self.sequence, expected, frame=self._frame, max_frames=self._max_frames)

    @property
    def frame_limit(self) -> int:
        """Maximum number of frames after the first one."""
        return self._max_frames + self._get_up_frames

    @property
    def is_over(self) -> bool:
        """True if no number of frames was requested, and the motions have ended or their time limit is reached."""
        watch = self.watch
        time_limit = (self._limit - REST_FRAMES) * self._frame + watch.get_up_time
        return self._frames is None and (watch.is_finished or watch.time + 1e-9 >= time_limit)

    def expected_frames(self, done: int) -> int:
        """Return the expected total number of frames when ``done`` frames are finished."""
        if self._frames is not None:
            return self._max_frames
        return max(done, self._remaining.frames(done, finished=self.watch.is_finished))

    def result(self, simulation: RolloutResult, *, has_frame_count: bool | None = None) -> SimulatedRun:
        """Return the result of the run. ``has_frame_count`` is True if the number of frames was prescribed; if it is
        None, this is determined by whether ``frames`` was given."""
        trajectory = simulation.trajectory
        trajectory = trajectory.with_plan(planned_com(self.sequence, self.creature.body, trajectory))
        simulation = replace(simulation, trajectory=trajectory)
        has_frame_count = self._frames is not None if has_frame_count is None else has_frame_count
        return SimulatedRun(
            self.creature, self.place, self.sequence, simulation, self.watch.fall_note, self.pushes, has_frame_count
        )


def simulate(
    creature: Creature,
    motion: Script | str,
    *,
    frames: int | None = None,
    max_seconds: float | None = None,
    step: float | None = None,
    style: Style | None = None,
    pushes: Sequence[Push] = (),
    get_up: bool = True,
    ends_at_fall: bool = False,
    activations: np.ndarray | None = None,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> SimulatedRun:
    """Simulate a motion.

    Args:
        creature: The creature at rest.
        motion: The motion or motions, as a script or as its text (``egs_warp.motions.script``).
        frames: Number of frames at 60 Hz, the first at rest; None runs until the body has come to rest or fallen, or
            the time limit is reached.
        max_seconds: Time limit of the motion, s; None uses the motion's own limit.
        step: Maximum step size, s; None uses the default.
        style: Style of jumps; None uses the default.
        pushes: Pushes during the run.
        get_up: True to get up and continue if the body falls.
        ends_at_fall: True to end the run at the step at which a fall is detected.
        activations: (steps, M) m, prescribed muscle activations of each solver step. The motion then only defines the
            measured values, and the run ends with the last row.
        parts: Function that returns the folder into which finished steps are written; None writes no steps.
        resume: Folder with the finished steps of an interrupted run to continue.
        progress: Called after each frame with the number of finished frames and the number expected in total.

    Raises:
        UserError: The body cannot perform the motion, an argument is invalid, or ``resume`` belongs to another run.
    """
    return run_with(
        creature.stepper,
        simulation_steps(
            creature,
            motion,
            frames=frames,
            max_seconds=max_seconds,
            step=step,
            style=style,
            pushes=pushes,
            get_up=get_up,
            ends_at_fall=ends_at_fall,
            activations=activations,
            parts=parts,
            resume=resume,
            progress=progress,
        ),
    )


def simulation_steps(
    creature: Creature,
    motion: Script | str,
    *,
    frames: int | None = None,
    max_seconds: float | None = None,
    step: float | None = None,
    style: Style | None = None,
    pushes: Sequence[Push] = (),
    get_up: bool = True,
    ends_at_fall: bool = False,
    activations: np.ndarray | None = None,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> RunSteps[SimulatedRun]:
    """Yield the steps of ``simulate``, with the same arguments, and return its result at the end."""
    check_frames(frames)
    motion = script(motion) if isinstance(motion, str) else motion
    check_style(style, [motion])
    if activations is not None:
        activations = checked_activations(creature, activations, step)
    performer = Performer(
        creature,
        motion,
        frames=frames,
        max_seconds=max_seconds,
        step=step,
        style=style,
        pushes=pushes,
        get_up=get_up and not ends_at_fall,
    )
    simulation = yield from rollout_steps(
        creature.stepper,
        creature.start,
        performer.watch,
        frames=performer.frame_limit,
        step=step,
        place=creature.frame,
        front=creature.front.direction,
        parts=parts,
        resume=resume,
        finished=lambda: performer.is_over,
        aborted=lambda: ends_at_fall and performer.watch.fallen is not None,
        kicks=performer.kicks,
        activations=activations,
        progress=lambda last: progress(last + 1, performer.expected_frames(last + 1)),
    )
    return performer.result(simulation, has_frame_count=True if activations is not None else None)


def checked_activations(creature: Creature, activations: np.ndarray, step: float | None) -> np.ndarray:
    """Return ``activations`` as (steps, M) float64 m.

    Raises ``ArgumentError`` for a wrong shape, fewer steps than one frame, or values outside the muscles' bounds.
    """
    count, min_steps = creature.muscles.segment_count, solver_steps(creature.body, step)[1]
    values = np.array(activations, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != count or len(values) < min_steps:
        advice = f"give a row of {count} metres, one for each muscle, for each of at least {min_steps} solver steps"
        raise ArgumentError("activations", f"of shape {values.shape}; {advice}")
    # The condition is not "any above the bound", because NaN must be rejected, too.
    bounds = creature.muscles.bounds
    is_allowed = np.abs(values) <= bounds * (1.0 + 1e-9)
    if not is_allowed.all():
        row, muscle = np.unravel_index(np.argmin(is_allowed), values.shape)
        raise ArgumentError(
            "activations",
            f"{values[row, muscle]:g} m in row {row} is outside the bound {bounds[muscle]:g} m of muscle {muscle}; keep"
            " each within muscles.bounds",
        )
    return values
