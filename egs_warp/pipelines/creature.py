"""The creature: a capture with a soft body, muscles and a ground, ready to be simulated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from egs_warp.checked_calls import Range, checked_constructor
from egs_warp.contact.detection import ContactGeometry, contact_geometry
from egs_warp.contact.terrain import Solid
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError, CaptureWarning, warn_user
from egs_warp.fem.body import DEFAULT_SAG, BodyState, SoftBody, make_body
from egs_warp.fem.soft_parts import bending_frequency, stiffness_at_segments, with_soft_parts
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.camera import FILMED_FROM
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import mean_edge_length
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.settling import SHAPE_TOLERANCE, settle, settle_as_captured
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.meshing.cage import NODE_COUNTS, Cage
from egs_warp.meshing.protrusions import find_protrusions
from egs_warp.motions.feet import SupportKind, support_kind_of
from egs_warp.motions.limbs import Limbs
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import GroundFrame
from egs_warp.motions.style import MAX_OVERLAP, Style
from egs_warp.muscles.files import read_muscles
from egs_warp.muscles.muscle_set import MuscleSet, automatic_muscles
from egs_warp.pipelines.capture_warnings import capture_warnings
from egs_warp.pipelines.captured_body import CapturedBody, CapturedShape, Friction, points_at_rest
from egs_warp.pipelines.facing_direction import Front
from egs_warp.pipelines.placed_cage import (
    PlacedCage,
    check_front,
    check_height,
    choose_front,
    estimated_up,
    node_count_note,
    place_cage,
    plane_below,
    simulation_device,
)
from egs_warp.short_repr import short_repr

MIN_SAG = 0.004
"""Minimum sag, as a fraction of the height. If its weight bends the body too much, the sag is halved repeatedly, until
it is below this value."""
_SAG_LIMITS = 1e-4, 0.5
"""Minimum and maximum sag that can be requested."""
_STRENGTH_POWER = 3
"""Exponent p: in soft parts, the strength of automatic muscles is proportional to the p-th power of the relative
stiffness. With p = 1, the muscles would stop the swing of a soft part before it returns."""
MAX_SLOPE = 45.0
"""Maximum slope of the ground, degrees; steeper ground is rejected."""
_GROUND_SPACING = 0.5
"""Spacing of the nodes of uneven ground, in mean edge lengths of the cage; the spacing of contact points is 0.4 edge
lengths."""
CONTACT_GRID = 2.0**-10
"""Rounding step of contact points, as a fraction of the height. Jumps are sensitive to the last bits of coordinates,
which change if a capture is rotated or its unit changes."""
TOUCHING = 0.01
"""Maximum distance, in body heights, at which a point of a standing body touches the surface below it."""
_MAX_AZIMUTH = np.radians(60.0)
"""Maximum azimuth of a film's camera relative to the estimated front, if this estimate is not clear, radians."""


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class CreatureOptions:
    """Options of ``make_creature``; vectors, planes and surfaces are in the frame and units of the capture."""

    __repr__ = short_repr

    metres_per_unit: Annotated[float, Range(1e-9, 1e9, "a number of metres")] | None = None
    """Length of one unit of the capture, m; None uses ``height``."""
    height: float | None = None
    """Height of the body, m; None makes it 1 m tall."""
    sag: Annotated[float, Range(*_SAG_LIMITS, "a fraction of the height")] = DEFAULT_SAG
    """Fraction of the body height by which the body sags under its weight; it defines the stiffness. If the weight
    would bend the body out of shape, the stiffness is increased."""
    overlap: Annotated[float, Range(0.0, MAX_OVERLAP, "a fraction of the length of a part")] = 0.0
    """Softness, 0 to 0.5, of parts that stick out, such as an ear, an arm or a tail (``find_protrusions``): the
    fraction of its length by which such a part would sag under its weight. Soft parts lag behind the body and settle
    after it. With 0, they are as stiff as the body."""
    nodes: Annotated[int, NODE_COUNTS] = 500
    """Approximate number of cage nodes."""
    cage_file: Path | None = None
    """File with a cage of tetrahedra (``egs_warp.meshing.cage_file``), which replaces the automatic cage with ``nodes``
    nodes."""
    muscles_file: Path | None = None
    """File of muscles (JSON, ``egs_warp.muscles.files``); None creates automatic muscles."""
    front: Direction | None = None
    """(3,) Direction in which the body faces and moves, or an axis; None estimates it (``find_front``)."""
    seen_from: Annotated[np.ndarray, 3] | None = None
    """(3,) Mean of the unit vectors from the object to the cameras of its photos, for the estimate of ``front``."""
    friction: Friction = 0.8
    """Coulomb coefficient of the ground, 0 to 10."""
    ground: HeightField | None = None
    """Ground that is not flat; it replaces the ground plane."""
    gravity_up: Direction | None = None
    """(3,) Direction opposite to gravity, or an axis; None uses the normal of the ground, which is then level."""
    solids: tuple[Solid, ...] = ()
    """Steps and walls, in addition to the ground."""
    settings: LocomotionSettings | None = None
    """Solver settings, such as the contact strategy and the QP solver; None uses the default."""

    def __post_init__(self) -> None:
        check_height(self.height, self.metres_per_unit)
        for name, direction in (("front", self.front), ("gravity_up", self.gravity_up)):
            if direction is not None:
                direction_of(direction, name)


