"""A world from one captured scene: the objects of the scene become creatures and props at their captured places."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import Direction, orthonormal_basis
from egs_warp.geometry.plane import Plane
from egs_warp.notes import prefixed
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.facing_direction import mean_view
from egs_warp.pipelines.prepare_objects import PreparedObjects
from egs_warp.pipelines.prop import Footprint, Prop, make_prop
from egs_warp.pipelines.scene_obstacles import SceneObstacles, measure_obstacles
from egs_warp.pipelines.surroundings import Surroundings
from egs_warp.pipelines.world import World
from egs_warp.segmentation.object_mask import FOOTPRINT_HEIGHT
from egs_warp.short_repr import short_repr

_TOP = 0.995
"""Quantile of the heights of the Gaussians that defines the height of an object."""
_MIN_RISE, _ABOVE = 0.05, 0.1
"""Limits of the height of an object's base above the base of the object on which it stands, relative to the height of
the latter: the minimum, and the maximum minus 1."""
_MIN_DISTANCE = 0.05
"""Minimum distance between the first and the last object, relative to their size, for the x axis of the world to point
from one to the other."""


@dataclass(frozen=True)
class SceneBody:
    """Properties of the body into which an object of a scene is made."""

    is_prop: bool = False
    """True to make the object a prop: a stiff body without muscles."""
    front: Direction | None = None
    """(3,) Direction in which a creature faces, in the capture; None estimates it."""
    nodes: int | None = None
    """Number of cage nodes of a creature; None uses the default."""
    density: float | None = None
    """Density of a prop, kg/m^3; None uses the default."""
    self_contact: bool = False
    """True if the parts of a creature touch each other (``World.add``)."""
    material: str | None = None
    """Material of the body in the friction table."""


@dataclass(frozen=True)
class SceneWorldOptions:
    """Options of ``make_scene_world``."""

    metres_per_unit: float | None = None
    """Length of one unit of the capture, m; None makes the tallest object 1 m tall."""
    friction: float | None = None
    """Coulomb coefficient of the ground and between bodies; None uses the default."""
    frictions: Mapping[tuple[str, str], float] | None = None
    """Coulomb coefficients of pairs of materials (``World``), or None."""
    solids: tuple[Solid, ...] | None = None
    """Obstacles beside and above the ground, in the frame and units of the capture; None measures them."""
    measures_obstacles: bool = True
    """True to measure the edge of the ground and the obstacles. If False, the ground has no edge, and only ``solids``
    are obstacles."""


@dataclass(frozen=True)
class SceneWorld:
    """A world made from the objects of one scene."""

    __repr__ = short_repr

    world: World
    """The world, with a body for each object."""
    obstacles: SceneObstacles
    """Ground and obstacles that the bodies can touch."""
    notes: tuple[str, ...] = field(default=())
    """Notes for the user."""

    @property
    def surroundings(self) -> Surroundings:
        """The surroundings of the world."""
        assert self.world.surroundings is not None
        return self.world.surroundings


def make_scene_world(
    prepared: PreparedObjects,
    bodies: Mapping[str, SceneBody],
    *,
    cameras: Sequence[Camera] = (),
    options: SceneWorldOptions | None = None,
    solids: Sequence[Solid] = (),
    progress: Callable[[str], object] = lambda name: None,
    show_obstacles: Callable[[SceneObstacles, Surroundings], object] = lambda obstacles, surroundings: None,
) -> SceneWorld:
    """Create a world in which the objects of a scene are bodies at their captured places.

    The z axis of the world is the normal of the planes under the objects, and the ground is that of the lowest object.
    The origin is below the middle of the objects. The x axis points from the first to the last object, if they are
    apart.

    Args:
        prepared: The objects and the remaining scene (``prepare_objects``).
        bodies: Properties of the body of each object.
        cameras: Cameras of the capture, if known, for the estimate of facing directions and the view of the film.
        options: Scale, friction and obstacles; None uses the default.
        solids: Further obstacles in the frame of the world, m.
        progress: Called with the name of each body before it is created.
        show_obstacles: Called with the obstacles before the bodies are created.

    Raises:
        UserError: A body cannot be created or placed; the message begins with its name.
    """
    options = options or SceneWorldOptions()
    frame = world_frame(prepared, options.metres_per_unit)
    heights = {name: frame.scale * _height(prepared, name) for name in prepared.scenes}
    obstacles = measure_obstacles(
        prepared,
        frame,
        height=max(heights.values()),
        solids=options.solids,
        is_measured=options.measures_obstacles,
    )
    surroundings = Surroundings(
        frame,
        to_body_frame(prepared.background, frame),
        obstacles.ground,
        obstacles.solids,
        _views(prepared, frame, cameras),
    )
    show_obstacles(obstacles, surroundings)
    world = World(solids=solids, friction=options.friction, frictions=options.frictions, surroundings=surroundings)
    notes = [*prepared.notes, *obstacles.notes]
    made: dict[str, Creature | Prop] = {}
    for name, scene in prepared.scenes.items():
        progress(name)
        try:
            seen_from = mean_view(cameras, scene.located.centre)
            made[name] = _make_body(prepared, name, bodies[name], frame.scale, seen_from)
        except UserError as error:
            raise UserError(f"{name}: {error}") from error
        notes += [prefixed(name, note) for note in made[name].notes]
    # Add the lowest body first: a body that stands on another one is raised if the two overlap.
    for name in sorted(made, key=lambda name: -prepared.planes[name].offset):
        body = bodies[name]
        world.add(made[name], name=name, as_captured=True, self_contact=body.self_contact, material=body.material)
    return SceneWorld(world, obstacles, tuple(notes))


def world_frame(prepared: PreparedObjects, metres_per_unit: float | None = None) -> BodyFrame:
    """Return the frame of the world of a scene; see ``make_scene_world``."""
    plane = prepared.lowest_plane
    centres = np.array([scene.located.centre for scene in prepared.scenes.values()])
    size = max(scene.located.size for scene in prepared.scenes.values())
    across = centres[-1] - centres[0]
    across -= (across @ plane.normal) * plane.normal
    if np.linalg.norm(across) < _MIN_DISTANCE * size:
        across = orthonormal_basis(plane.normal)[0]
    x = across / np.linalg.norm(across)
    middle = centres.mean(axis=0)
    origin = middle - float(plane.heights(middle)) * plane.normal
    scale = metres_per_unit or 1.0 / max(_height(prepared, name) for name in prepared.scenes)
    return BodyFrame(np.stack([x, np.cross(plane.normal, x), plane.normal]), origin, scale)


def _height(prepared: PreparedObjects, name: str) -> float:
    """Return the height of an object above its plane, scene units."""
    heights = prepared.planes[name].heights(prepared.scenes[name].object.means.numpy().astype(np.float64))
    return float(np.quantile(heights, _TOP))


def _make_body(
    prepared: PreparedObjects, name: str, body: SceneBody, metres_per_unit: float, seen_from: np.ndarray | None
) -> Creature | Prop:
    cloud, plane = prepared.scenes[name].object, _plane_of(prepared, name)
    if body.is_prop:
        density: dict[str, Any] = {} if body.density is None else {"density": body.density}
        footprints = _footprints_on(prepared, name)
        return make_prop(cloud, plane=plane, metres_per_unit=metres_per_unit, footprints=footprints, **density)
    options = CreatureOptions(metres_per_unit=metres_per_unit, front=body.front, seen_from=seen_from)
    options = options if body.nodes is None else replace(options, nodes=body.nodes)
    return make_creature(cloud, plane=plane, options=options)


def _footprints_on(prepared: PreparedObjects, name: str) -> list[Footprint]:
    """Return the places on an object where other objects stand, except where the surface was measured as uneven."""
    plane = prepared.planes[name]
    axes = np.stack([*plane.tangents(), plane.normal])
    local = prepared.scenes[name].object.means.numpy().astype(np.float64) @ axes.T
    low, high = np.quantile(local, [1.0 - _TOP, _TOP], axis=0)
    footprints = []
    for other, scene in prepared.scenes.items():
        base, centre = prepared.planes[other], scene.located.centre
        foot = axes @ (centre - float(base.heights(centre)) * base.normal)
        is_over = (foot[:2] > low[:2]).all() and (foot[:2] < high[:2]).all()
        rise, height = plane.offset - base.offset, high[2] + plane.offset
        if other != name and scene.ground is None and is_over and _MIN_RISE * height < rise < (1.0 + _ABOVE) * height:
            means = scene.object.means.numpy().astype(np.float64)
            footprints.append(Footprint(base, means[base.heights(means) < FOOTPRINT_HEIGHT * scene.located.size]))
    return footprints


def _plane_of(prepared: PreparedObjects, name: str) -> Plane:
    """Return the level plane on which the body of an object is created: on uneven ground, this is the plane at the
    height of the lowest ground below the object."""
    from egs_warp.pipelines.placed_cage import plane_below

    plane, scene = prepared.planes[name], prepared.scenes[name]
    if scene.ground is None:
        return plane
    below = plane_below(scene.object, scene.ground)
    foot = scene.located.centre - float(below.heights(scene.located.centre)) * below.normal
    return Plane(plane.normal, -float(plane.normal @ foot))


def _views(prepared: PreparedObjects, frame: BodyFrame, cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the directions (n, 3) from the middle of the objects to the cameras above the ground."""
    middle = np.mean([scene.located.centre for scene in prepared.scenes.values()], axis=0)
    arms = [camera.centre - middle for camera in cameras if prepared.lowest_plane.heights(camera.centre) > 0.0]
    return np.array(arms) @ frame.axes.T if arms else None
