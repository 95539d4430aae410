"""Simulation of a short stand that checks whether muscles from a user's file can balance a body."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.locomotion.planner import MIN_STEPS_PER_TIME_UNIT
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import measure
from egs_warp.motions.fall_monitor import start_overhang
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.push import Push
from egs_warp.motions.sequence import Stance
from egs_warp.motions.support import SupportPolygon
from egs_warp.notes import Problem
from egs_warp.pipelines.creature import Creature, CreatureOptions, creature_in_cage, initial_stance
from egs_warp.pipelines.end_state import MAX_END_TILT, has_upright_pose
from egs_warp.pipelines.facing_direction import Front
from egs_warp.pipelines.placed_cage import PlacedCage
from egs_warp.pipelines.simulated_run import MIN_FRAMES, simulate

_STAND_TIME = 6.0
"""Duration of the stand, in units of sqrt(H / g)."""
_MOTION = "stand 60"
"""Motion that is simulated for the check; the number of frames ends it before it is complete."""
_IMPULSE = 0.05
"""Impulse of the push at the start, in units of m sqrt(g H). It tips a rigid body over if its centre of mass is within
about 0.03 H, measured horizontally, of an edge of its base."""


def own_muscles_notes(cloud: GaussianCloud, standing: PlacedCage, facing: Front, muscles_file: Path) -> tuple[str, ...]:
    """Return the note of ``balance_note``, if there is one, for the muscles of a file on level ground.

    Args:
        cloud: The capture.
        standing: Cage of the capture.
        facing: Facing direction of the body.
        muscles_file: Muscles (JSON, ``egs_warp.muscles.files``).
    """
    front = facing.direction @ standing.frame.axes
    note = balance_note(creature_in_cage(cloud, standing, CreatureOptions(muscles_file=muscles_file, front=front)))
    return () if note is None else (note,)


def balance_note(creature: Creature) -> str | None:
    """Return a note for the user if ``creature`` falls over in a short stand; None if it stands.

    At the start, the creature is pushed gently towards the nearest edge of its base. There is no note for a body that
    stands even without muscles.
    """
    place = initial_stance(creature)
    if not has_upright_pose(place.base()):
        return None
    step = creature.body.time_unit / MIN_STEPS_PER_TIME_UNIT
    frame = max(1.0 / FRAME_RATE, step)
    # Copy the stepper, so that the check does not change the state of the run that follows.
    run = simulate(
        replace(creature, stepper=copy(creature.stepper)),
        _MOTION,
        frames=max(MIN_FRAMES, 1 + int(np.ceil(_STAND_TIME * creature.body.time_unit / frame))),
        step=step,
        pushes=(Push(0.0, _IMPULSE * _direction_to_edge(place)),),
        get_up=False,
    )
    tilt = measure(run.trajectory).tilt_degrees
    if run.fallen is None and not run.simulation.stopped and tilt <= MAX_END_TILT:
        return None
    end = "the next step could not be solved" if run.simulation.stopped else f"it tilts by {tilt:.0f} degrees"
    return (
        f"muscles: {creature.muscles.segment_count} segments cannot hold it upright: {end} after"
        f" {run.trajectory.time[-1]:.1f} s in a short stand; give more or stronger fibres, from the base to the top on"
        " all sides"
    )


def unstable_start_notes(place: Stance) -> tuple[str, ...]:
    """Return a warning about a body at ``place`` that may be unable to stand, because its centre of mass is outside its
    support. A ball cannot tip over."""
    outside = start_overhang(place)
    if outside == 0.0 or place.base() is SupportKind.ROUND_BASE:
        return ()
    return (
        Problem(
            f"its centre of mass is {outside:.2g} body heights outside its support, so it may tip over before it can"
            " move, and a gentler motion does not help; check the up direction and the plane, and whether a part on"
            " which it stands is missing"
        ),
    )


def _direction_to_edge(place: Stance) -> np.ndarray:
    """Return the unit vector (3,), ground axes, from the centre of mass to the nearest edge of the base."""
    base = SupportPolygon.hull(place.ground.local(place.contact_points)[:, :2])
    centre = place.ground.local(place.body.centre_of_mass(place.standing))[:2]
    return np.array([*base.normals[np.argmin(base.offsets - base.normals @ centre)], 0.0])