@dataclass(frozen=True, kw_only=True, repr=False)
class Creature(CapturedBody):
    """A captured object with a cage, a body, muscles and a ground, at rest; lengths are in metres."""

    front: Front
    """Direction in which the body faces and moves at the start, in the frame of ``start``."""
    limbs: Limbs
    """Limbs on which the body stands."""
    cage: Cage
    """Tetrahedral mesh around the Gaussians."""
    overlap: float = 0.0
    """Softness of the parts that stick out (``CreatureOptions``)."""

    def _moved(self, turn: np.ndarray, shift: np.ndarray) -> Creature:
        return replace(super()._moved(turn, shift), front=self.front.rotated(turn))


def make_creature(
    cloud: GaussianCloud,
    *,
    up: Direction | None = None,
    plane: Plane | None = None,
    options: CreatureOptions | None = None,
    progress: Callable[[str], object] = lambda stage: None,
) -> Creature:
    """Create a creature, at rest on the ground, from a capture of a single object.

    All arguments are in the frame and units of the capture; the result is in the frame of the body, so it does not
    depend on the frame of the file.

    Args:
        cloud: The capture.
        up: (3,) Up direction, or an axis such as ``"-y"``; without a ``plane``, the ground is the base of the object,
            orthogonal to ``up``. If ``plane``, ``up`` and ``options.ground`` are all None, the up direction of the file
            is used; if the file has none, it is estimated (``guess_up``). A note reports it.
        plane: Ground plane.
        options: Body, muscles, ground and solver; None uses the default.
        progress: Called with the name of each stage as it starts.

    Raises:
        UserError: An argument is invalid, the ground is too steep, or no body can be made from the capture.

    Warns:
        CaptureWarning: The capture may result in a poor body.

    Returns:
        The creature. Its ``notes`` contain all guesses and warnings, which its text representation shows, too.
    """
    return make_checked_creature(cloud, up=up, plane=plane, options=options or CreatureOptions(), progress=progress)


def make_checked_creature(
    cloud: GaussianCloud,
    *,
    up: Direction | None,
    plane: Plane | None,
    options: CreatureOptions,
    progress: Callable[[str], object],
    check: Callable[[Stance], object] | None = None,
) -> Creature:
    """Create a creature as ``make_creature`` does, after ``check`` has seen its shape (``creature_in_cage``)."""
    progress("cage")
    standing, notes = placed_body(cloud, up=up, plane=plane, options=options)
    if options.cage_file is None:
        notes = (*notes, *node_count_note(standing.cage.mesh, options.nodes))
    return creature_in_cage(cloud, standing, options, notes=notes, progress=progress, check=check)


