"""World: several bodies, creatures and props, on a common ground or at their captured places in a scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from egs_warp.checked_calls import checked_constructor, checked_method
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.terrain import Solid, Surface, surface_above
from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.fem.body import BodyState
from egs_warp.fem.driven_step import PathDrive
from egs_warp.fem.joints import PointJoint
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.locomotion.body_support import MIN_UPWARD, StepperAmongBodies, ground_support
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.locomotion.world_stepper import WorldBody, WorldStepper
from egs_warp.motions.support import MIN_OVERHANG, overhang
from egs_warp.pipelines.body_overlap import boxes_overlap, column_below, depth, is_below, thin_part_note
from egs_warp.pipelines.captured_body import CapturedBody, Friction
from egs_warp.pipelines.creature import TOUCHING, Creature
from egs_warp.pipelines.friction_table import GROUND_MATERIAL, FrictionTable
from egs_warp.pipelines.joint import PlacedJoint, body_point, check_independent, place_text
from egs_warp.pipelines.prop import Prop
from egs_warp.pipelines.surroundings import Surroundings
from egs_warp.short_repr import short_repr

_MAX_OVERLAP = 0.005
"""Maximum depth by which bodies may overlap before they come to rest, in heights of the shorter body."""
_MAX_DEPTH = 0.01
"""Maximum depth to which a body may be inside an obstacle or the ground at the start, in body heights."""
_MAX_RAISE = 0.1
"""Maximum height by which a body is raised at the start so that it is not inside the ground or a body below it, in body
heights."""
_RAISE_TOLERANCE = 1e-4
"""Maximum depth in the ground, or in a body below, at which a body is not raised at the start, in body heights."""
_NEAR_GROUND = 0.02
"""Distance from a surface below within which a body comes to rest on it before the start, in body heights."""
_MAX_SETTLING_TILT = 15.0
"""Maximum angle, in degrees, by which a body may tilt while it comes to rest before the start."""
_MAX_SETTLING_SHIFT = 0.1
"""Maximum displacement of the centre of mass of a body that comes to rest before the start, in body heights."""
_BEARING = 0.003
"""Maximum distance, in body heights, from the surface below at which a point of a body at rest counts as carrying
weight. It is smaller than ``TOUCHING``, because a body that tips over a rounded edge is close to the surface beyond the
points that carry it."""
_MAX_POSITION = 1e4
"""Maximum absolute coordinate of a place, m."""
BodyKey = TypeVar("BodyKey", bound="PlacedBody | str")
"""Body of a world, or its name."""
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class PlacedBody:
    """A body of a world at its place, as returned by ``World.add``."""

    __repr__ = short_repr

    name: str
    """Name of the body, unique in its world."""
    body: Creature | Prop
    """The body at its place, at rest on the ground of the world."""
    friction: float
    """Coulomb coefficient of the body for pairs of materials that are not in the friction table of its world."""
    path: RigidPath | None = None
    """Path along which a prop is driven; None if forces move the body."""
    self_contact: bool = False
    """True if the parts of the body touch each other; False if they pass through each other."""
    material: str | None = None
    """Material of the body in the friction table of its world, or None."""


@checked_constructor
class World:
    """Bodies on a common ground, which is the plane z = 0 of the world or a height field, and solids. The z axis of the
    world points up.

    Add bodies with ``add`` and joints with ``add_joint``, then call ``simulate(world, {member: motion, ...})``. Lengths
    are in metres.
    """

    def __init__(
        self,
        *,
        solids: Sequence[Solid] = (),
        friction: Friction | None = None,
        frictions: Mapping[tuple[str, str], float] | None = None,
        ground: HeightField | None = None,
        surroundings: Surroundings | None = None,
    ) -> None:
        """Create a world without bodies.

        Args:
            solids: Steps, ramps and walls in addition to the ground, in the frame of the world.
            friction: Coulomb coefficient of the ground and between bodies; None keeps the coefficient of each body,
                and uses the geometric mean of two coefficients between bodies.
            frictions: Coulomb coefficients of pairs of materials, such as ``{("ice", "rubber"): 0.1}``, which replace
                ``friction`` for bodies of these materials. The material of the ground and the solids is ``ground``.
            ground: Uneven ground in the frame of the world, whose heights are measured along z; None uses the ground of
                the surroundings, or the plane z = 0.
            surroundings: What remains of a captured scene: background of the film, ground and obstacles.

        Raises:
            UserError: A friction is invalid, or the heights of the ground are not measured along z.
        """
        self.solids = tuple(solids)
        self.surroundings = surroundings
        if ground is None and surroundings is not None:
            ground = surroundings.ground
        if ground is not None and float(ground.normal @ GROUND.normal) < 1.0 - 1e-9:
            given = ",".join(f"{x:.3g}" for x in ground.normal)
            raise ArgumentError(
                "ground",
                "its heights are not measured along the z axis of the world; give a ground with the normal 0,0,1",
                value=given,
            )
        self.ground = ground
        self.friction = friction
        self._table = FrictionTable.of((frictions or {}).items())
        self._members: dict[str, PlacedBody] = {}
        self._joints: list[PlacedJoint] = []

    def __repr__(self) -> str:
        return f"World({', '.join(self._members) or 'empty'})"

    @property
    def members(self) -> tuple[PlacedBody, ...]:
        """The bodies in the order in which they were added."""
        return tuple(self._members.values())

    @checked_method
    def add(
        self,
        body: Creature | Prop,
        *,
        at: tuple[float, float] = (0.0, 0.0),
        above: float = 0.0,
        heading: float | None = None,
        name: str | None = None,
        path: RigidPath | None = None,
        as_captured: bool = False,
        self_contact: bool = False,
        material: str | None = None,
    ) -> PlacedBody:
        """Place a body on the ground, or where it was captured.

        Args:
            body: A creature or a prop on level ground without solids of its own. The same body may be added repeatedly.
            at: Position of the origin of the body's frame, m.
            above: Height above the ground or the solid below, m; above 0, the body falls.
            heading: Direction in which a creature faces, degrees counter-clockwise from the x axis of the world, seen
                from above. A prop is turned by this angle. None keeps the orientation in the body's own frame.
            name: Name for messages and files; None numbers the bodies: ``creature-1``, ``prop-2``.
            path: Path that a prop, such as a lift, follows from its place, whatever pushes it. The prop passes through
                the ground and the solids of the world, but it carries and pushes other bodies.
            as_captured: True to place the body where it is in the scene of the surroundings, to whose capture it
                belongs; ``at``, ``above`` and ``heading`` do not apply. It is raised slightly if it is inside the
                ground or a body below it.
            self_contact: True if the parts of a creature, such as its arms and its trunk, touch each other. If False,
                they pass through each other, and each step takes less time.
            material: Material of the body in the ``frictions`` of the world.

        Returns:
            The placed body, its key in the arguments of ``simulate`` and in the result.

        Raises:
            UserError: The name or the position is invalid, the name is taken, no friction is given for the material,
                the body is on a GPU, the ground of the body is not a level plane, the body overlaps a solid or another
                body, it falls over at this place, a creature has a path, or a prop has self contact.
        """
        kind = "prop" if isinstance(body, Prop) else "creature"
        name = f"{kind}-{len(self._members) + 1}" if name is None else name
        self._check_name(name)
        self._table.check(name, material)
        if path is not None and isinstance(body, Creature):
            raise UserError(f"{name}: it is a creature, which moves with its muscles; give a path to props only")
        if self_contact and isinstance(body, Prop):
            raise UserError(f"{name}: it is a prop, which does not bend; give self_contact to creatures only")
        numbers = [*at, above, heading or 0.0]
        # The condition is not "any above the maximum", because NaN must be rejected, too.
        if not np.abs(numbers).max() <= _MAX_POSITION or above < 0.0:
            given = f"at {at[0]:g}, {at[1]:g}, above {above:g}, heading {heading or 0.0:g}"
            raise UserError(
                f"{name}: {given}: give finite numbers of magnitude at most {_MAX_POSITION:g}, and above of at least 0"
            )
        device = body.body.assembly.device
        if not device.is_cpu:
            raise UserError(
                f"{name}: it is on {device.alias}; worlds are simulated on a CPU, so load its capture there"
            )
        geometry, gravity = body.geometry, body.body.gravity
        is_uneven = geometry.field is not None and self.ground is None
        if is_uneven or len(geometry.planes) > 1 or np.abs(gravity[:2]).max() > 0.0:
            raise UserError(f"{name}: its ground is not a level plane; make it without ground, gravity_up and solids")
        friction = geometry.friction if self.friction is None else self.friction
        on_ground = self._table.between(material, GROUND_MATERIAL)
        on_ground = friction if on_ground is None else on_ground
        if on_ground != geometry.friction:
            body = body.with_friction(on_ground)
        surfaces = self.surfaces
        if as_captured:
            placed = self._as_captured(name, body)
        else:
            lift = surface_above(surfaces, np.array([*at, 0.0]), GROUND.normal)
            captured_heading = _heading_of(body) if isinstance(body, Creature) else 0.0
            placed = body.moved((*at, lift + above), 0.0 if heading is None else heading - captured_heading)
        placed = replace(placed, stepper=self._own_stepper(placed), solids=surfaces, support=None)
        member = PlacedBody(name, placed, friction, path, self_contact, material)
        if as_captured or (above == 0.0 and path is None):
            member = self._raised(member, above_bodies=as_captured)
        for other in self._members.values():
            check_apart(other, member)
        if path is None:
            member = self._resting(member, falls=above > 0.0)
        self._check_place(member)
        self._members[name] = member
        return member

    @checked_method
    def add_joint(
        self, body: PlacedBody | str, *, at: Sequence[float], to: PlacedBody | str | None = None
    ) -> PlacedJoint:
        """Tie a point of a body to its place, or to the point of another body at the same place.

        The bodies turn freely about the point. Two joints make a hinge about the line through their points, such as
        that of a door. Bodies with a common joint do not touch each other.

        Args:
            body: A body of this world, or its name.
            at: (3,) Place of the points in the world at the start, m: inside each body, or outside it by at most 0.05
                of its height.
            to: The other body; None ties the point to the world.

        Raises:
            UserError: A body is not in the world, the place is outside a body, the place is not finite, no body of the
                joint can move, or earlier joints hold the point already.
        """
        given = [body] if to is None else [body, to]
        try:
            place = np.asarray(at, float)
        except (TypeError, ValueError):
            place = np.empty(0)
        if place.shape != (3,) or not np.abs(place).max() <= _MAX_POSITION:
            raise ArgumentError(
                "at", f"give three numbers of magnitude at most {_MAX_POSITION:g}, in metres", value=str(at)
            )
        names = [next(iter(self.by_name({each: None}, "joint"))) for each in given]
        if len(names) == 2 and names[0] == names[1]:
            raise UserError(f"joint at {place_text(place)}: both bodies are {names[0]}; give another body")
        if all(self._members[name].path is not None for name in names):
            raise UserError(
                f"joint at {place_text(place)}: {' and '.join(names)} follow{'s' * (len(names) == 1)} a path, so the"
                " joint moves nothing; leave it out"
            )
        members = self.members
        numbers = [members.index(self._members[name]) for name in names]
        points = [body_point(members[number].name, members[number].body, number, place) for number in numbers]
        joint = PointJoint(tuple(points), place)
        joints = [*(each.point_joint for each in self._joints), joint]
        check_independent(joints, [each.body for each in members], [each.path is not None for each in members])
        self._joints.append(PlacedJoint(tuple(names), joint))
        return self._joints[-1]

    @property
    def joints(self) -> tuple[PlacedJoint, ...]:
        """The joints in the order in which they were added."""
        return tuple(self._joints)

    @property
    def obstacles(self) -> tuple[Solid, ...]:
        """All solids: those of the world, and those of its surroundings."""
        return (*self.solids, *(self.surroundings.solids if self.surroundings is not None else ()))

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """The ground and all solids."""
        return (self.ground or Solid((GROUND,)), *self.obstacles)

    def member(self, name: str) -> PlacedBody:
        """Return the body ``name``."""
        return self._members[name]

    def by_name(self, values: Mapping[BodyKey, Value], what: str) -> dict[str, Value]:
        """Return ``values`` with the names of the bodies as keys.

        Raises ``UserError`` for a body that is not in the world; the message refers to the values as ``what``.
        """
        named: dict[str, Value] = {}
        for key, value in values.items():
            name = key if isinstance(key, str) else key.name
            if name not in self._members or (not isinstance(key, str) and self._members[name] is not key):
                raise unknown_body(what, name, self._members)
            named[name] = value
        return named

    def stepper(self) -> WorldStepper:
        """Return the stepper of all bodies. The first call for a body computes its level set, which takes seconds."""
        joints = [joint.point_joint for joint in self._joints]
        return WorldStepper([_world_body(each) for each in self.members], frictions=self.frictions, joints=joints)

    @property
    def frictions(self) -> np.ndarray:
        """(k, k) Coulomb coefficients between the bodies."""
        return self._frictions_between(self.members)

    @property
    def unused_frictions(self) -> tuple[str, ...]:
        """Notes about the materials and the pairs of ``frictions`` of which the world has no bodies."""
        return self._table.unused_notes([(each.material, each.self_contact) for each in self.members])

    @property
    def thin_parts(self) -> tuple[str, ...]:
        """Notes about bodies with parts that are too thin for contact with others, if there are others; one note for
        all copies of a body."""
        first = {id(each.body.shape): each for each in reversed(self.members) if len(self.members) > 1}
        found = [thin_part_note(each.name, each.body) for each in reversed(first.values())]
        return tuple(note for note in found if note is not None)

    def _frictions_between(self, members: Sequence[PlacedBody]) -> np.ndarray:
        return self._table.matrix([each.material for each in members], [each.friction for each in members])

    def _check_name(self, name: str) -> None:
        if not name or not all(letter.isalnum() or letter in "-_" for letter in name):
            raise ArgumentError(
                "name", "give letters, digits, - and _; it becomes the name of a folder", value=repr(name)
            )
        if name in self._members:
            raise ArgumentError("name", "another body of the world has this name; choose another one", value=repr(name))

    def _own_stepper(self, body: CapturedBody) -> LocomotionStepper:
        """Return a stepper of ``body`` on the ground of the world. No two bodies share a stepper, because each stepper
        has buffers of its own."""
        old = body.stepper
        solids = self.obstacles
        if solids or self.ground is not None:
            geometry = replace(
                old.geometry,
                planes=(GROUND, *(face for solid in solids for face in solid.faces)),
                solid_from_plane=(0, *(index for index, solid in enumerate(solids, 1) for _ in solid.faces)),
                field=self.ground,
            )
            device = str(old.body.assembly.device)
            return LocomotionStepper(deepcopy(old.body), old.muscles, geometry, settings=old.settings, device=device)
        is_taken = any(member.body.stepper is old for member in self._members.values())
        return deepcopy(old) if is_taken else old

    def _as_captured(self, name: str, body: Creature | Prop) -> Creature | Prop:
        """Return ``body`` moved to the place at which it was captured."""
        if self.surroundings is None:
            raise ArgumentError("as_captured", "the world has no surroundings; give a place", value="True")
        frame, own = self.surroundings.frame, body.frame
        turn = frame.axes @ own.axes.T
        if abs(own.scale / frame.scale - 1.0) > 1e-6 or turn[2, 2] < 1.0 - 1e-9:
            raise UserError(
                f"{name}: its scale and up direction differ from those of the surroundings; make it with the same ones"
            )
        return body.moved(
            tuple(frame.points(own.origin).tolist()), float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
        )

    def _raised(self, member: PlacedBody, *, above_bodies: bool) -> PlacedBody:
        """Return the body, raised out of the ground and the solids below it, and also out of the bodies below it."""
        body, height = member.body, member.body.body.height
        faces_up = np.array([plane.normal[2] > MIN_UPWARD for plane in body.geometry.planes])
        detector: ContactDetector = body.stepper.detector
        raised = 0.0
        while raised < _MAX_RAISE * height:
            gaps, faces = detector.gaps(body.start.positions)
            lift = -float(gaps[faces_up[faces]].min(initial=0.0))
            others = self._members.values() if above_bodies else ()
            below = [other.body for other in others if is_below(other.body, body)]
            lift = max([lift, *(max(depth(body, other), depth(other, body)) for other in below)])
            if lift <= _RAISE_TOLERANCE * height:
                break
            raised += lift
            body = replace(body, start=_lifted(body, lift))
        return replace(member, body=body)

    def _resting(self, member: PlacedBody, *, falls: bool) -> PlacedBody:
        """Return the body at rest on other bodies, on solids or on uneven ground, while the other bodies do not move. A
        body that touches only the plane z = 0, on which it was made, is returned as it is, and so is one that ``falls``
        and touches no body below.

        Raises ``UserError`` if the body falls over, or if the centre of mass of a creature is outside its support. A
        prop on other bodies or on solids starts where it is and falls.
        """
        body, near = member.body, _NEAR_GROUND * member.body.body.height
        others = [other for other in self._members.values() if boxes_overlap(body, other.body, near)]
        stepper, find_support = body.stepper, partial(ground_support, body.stepper)
        if others:
            states = [other.body.start for other in others]
            own, *rest = (_world_body(each) for each in (member, *others))
            stepper = StepperAmongBodies(own, rest, states, self._frictions_between((member, *others)))
            find_support = stepper.support
        faces = find_support(body.start, near).faces
        on_bodies, on_solids = bool((faces < 0).any()), bool((faces > 0).any())
        is_uneven = len(faces) > 0 and (self.ground is not None or on_solids)
        if not on_bodies and (falls or not is_uneven):
            return member
        state = settle(stepper, body.start.positions)
        before, after = (body.body.best_fit_rotation(each.positions) for each in (body.start, state))
        tilt = float(np.degrees(np.arccos(np.clip((after @ before.T)[2, 2], -1.0, 1.0))))
        shift = body.body.centre_of_mass(state.positions) - body.body.centre_of_mass(body.start.positions)
        bearing = find_support(state, _BEARING * body.body.height).points
        outside = overhang(bearing[:, :2], body.body.centre_of_mass(state.positions)[:2])
        has_fallen = tilt > _MAX_SETTLING_TILT or np.linalg.norm(shift) > _MAX_SETTLING_SHIFT * body.body.height
        reason = None
        if has_fallen or np.isinf(outside):
            reason = "it has too little support there" if on_bodies or on_solids else "the ground is too uneven there"
        elif outside > MIN_OVERHANG * body.body.height and (on_bodies or isinstance(body, Creature)):
            # A prop on the ground may lean on a wall.
            reason = f"its centre of mass is {outside:.2g} m outside its support"
        if reason is not None:
            if (on_bodies or on_solids) and isinstance(body, Prop):
                return member
            raise UserError(f"{member.name}: it falls over at {_where(member)}, because {reason}; choose another place")
        support = find_support(state, TOUCHING * body.body.height)
        tops = []
        for index in np.unique(support.faces[support.faces < 0]):
            height = float(support.points[support.faces == index, 2].mean())
            # The body itself has the index 0.
            tops.append(column_below(others[-2 - index].body, height, TOUCHING * body.body.height))
        return replace(member, body=replace(body, start=state, support=support, solids=(*body.solids, *tops)))

    def _check_place(self, member: PlacedBody) -> None:
        """Raise ``UserError`` if a body is inside a solid of the world or the ground."""
        body = member.body
        detector: ContactDetector = body.stepper.detector
        gaps, faces = detector.gaps(body.start.positions)
        deepest = int(np.argmin(gaps))
        if gaps[deepest] < -_MAX_DEPTH * body.body.height:
            solid = int(body.geometry.solid_of_each_plane[faces[deepest]])
            what = f"solid {solid}" if solid else "the ground"
            raise UserError(
                f"{member.name}: it is {-gaps[deepest]:.2g} m inside {what} at {_where(member)}; move one of them"
            )


def unknown_body(what: str, name: str, names: Iterable[str]) -> UserError:
    """Return the error for a body ``name`` that is not one of ``names``; the message refers to its value as
    ``what``."""
    names = [*names]
    return UserError(
        f"{what} of {name!r}: the world has no such body{did_you_mean(name, names)}; give one of {', '.join(names)}"
    )


def _world_body(member: PlacedBody) -> WorldBody:
    """Return the body for the stepper of the world."""
    body, path = member.body, member.path
    drive = None if path is None else PathDrive(path, body.start.positions)
    return WorldBody(body.stepper, body.shape.level_set, body.mesh.nodes, drive, member.self_contact)


def _lifted(body: CapturedBody, height: float) -> BodyState:
    """Return the start state of ``body``, raised by ``height`` metres."""
    return replace(body.start, positions=body.start.positions + height * GROUND.normal)


def check_apart(first: PlacedBody, second: PlacedBody) -> None:
    """Raise ``UserError`` if two bodies overlap at the start: a contact point of one is inside the level set of the
    other."""
    deepest = max(depth(first.body, second.body), depth(second.body, first.body))
    if deepest > _MAX_OVERLAP * min(first.body.body.height, second.body.body.height):
        raise UserError(
            f"{second.name} at {_where(second)} overlaps {first.name} at {_where(first)} by {deepest:.2g} m; move one"
            " of them"
        )


def _heading_of(creature: Creature) -> float:
    """Return the direction in which the creature faces, degrees counter-clockwise from the x axis."""
    x, y, _ = creature.front.direction
    return float(np.degrees(np.arctan2(y, x)))


def _where(member: PlacedBody) -> str:
    # Adding zero turns -0 into 0.
    x, y, _ = np.round(member.body.body.centre_of_mass(member.body.start.positions), 2) + 0.0
    return f"({x:.2f}, {y:.2f})"
