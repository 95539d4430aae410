"""A creature moves: motions by name become what its body does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import ArgumentError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import box_corners
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.locomotion.rollout import FRAME_RATE, REST_FRAMES, RolloutResult, roll_out, solver_steps
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.push import Push, PushKicks
from egs_warp.motions.script import Script
from egs_warp.motions.sequence import MotionSequence, Stance
from egs_warp.motions.style import Style
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.end_state import EndCause
from egs_warp.pipelines.planned_path import planned_com
from egs_warp.pipelines.time_estimate import RemainingFrames

FILMED_FROM = (0.6, -1.0, 0.22)
"""From the body to the camera of a film: ahead, left and up; it shows the face and the way."""
_RISING = 120.0
"""sqrt(H / g) that getting up may take in one run."""
LEAST_FRAMES = 2
"""Of a film; the first one is at rest."""
MOST_FRAMES = 216_000
"""Of a run that is told how many."""
_STEEP = 0.9999
"""Cosine to the vertical of a view from straight above or below."""
_FROM_ABOVE = 0.5
"""Up for one along the ground, in a scene, which has a floor to be seen."""
_IN_THE_WAY = 0.7
"""Cosine of the angle to a side of the film within which things stand between."""
_MORE = 0.2
"""Steradians, a tenth of a side: so much more in the way than on another side, as a few floaters are, does not
matter."""
_NEARER = 2.5
"""Of the size of what is filmed: about how far away the camera is; what is further stands behind it."""


@dataclass(frozen=True)
class SimulatedRun:
    """What a creature did."""

    creature: Creature
    place: Stance
    """Where it stood at the start."""
    sequence: MotionSequence
    """The motions that it went through."""
    simulation: RolloutResult
    fallen: str | None = None
    """How it was told that the creature has fallen, if it has."""
    pushes: tuple[Push, ...] = ()
    """What was to hit it."""

    @property
    def ending(self) -> EndCause:
        """How the last motion ended."""
        return EndCause(self.fallen, self.simulation.stopped)

    def cut_short(self) -> list[str]:
        """What the end kept from being done, for the user."""
        ended = self.fallen is not None or self.simulation.stopped
        missed = [push.unapplied_note(float(self.trajectory.time[-1])) for push in self.pushes]
        told = self.sequence.unstarted_note() if ended else self.sequence.unfinished_note()
        return [*told, *(line for line in missed if line is not None)]

    @property
    def trajectory(self) -> Trajectory:
        """Every solver step, in the frame of the body."""
        return self.simulation.trajectory

    @property
    def frames(self) -> np.ndarray:
        """(n, N, 3) metres, in the frame of the body: the nodes of the cage in each frame of a video at 60 Hz."""
        return self.trajectory.positions[self.simulation.frames]

    def camera(self, size: int, view_from: np.ndarray | None = None, *, scene: GaussianCloud | None = None) -> Camera:
        """A fixed camera of ``size`` pixels both ways that holds the whole motion: ahead and to the right of it, or in
        the direction ``view_from`` (3,) of the capture's frame; of several (n, 3), in the one nearest to that.

        Where the ``scene``, in the frame of the body, has much between, it goes round to the nearest clearer side.
        """
        ground = self.place.ground
        local = ground.local(self.trajectory.positions).reshape(-1, 3)
        low, high = local.min(axis=0), local.max(axis=0)
        low[2] = min(low[2], 0.0)
        middle = 0.5 * (low + high)
        corners = box_corners(low, high)
        distance = float(np.linalg.norm(high - low))
        direction = np.array(FILMED_FROM) if scene is None else self._clear_side(scene, middle, _NEARER * distance)
        if view_from is not None:
            ways = np.atleast_2d(view_from) @ (ground.axes @ self.creature.frame.axes).T
            ways /= np.linalg.norm(ways, axis=1, keepdims=True)
            direction = ways[int(np.argmax(ways[:, :2] @ FILMED_FROM[:2]))]
        direction /= np.linalg.norm(direction)
        # From above or below, the way the body faces is up in the picture.
        upwards = ground.axes[0] if abs(direction[2]) > _STEEP else ground.axes[2]
        for _ in range(60):
            camera = Camera.look_at(
                ground.world(middle + distance * direction),
                ground.world(middle),
                upwards,
                width=size,
                height=size,
                vertical_fov_degrees=30.0,
                near=0.01 * distance,
            )
            seen = ground.world(corners) @ camera.rotation.T + camera.translation
            reach = np.abs(seen[:, :2] / seen[:, 2:]).max() * camera.fx / (0.5 * size)
            if seen[:, 2].min() > 0 and reach < 0.86:
                break
            distance *= 1.05
        return camera

    def _clear_side(self, scene: GaussianCloud, middle: np.ndarray, reach: float) -> np.ndarray:
        """(3,) from ``middle`` (3,) to the camera, ground axes: of eight sides, from the usual one on, the nearest on
        which what stands nearer than ``reach`` hides hardly more than on any."""
        height = self.creature.body.height
        local = self.place.ground.local(scene.means.numpy().astype(np.float64)) - middle
        away = np.linalg.norm(local, axis=1)
        standing = (local[:, 2] > 0.1 * height - middle[2]) & (away > 1e-3 * height) & (away < reach)
        broad = np.sort(scene.log_scales.numpy()[standing].astype(np.float64), axis=1)[:, 1:].sum(axis=1)
        hidden = 2.0 * np.pi * scene.opacities()[standing] * np.exp(broad) / away[standing] ** 2
        level = local[standing, :2]
        ahead, left, _ = FILMED_FROM
        turns = np.exp(0.25j * np.pi * np.array([0, 1, -1, 2, -2, 3, -3, 4]))
        sides = (ahead + 1j * left) * turns
        ways = np.stack([sides.real, sides.imag], axis=1) / np.abs(sides)[:, None]
        blocked = hidden @ (level @ ways.T > _IN_THE_WAY * np.linalg.norm(level, axis=1)[:, None])
        first = int(np.flatnonzero(blocked <= blocked.min() + _MORE)[0])
        return np.array([*ways[first], _FROM_ABOVE])


def check_frames(frames: int | None) -> None:
    """Raise ``ArgumentError`` for a film without motion."""
    if frames is not None and frames < LEAST_FRAMES:
        advice = f"give a whole number of at least {LEAST_FRAMES}; the first picture is at rest"
        raise ArgumentError("frames", advice, value=frames)
    if frames is not None and frames > MOST_FRAMES:
        raise ArgumentError("frames", f"give at most {MOST_FRAMES}, which is an hour", value=frames)


def simulate(
    creature: Creature,
    motion: Script,
    *,
    frames: int | None = None,
    longest: float | None = None,
    step: float | None = None,
    style: Style | None = None,
    pushes: Sequence[Push] = (),
    get_up: bool = True,
    activations: np.ndarray | None = None,
    parts: Callable[[], Path] | None = None,
    resume: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, expected: None,
) -> SimulatedRun:
    """Run ``motion`` for ``frames`` pictures at 60 Hz, the first of them at rest, or else until the body has come to
    rest or fallen, or the motion is cut off.

    ``longest``: seconds after which it is cut off, if that is earlier; ``step``: those of a solver step, if not the
    usual; ``style``: how it jumps; ``pushes``: what hits it meanwhile; ``get_up``: whether a body that has fallen is to
    get up and go on; ``activations`` (steps, M) metres: what muscles do in each solver step, whatever the motion would
    have them do, which then only says what is measured; the run ends with the last of them. ``parts`` tells the folder
    that takes the steps as they are done, ``resume`` is that of a run that was cut off and goes on. ``progress`` is
    told after each frame how many are done, and how many are expected in all by now. Raises ``UserError`` for a motion
    that the body cannot do, and a folder that another run has left.
    """
    check_frames(frames)
    if activations is not None:
        activations = checked_activations(creature, activations, step)
    place = initial_stance(creature, step=step, style=style)
    expected = motion.check(place)
    sequence = MotionSequence(place, motion.parts(creature.body.height))
    watch = FallMonitor(sequence, place, gets_up=get_up)
    # A frame is as long as a step that is longer than it.
    frame = max(1.0 / FRAME_RATE, step or 0.0)
    limit = round(min(motion.frames(creature.body.height) / FRAME_RATE, longest or np.inf) / frame)
    most = limit if frames is None else frames - 1
    # What getting up takes comes on top.
    rising = round(_RISING * creature.body.time_unit / frame) if get_up and frames is None else 0

    def over() -> bool:
        return watch.is_finished or watch.time + 1e-9 >= (limit - REST_FRAMES) * frame + watch.spent

    outlook = RemainingFrames(sequence, expected, frame=frame, most=most)
    simulation = roll_out(
        creature.stepper,
        creature.geometry,
        creature.start,
        watch,
        frames=most + rising,
        step=step,
        place=creature.frame,
        parts=parts,
        resume=resume,
        finished=lambda: frames is None and over(),
        kicks=PushKicks(place, pushes),
        activations=activations,
        progress=lambda last: progress(
            last + 1, max(last + 1, outlook.frames(last + 1, finished=watch.is_finished)) if frames is None else most
        ),
    )
    trajectory = simulation.trajectory
    trajectory = trajectory.with_plan(planned_com(sequence, creature.body, trajectory))
    simulation = replace(simulation, trajectory=trajectory)
    return SimulatedRun(creature, place, sequence, simulation, watch.fallen, tuple(pushes))


def checked_activations(creature: Creature, activations: np.ndarray, step: float | None) -> np.ndarray:
    """(steps, M) float64 metres. Raises ``ArgumentError`` for anything else, for too few of them, and for what a muscle
    cannot do."""
    count, least = creature.muscles.segment_count, solver_steps(creature.body, step)[1]
    given = np.array(activations, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] != count or len(given) < least:
        advice = f"give a row of {count} metres, one for each muscle, for each of at least {least} solver steps"
        raise ArgumentError("activations", f"of shape {given.shape}; {advice}")
    # Not "any beyond": NaN is beyond, too.
    if not (np.abs(given) <= creature.muscles.bounds * (1.0 + 1e-9)).all():
        raise ArgumentError("activations", "beyond what a muscle can do; keep each within its bounds (muscles.bounds)")
    return given