def placed_body(
    cloud: GaussianCloud, *, up: Direction | None, plane: Plane | None, options: CreatureOptions
) -> tuple[PlacedCage, tuple[str, ...]]:
    """Return the cage of a capture on its ground, the first part of ``make_creature``, and notes for the user.

    Args:
        cloud: The capture.
        up: (3,) Up direction, as for ``make_creature``.
        plane: Ground plane, as for ``make_creature``.
        options: Size, number of nodes, ground and front.

    Raises:
        UserError: An argument is invalid, the ground is too steep, or the capture has no volume.
    """
    ground, notes = options.ground, ()
    gravity_up = None if options.gravity_up is None else direction_of(options.gravity_up, "gravity_up")
    front = None if options.front is None else direction_of(options.front, "front")
    up = None if up is None else direction_of(up, "up")
    if ground is not None:
        plane = plane_below(cloud, ground)
    if plane is None and up is None:
        up, note = estimated_up(cloud, advice="pass another up direction")
        notes = (note,)
    normal = plane.normal if plane is not None else up
    assert normal is not None
    if gravity_up is not None:
        _check_slope(normal / np.linalg.norm(normal), gravity_up)
    if front is not None:
        check_front(normal if gravity_up is None else gravity_up, front)
    standing = place_cage(
        cloud,
        up=up,
        plane=plane,
        metres_per_unit=options.metres_per_unit,
        height=options.height,
        nodes=options.nodes,
        cage_file=options.cage_file,
    )
    return standing, notes


def placed_front(standing: PlacedCage, options: CreatureOptions) -> Front:
    """Return the facing direction of a body on its ground: that of ``options``, or else an estimate."""
    front = None if options.front is None else direction_of(options.front, "front")
    return choose_front(standing, front, seen_from=options.seen_from)


def creature_in_cage(
    cloud: GaussianCloud,
    standing: PlacedCage,
    options: CreatureOptions,
    *,
    front: Front | None = None,
    notes: tuple[str, ...] = (),
    progress: Callable[[str], object] = lambda stage: None,
    check: Callable[[Stance], object] | None = None,
) -> Creature:
    """Create the creature of a capture for which a cage has already been built (``make_creature``).

    Args:
        cloud: The capture.
        standing: Cage of the capture (``place_cage``).
        options: Body, muscles, ground and solver.
        front: Facing direction; None chooses it (``placed_front``).
        notes: Guesses that were made about the capture, for the user.
        progress: Called with the name of each stage as it starts.
        check: Called with the stance of the captured shape (``captured_stance``) before the body is simulated; it may
            raise ``UserError`` for a body that is not suitable.
    """
    device, frame, cage = simulation_device(cloud), standing.frame, standing.cage
    if front is None:
        progress("front")
        front = placed_front(standing, options)
    progress("contact")
    solids = tuple(Solid(tuple(frame.plane(face) for face in solid.faces)) for solid in options.solids)
    field = None
    if options.ground is not None:
        # Smooth the ground, because the cage cannot follow details that are smaller than its edges.
        field = frame.height_field(options.ground).coarser(_GROUND_SPACING * mean_edge_length(cage.mesh))
    geometry = contact_geometry(
        standing.gaussians,
        cage.mesh,
        (GROUND,),
        field=field,
        solids=solids,
        friction=options.friction,
        grid=CONTACT_GRID * cage.height(GROUND),
        device=device,
    )
    if check is not None:
        check(captured_stance(standing, front, make_body(cage.mesh, GROUND, device=device), geometry))
    up, sag = options.gravity_up, options.sag
    against_gravity = None if up is None else frame.axes @ direction_of(up, "gravity_up")
    while True:
        progress("body and muscles")
        body = make_body(cage.mesh, GROUND, up=against_gravity, sag=sag, device=device)
        body = _with_overlap(body, standing.limbs, options.overlap)
        muscles = body_muscles(body, options.muscles_file, frame)
        stepper = LocomotionStepper(body, muscles, geometry, settings=options.settings, device=device)
        progress("stand")
        stepper, start, is_stiff_enough = _rest_state(stepper, standing.limbs)
        if is_stiff_enough or sag < MIN_SAG:
            placed = to_body_frame(cloud, frame)
            warnings = capture_warnings(placed, cage.mesh, body.height, thickening=cage.thickening)
            for warning in warnings:
                warn_user(warning, CaptureWarning)
            guesses = () if options.front is not None else (front.description(frame),)
            return Creature(
                frame=frame,
                cloud=placed,
                front=front,
                limbs=standing.limbs,
                cage=cage,
                stepper=stepper,
                start=start,
                solids=(field or Solid((GROUND,)), *solids),
                shape=CapturedShape(standing.gaussians, points_at_rest(geometry)),
                notes=(*notes, *guesses, *warnings),
                overlap=options.overlap,
            )
        sag *= 0.5


