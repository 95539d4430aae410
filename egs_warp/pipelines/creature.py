"""A capture with a body, muscles and a ground: what a motion moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.contact.detection import ContactGeometry, contact_geometry
from egs_warp.contact.terrain import Solid, Surface
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError
from egs_warp.fem.body import DEFAULT_SAG, BodyState, SoftBody, make_body
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from egs_warp.locomotion.rollout import settle, solver_steps
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.meshing.body_gaussians import body_gaussians, centred, find_body_frame
from egs_warp.meshing.cage import Cage, cage_of_body
from egs_warp.meshing.occupancy import solid_from_gaussians
from egs_warp.motions.feet import SupportKind, support_kind_of
from egs_warp.motions.limbs import Limbs, Sections, find_limbs
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import GroundFrame
from egs_warp.motions.style import Style
from egs_warp.muscles.files import read_muscles
from egs_warp.muscles.muscle_set import MuscleSet, automatic_muscles
from egs_warp.pipelines.facing_direction import Front, find_front
from egs_warp.segmentation.base_plane import find_base_plane

SMALLEST_SAG = 0.004
"""A body is not made stiffer than this column's sag, whatever it bends."""
STEEPEST_SLOPE = 45.0
"""Degrees: nothing stands on a steeper one."""
_GROUND_SPACING = 0.5
"""Edges of the cage between the nodes of uneven ground: points of contact are 0.4 apart."""
_CAGE_BITS = 32
"""Of the height, that the coordinates of the cage keep."""
_CONTACT_GRID = 2.0**-10
"""Of the height: what points of contact are rounded to. A jump makes much of the last bit of a number, and a file's
numbers change by theirs when the capture is turned or its unit is another one.
"""
_FRONT_GRID = np.pi / 2**12
"""Radians, what the front is rounded to, likewise."""
_FOOT = 0.1
"""Of the height over uneven ground: what is lower may stand on it."""


@dataclass(frozen=True)
class Creature:
    """A capture with a cage, a body, muscles and a ground, standing; metres, all in the body's own frame."""

    frame: BodyFrame
    """Of the body, in the capture."""
    cloud: GaussianCloud
    """The capture, in the order of its own."""
    front: Front
    """Which way it faces, and moves."""
    limbs: Limbs
    """On which it stands."""
    cage: Cage
    stepper: LocomotionStepper
    """Body, muscles and contact."""
    start: BodyState
    """At rest on the ground."""
    solids: tuple[Surface, ...]
    """All that there is to stand on, the ground first."""

    def placed(self, cloud: GaussianCloud) -> GaussianCloud:
        """Something else of the same capture, such as what is behind it, in the frame of the body."""
        return to_body_frame(cloud, self.frame)

    def with_friction(self, friction: float) -> Creature:
        """The same body on ground of another Coulomb coefficient, standing anew. Raises ``ArgumentError`` for one below
        0."""
        old = self.stepper
        geometry, device = replace(old.geometry, friction=checked_friction(friction)), str(old.body.assembly.device)
        stepper = LocomotionStepper(old.body, old.muscles, geometry, settings=old.settings, device=device)
        return replace(self, stepper=stepper, start=settle(stepper))

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
    ground: HeightField | None = None,
    solids: tuple[Solid, ...] = (),
    gravity_up: np.ndarray | None = None,
    front: np.ndarray | None = None,
    seen_from: np.ndarray | None = None,
    settings: LocomotionSettings | None = None,
    nodes: int = 500,
    progress: Callable[[str], object] = lambda stage: None,
) -> Creature:
    """Give a capture (scene units) a body that stands on ``plane``, or on its own base, square to ``up`` (3,), or on
    ``ground`` that is not flat.

    All that is given is in the capture's frame and units; what is made is in the body's, so nothing hangs on how the
    file lies. ``muscles_file``: see ``body_muscles``. ``solids`` are steps and walls beside the ground; ``gravity_up``
    (3,) is against gravity if the ground is a slope. ``front`` (3,) is the way it faces and moves; else it is found
    (``find_front``), with ``seen_from`` (3,), the mean of the unit vectors to the cameras of its photos, if these are
    known. ``settings`` of its stepper choose the strategy for the contact
    states and the QP solver. The body is as stiff as makes it sag by ``sag`` of its height; one that its weight would
    bend out of shape is made stiffer. ``nodes``: of its cage, about. ``progress`` is told the name of each stage.
    """
    if ground is not None:
        plane = plane_below(cloud, ground)
    normal = plane.normal if plane is not None else up
    if normal is None:
        advice = "neither the ground nor which way is up is known; give one of them"
        raise ArgumentError("plane", advice, check=("plane", "up"))
    if gravity_up is not None:
        _check_slope(normal / np.linalg.norm(normal), gravity_up)
    if front is not None:
        check_front(normal if gravity_up is None else gravity_up, front)
    progress("cage")
    standing = place_cage(cloud, up=up, plane=plane, metres_per_unit=metres_per_unit, nodes=nodes)
    progress("contact")
    device, frame, cage = str(cloud.device), standing.frame, standing.cage
    solids = tuple(Solid(tuple(frame.plane(face) for face in solid.faces)) for solid in solids)
    field = None
    if ground is not None:
        # A cage gives way to nothing finer than it is itself.
        field = frame.height_field(ground).coarser(_GROUND_SPACING * mean_edge_length(cage.mesh))
    geometry = contact_geometry(
        standing.gaussians,
        cage.mesh,
        (GROUND,),
        field=field,
        solids=solids,
        friction=friction,
        grid=_CONTACT_GRID * cage.height(GROUND),
        device=device,
    )
    against_gravity = None if gravity_up is None else frame.axes @ gravity_up
    progress("front")
    faces = choose_front(standing, front, seen_from=seen_from)
    while True:
        progress("body and muscles")
        body = make_body(cage.mesh, GROUND, up=against_gravity, sag=sag, device=device)
        muscles = body_muscles(body, muscles_file, frame)
        stepper = LocomotionStepper(body, muscles, geometry, settings=settings, device=device)
        progress("stand")
        start = settle(stepper)
        if sag < SMALLEST_SAG or _stands(stepper, start):
            everything = (field or Solid((GROUND,)), *solids)
            placed = to_body_frame(cloud, frame)
            return Creature(frame, placed, faces, standing.limbs, cage, stepper, start, everything)
        sag *= 0.5


