"""A capture with a body, muscles and a ground: what a motion moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.contact.detection import ContactGeometry, contact_geometry
from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState, SoftBody, make_body
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.rollout import FRAME_RATE, settle, steps_per_frame
from egs_warp.locomotion.stepper import LocomotionSettings, LocomotionStepper
from egs_warp.meshing.cage import Cage, build_cage
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import Ground
from egs_warp.muscles.files import read_muscles
from egs_warp.muscles.muscle_set import MuscleSet, automatic_muscles
from egs_warp.segmentation.base_plane import find_base_plane

SMALLEST_SAG = 0.004
"""A body is not made stiffer than this column's sag, whatever it bends."""
STEEPEST_SLOPE = 45.0
"""Degrees: nothing stands on a steeper one."""


@dataclass(frozen=True)
class Creature:
    """A capture with a cage, a body, muscles and a ground, standing; metres."""

    cloud: GaussianCloud
    plane: Plane
    metres_per_unit: float
    cage: Cage
    stepper: LocomotionStepper
    """Body, muscles and contact."""
    start: BodyState
    """At rest on the ground."""
    solids: tuple[Solid, ...]
    """All that there is to stand on, the ground first."""

    @property
    def body(self) -> SoftBody:
        """The soft body."""
        return self.stepper.body

    @property
    def muscles(self) -> MuscleSet:
        """Its muscles."""
        return self.stepper.muscles

    @property
    def geometry(self) -> ContactGeometry:
        """Its contact points and planes."""
        return self.stepper.geometry


def make_creature(
    cloud: GaussianCloud,
    *,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    metres_per_unit: float | None = None,
    friction: float = 0.8,
    sag: float = DEFAULT_SAG,
    muscles_file: Path | None = None,
    solids: tuple[Solid, ...] = (),
    gravity_up: np.ndarray | None = None,
    settings: LocomotionSettings | None = None,
) -> Creature:
    """Give a capture (scene units) a body that stands on ``plane``, or on its own base, square to ``up`` (3,).

    ``muscles_file``: see ``body_muscles``. ``solids`` (scene units) are steps and walls beside the ground;
    ``gravity_up`` (3,) is against gravity if the ground is a slope. ``settings`` of its stepper choose the strategy for
    the contact states and the QP solver. The body is as stiff as makes it sag by ``sag`` of its height; one that its
    weight would bend out of shape is made stiffer.
    """
    if plane is None:
        if up is None:
            raise UserError("animate: neither up nor a plane is known; give --up or --plane")
        plane = find_base_plane(cloud, up)
    if gravity_up is not None:
        _check_slope(plane, gravity_up)
    device = str(cloud.device)
    cage = build_cage(cloud, plane)
    scale = metres_per_unit or 1.0 / cage.height(plane)
    cloud, plane, cage = cloud.scaled(scale), plane.scaled(scale), cage.scaled(scale)
    solids = tuple(solid.scaled(scale) for solid in solids)
    geometry = contact_geometry(cloud, cage.mesh, (plane,), solids=solids, friction=friction, device=device)
    while True:
        body = make_body(cage.mesh, plane, up=gravity_up, sag=sag, device=device)
        muscles = body_muscles(body, plane, muscles_file, metres_per_unit=scale)
        stepper = LocomotionStepper(body, muscles, geometry, settings=settings, device=device)
        start = settle(stepper)
        if sag < SMALLEST_SAG or _stands(stepper, start):
            return Creature(cloud, plane, scale, cage, stepper, start, (Solid((plane,)), *solids))
        sag *= 0.5


def _check_slope(plane: Plane, up: np.ndarray) -> None:
    slope = float(np.degrees(np.arccos(np.clip(plane.normal @ up / np.linalg.norm(up), -1.0, 1.0))))
    if slope > STEEPEST_SLOPE:
        raise UserError(
            f"--gravity-up {','.join(f'{x:g}' for x in up)}: that makes the ground a slope of {slope:.0f} degrees;"
            f" give a direction at most {STEEPEST_SLOPE:g} degrees from the ground's normal"
            f" {','.join(f'{x:.3g}' for x in plane.normal)}"
        )


def body_muscles(body: SoftBody, plane: Plane, file: Path | None, *, metres_per_unit: float) -> MuscleSet:
    """The muscles that ``file`` (JSON, ``egs_warp.muscles.files``) gives a body on ``plane``;
    without one, automatic ones.
    """
    if file is not None:
        return read_muscles(file, body.mesh, body_weight=body.weight, metres_per_unit=metres_per_unit)
    return automatic_muscles(
        body.mesh,
        plane.normal,
        body_weight=body.weight,
        height=body.height,
        strength=4.0 * body.stiffening,
        young_modulus=body.young_modulus,
    )


def _stands(stepper: LocomotionStepper, start: BodyState) -> bool:
    body = stepper.body
    moved = body.centre_of_mass(start.positions) - body.centre_of_mass(body.mesh.nodes)
    turn = body.best_fit_rotation(start.positions)
    gaps, _ = stepper.detector.gaps(start.positions)
    upright = np.trace(turn) > 1.0 + 2.0 * np.cos(np.radians(10.0))
    return bool(np.linalg.norm(moved) < 0.04 * body.height and upright and gaps.min() > -0.01 * body.height)


def first_place(creature: Creature, forward: np.ndarray | None = None, *, step: float | None = None) -> Place:
    """Where the creature stands at the start; ``forward`` (3,) is the way of its motions, else the long axis of its
    footprint.

    ``step``: seconds of a solver step, if not the usual (DESIGN 4).
    """
    body, start = creature.body, creature.start
    up = -body.gravity / np.linalg.norm(body.gravity)
    if forward is None:
        forward = _forward(creature)
    if np.linalg.norm(np.cross(forward, up)) < 1e-3 * np.linalg.norm(forward):
        raise UserError(
            f"--forward {','.join(f'{x:g}' for x in forward)}: points up or down; give a way along the ground"
        )
    return Place(
        body,
        Ground.on(creature.plane, forward, body.centre_of_mass(start.positions), up=up),
        start.positions,
        creature.stepper.detector.points_within(start.positions, 0.01 * body.height),
        step or 1.0 / (FRAME_RATE * steps_per_frame(body)),
        creature.solids,
        creature.geometry.friction,
    )


def _forward(creature: Creature) -> np.ndarray:
    """(3,) the long axis of the footprint: the direction in which the body is least likely to tip."""
    local = creature.cage.mesh.nodes
    sole = local[creature.plane.heights(local) < 0.06 * creature.body.height]
    first, second = creature.plane.tangents()
    flat = np.stack([(sole - sole.mean(axis=0)) @ first, (sole - sole.mean(axis=0)) @ second], axis=1)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    axis = vectors[:, 1] if values[1] > 1.2 * values[0] else np.array([1.0, 0.0])
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return axis[0] * first + axis[1] * second