def changed_creature(creature: Creature, *, friction: float, sag: float, muscles_file: Path | None) -> Creature:
    """Return ``creature`` at rest with another friction and stiffness, but the same cage and ground.

    Args:
        creature: The creature to change.
        friction: Coulomb coefficient.
        sag: Fraction of its height by which the body sags, which defines the stiffness (``make_body``).
        muscles_file: File of muscles (``body_muscles``); automatic muscles depend on the stiffness.
    """
    device = simulation_device(creature.cloud)
    body, geometry = creature.body, replace(creature.geometry, friction=friction)
    up = -body.gravity / np.linalg.norm(body.gravity)
    new_body = make_body(creature.cage.mesh, GROUND, up=up, sag=sag, device=device)
    new_body = _with_overlap(new_body, creature.limbs, creature.overlap)
    muscles = body_muscles(new_body, muscles_file, creature.frame)
    stepper = LocomotionStepper(new_body, muscles, geometry, settings=creature.stepper.settings, device=device)
    stepper, start, _ = _rest_state(stepper, creature.limbs)
    return replace(creature, stepper=stepper, start=creature.placement.applied_to(start))


def _check_slope(normal: np.ndarray, up: np.ndarray) -> None:
    slope = float(np.degrees(np.arccos(np.clip(normal @ up / np.linalg.norm(up), -1.0, 1.0))))
    if slope > MAX_SLOPE:
        raise ArgumentError(
            "gravity_up",
            f"it makes the ground a slope of {slope:.0f} degrees; give a direction at most {MAX_SLOPE:g} degrees"
            f" from the ground's normal {','.join(f'{x:.3g}' for x in normal)}",
            value=",".join(f"{x:g}" for x in up),
        )


def body_muscles(body: SoftBody, file: Path | None, frame: BodyFrame) -> MuscleSet:
    """Return the muscles of a body, from ``file`` (JSON, ``egs_warp.muscles.files``) or generated automatically.

    Args:
        body: The soft body.
        file: Muscles in the capture's frame and units; None creates automatic muscles.
        frame: Frame of the body in the capture.
    """
    if file is not None:
        return read_muscles(file, body.mesh, body_weight=body.weight, frame=frame)
    muscles = automatic_muscles(
        body.mesh,
        GROUND.normal,
        body_weight=body.weight,
        height=body.height,
        strength=4.0 * body.stiffening,
        young_modulus=body.young_modulus,
    )
    if body.assembly.material.relative_stiffness is None:
        return muscles
    relative = stiffness_at_segments(body, muscles)
    return replace(muscles, stiffness=muscles.stiffness * relative**_STRENGTH_POWER)


def _with_overlap(body: SoftBody, limbs: Limbs, overlap: float) -> SoftBody:
    """Return ``body`` with its protruding parts softened (``CreatureOptions.overlap``).

    If the captured shape is the unloaded shape of the body (``_rest_state``), the body is returned unchanged, because
    its softened parts would droop.
    """
    if overlap == 0.0 or _keeps_shape(body, limbs):
        return body
    parts = find_protrusions(body.mesh, GROUND.normal)
    gravity = float(np.linalg.norm(body.gravity))
    return with_soft_parts(
        body, [part.nodes for part in parts], [bending_frequency(overlap, part.length, gravity) for part in parts]
    )


def _keeps_shape(body: SoftBody, limbs: Limbs) -> bool:
    """Return True if the captured shape is used as the unloaded shape: for a body on a round base, and for a lying
    body."""
    kind = support_kind_of(body.mesh, body.mesh.nodes[:, 2], limbs.count)
    return kind in (SupportKind.ROUND_BASE, SupportKind.LYING)