def plane_below(cloud: GaussianCloud, ground: HeightField) -> Plane:
    """The plane that ``ground`` tells its heights from, moved up or down to the lowest place under the object's
    foot.
    """
    means = cloud.means.numpy()[cloud.opacities() > 0.3].astype(np.float64)
    heights = ground.heights(means)
    if len(means) == 0 or not (heights > 0.0).any():
        raise ArgumentError("ground", "nothing of the object lies above it; check the plane", check=("plane",))
    low = means[(heights > 0.0) & (heights < _FOOT * float(np.quantile(heights, 0.99)))]
    lift = float(ground.ground_height(low).min()) if len(low) else 0.0
    return Plane(ground.normal, ground.plane.offset - lift)


def changed_creature(creature: Creature, *, friction: float, sag: float, muscles_file: Path | None) -> Creature:
    """``creature`` with another friction and another stiffness, by its ``sag`` (``make_body``); cage and ground stay.

    Muscles change with the stiffness; it is made to stand anew.
    """
    device = str(creature.cloud.device)
    body, geometry = creature.body, replace(creature.geometry, friction=friction)
    up = -body.gravity / np.linalg.norm(body.gravity)
    made = make_body(creature.cage.mesh, GROUND, up=up, sag=sag, device=device)
    muscles = body_muscles(made, muscles_file, creature.frame)
    stepper = LocomotionStepper(made, muscles, geometry, settings=creature.stepper.settings, device=device)
    return replace(creature, stepper=stepper, start=settle(stepper))


@dataclass(frozen=True)
class PlacedCage:
    """A capture's cage, in metres and in the frame of the body."""

    frame: BodyFrame
    """Of the body, in the capture."""
    gaussians: GaussianCloud
    """What the mechanics sees of the capture (``body_gaussians``)."""
    cage: Cage
    limbs: Limbs
    """On which it stands, found where the capture shows them."""