def _rest_state(stepper: LocomotionStepper, limbs: Limbs) -> tuple[LocomotionStepper, BodyState, bool]:
    """Let a body come to rest in its captured shape (``settle_as_captured``).

    For a body on a round base, and for a lying body, the captured shape is instead used as the unloaded shape, so that
    the weight flattens the body where it touches the ground. If such a body had its round captured shape under load, it
    would touch the ground at a single point.

    Returns:
        The stepper with the unloaded shape; the state at rest; and False if the body is too soft to stand or to come to
        rest in its captured shape.
    """
    start = settle(stepper)
    if not _stands(stepper, start):
        return stepper, start, False
    if _keeps_shape(stepper.body, limbs):
        return stepper, start, True
    # The unloaded shape is a property of the body, so it must not depend on the friction of the ground.
    friction = stepper.geometry.friction
    reference = stepper.with_friction(CreatureOptions.friction)
    stepper, start, shape_error = settle_as_captured(reference, settle(reference))
    if friction != CreatureOptions.friction:
        stepper = stepper.with_friction(friction)
        start = settle(stepper)
    return stepper, start, shape_error <= SHAPE_TOLERANCE


def _stands(stepper: LocomotionStepper, start: BodyState) -> bool:
    body = stepper.body
    moved = body.centre_of_mass(start.positions) - body.centre_of_mass(body.mesh.nodes)
    turn = body.best_fit_rotation(start.positions)
    gaps, _ = stepper.detector.gaps(start.positions)
    upright = np.trace(turn) > 1.0 + 2.0 * np.cos(np.radians(10.0))
    return bool(np.linalg.norm(moved) < 0.04 * body.height and upright and gaps.min() > -0.01 * body.height)


def captured_stance(standing: PlacedCage, front: Front, body: SoftBody, geometry: ContactGeometry) -> Stance:
    """Return the stance of ``body`` in its captured shape on flat ground, before its weight deforms it.

    Args:
        standing: Cage of the capture.
        front: Direction in which the body faces.
        body: Body of the cage.
        geometry: Contact points of the body.
    """
    nodes, points = standing.cage.mesh.nodes, points_at_rest(geometry)
    return Stance(
        body,
        GroundFrame.on_plane(GROUND, front.direction, body.centre_of_mass(nodes)),
        nodes,
        points[points[:, 2] < points[:, 2].min() + TOUCHING * body.height],
        solver_steps(body, None)[0],
        friction=geometry.friction,
        limbs=standing.limbs,
    )


def initial_stance(creature: Creature, *, step: float | None = None, style: Style | None = None) -> Stance:
    """Return the stance of the creature at the start, in which it faces forward.

    Args:
        creature: The creature.
        step: Maximum step size, s (``solver_steps``); None uses the default.
        style: Style of jumps; None uses the default.
    """
    body, start = creature.body, creature.start
    up = -body.gravity / np.linalg.norm(body.gravity)
    if creature.support is None:
        plane, touching = GROUND, creature.stepper.detector.points_within(start.positions, TOUCHING * body.height)
    else:
        normal, touching = creature.support.normal, creature.support.points
        plane = Plane(normal, -float((touching @ normal).min()))
    ground = GroundFrame.on_plane(plane, creature.front.direction, body.centre_of_mass(start.positions), up=up)
    return Stance(
        body,
        ground,
        start.positions,
        touching,
        solver_steps(body, step)[0],
        creature.solids,
        creature.geometry.friction,
        creature.limbs,
        style or Style(),
        creature.stepper.muscles,
        usual_view(creature.front, ground) @ ground.axes,
    )


def usual_view(front: Front, ground: GroundFrame) -> np.ndarray:
    """Return the unit vector (3,) to the camera of a film in ground axes, without regard to scenery that may hide the
    body.

    Its direction is ``FILMED_FROM`` or, if the estimate of the front is not clear, half-way between the front and its
    alternative.
    """
    ahead, left, up = np.array(FILMED_FROM) / np.linalg.norm(FILMED_FROM)
    if front.alternative is None:
        return np.array([ahead, left, up])
    x, y = ground.axes[:2] @ front.alternative
    between = float(np.arctan2(y, x))
    side = np.sign(left if np.isclose(abs(between), np.pi) else between)
    azimuth = side * min(0.5 * abs(between), _MAX_AZIMUTH)
    level = np.hypot(ahead, left)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