def place_cage(
    cloud: GaussianCloud,
    *,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    metres_per_unit: float | None = None,
    nodes: int = 500,
) -> PlacedCage:
    """Find the body's own frame on ``plane``, or on its base square to ``up`` (3,), and make its cage there.

    Without ``metres_per_unit`` the body is 1 m tall. The cage has about so many ``nodes``.
    """
    near, anchor = centred(cloud)
    if plane is None:
        assert up is not None, "make_creature asks for one of both"
        plane = find_base_plane(near, up)
    else:
        plane = plane.moved(-anchor)
    frame = find_body_frame(near, plane)
    gaussians = body_gaussians(near, frame)
    solid = solid_from_gaussians(gaussians)
    cage = cage_of_body(gaussians, target_nodes=nodes, solid=solid)
    metres = 1.0 / cage.height(GROUND) if metres_per_unit is None else metres_per_unit / frame.scale
    cage = _rounded(cage.scaled(metres))
    limbs = find_limbs(Sections.of_solid(solid.scaled(metres), cage.mesh), cage.mesh.nodes)
    return PlacedCage(frame.moved(anchor).scaled(metres), gaussians.scaled(metres), cage, limbs)


def _rounded(cage: Cage) -> Cage:
    """Without the last bits of its coordinates, which hang on how large the capture's unit is."""
    step = 2.0 ** (np.rint(np.log2(cage.height(GROUND))) - _CAGE_BITS)
    return replace(cage, mesh=TetMesh(step * np.rint(cage.mesh.nodes / step), cage.mesh.tets))


def choose_front(
    standing: PlacedCage, front: np.ndarray | None = None, *, seen_from: np.ndarray | None = None
) -> Front:
    """Which way it faces: ``front`` (3,) if that is given, else as ``find_front`` finds; ``front`` and ``seen_from`` as
    in ``make_creature``."""
    axes = standing.frame.axes
    if front is None:
        seen = None if seen_from is None else axes @ seen_from
        mesh = standing.cage.mesh
        lies = support_kind_of(mesh, mesh.nodes[:, 2], standing.limbs.count) is SupportKind.LYING
        found = find_front(standing.gaussians, mesh, seen_from=seen, lengthwise=lies)
        angle = _FRONT_GRID * np.rint(np.arctan2(found.direction[1], found.direction[0]) / _FRONT_GRID)
        return replace(found, direction=np.array([np.cos(angle), np.sin(angle), 0.0]))
    x, y, _ = axes @ front
    return Front(np.array([x, y, 0.0]) / np.hypot(x, y), None)


def check_front(up: np.ndarray, front: np.ndarray) -> None:
    """Raises ``ArgumentError`` where ``front`` (3,) points along ``up`` (3,)."""
    if np.linalg.norm(np.cross(front, up)) < 1e-3 * np.linalg.norm(front) * np.linalg.norm(up):
        given = ",".join(f"{x:g}" for x in front)
        raise ArgumentError("front", "points up or down; give a way along the ground", value=given)


def _check_slope(normal: np.ndarray, up: np.ndarray) -> None:
    slope = float(np.degrees(np.arccos(np.clip(normal @ up / np.linalg.norm(up), -1.0, 1.0))))
    if slope > STEEPEST_SLOPE:
        raise ArgumentError(
            "gravity_up",
            f"that makes the ground a slope of {slope:.0f} degrees; give a direction at most {STEEPEST_SLOPE:g} degrees"
            f" from the ground's normal {','.join(f'{x:.3g}' for x in normal)}",
            value=",".join(f"{x:g}" for x in up),
        )


def body_muscles(body: SoftBody, file: Path | None, frame: BodyFrame) -> MuscleSet:
    """The muscles that ``file`` (JSON, ``egs_warp.muscles.files``) gives a body in its ``frame``; without one,
    automatic ones.
    """
    if file is not None:
        return read_muscles(file, body.mesh, body_weight=body.weight, frame=frame)
    return automatic_muscles(
        body.mesh,
        GROUND.normal,
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


def checked_friction(friction: float) -> float:
    """A Coulomb coefficient. Raises ``ArgumentError`` for one below 0."""
    if not 0.0 <= friction < np.inf:
        raise ArgumentError("friction", "give a Coulomb coefficient of at least 0", value=friction)
    return friction


def initial_stance(creature: Creature, *, step: float | None = None, style: Style | None = None) -> Stance:
    """Where the creature stands at the start, its front ahead.

    ``step``: seconds that a solver step takes at most, see ``solver_steps``; ``style``: how it jumps.
    """
    body, start = creature.body, creature.start
    up = -body.gravity / np.linalg.norm(body.gravity)
    return Stance(
        body,
        GroundFrame.on_plane(GROUND, creature.front.direction, body.centre_of_mass(start.positions), up=up),
        start.positions,
        creature.stepper.detector.points_within(start.positions, 0.01 * body.height),
        solver_steps(body, step)[0],
        creature.solids,
        creature.geometry.friction,
        creature.limbs,
        style or Style(),
    )
