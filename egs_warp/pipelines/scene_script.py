"""Creation of a world from the scene of a world file: read the files, select the objects, cut them out and place
them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.cameras import PosedImage, read_posed_images
from egs_warp.io.capture import Capture, read_capture
from egs_warp.pipelines.object_selection import SelectionNames, picked_object, read_object
from egs_warp.pipelines.prepare_objects import PreparedObjects, Preparer, prepare_objects
from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions, prepare_scene
from egs_warp.pipelines.scene_cache import read_scene, scene_key, write_scene
from egs_warp.pipelines.scene_collision import read_collision_mesh
from egs_warp.pipelines.scene_obstacles import SceneObstacles
from egs_warp.pipelines.scene_world import SceneBody, SceneWorld, SceneWorldOptions, make_scene_world
from egs_warp.pipelines.surroundings import Surroundings
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.short_repr import short_repr
from egs_warp.training.photo_colours import photographs_in_colours_of


@dataclass(frozen=True)
class SceneObject:
    """An object of a scene, as selected by the user."""

    selection: tuple[str, ...]
    """Values that select the object, as for ``read_object``."""
    body: SceneBody = field(default_factory=SceneBody)
    plane: Plane | None = None
    """Plane under the object; None finds it."""
    view: str | None = None
    """Name or number of the camera of a single mask or pixel."""


@dataclass(frozen=True)
class SceneRequest:
    """A scene and its objects, as described by the user."""

    capture: Path
    objects: Mapping[str, SceneObject]
    """The objects by name, in the order in which they are cut out."""
    cameras: Path | None = None
    """Cameras of the capture; None if they are unknown."""
    up: Direction | None = None
    """Up direction; None estimates it."""
    collision_mesh: Path | None = None
    """Mesh of the obstacles (``read_collision_mesh``), in the frame of the capture; None measures them."""
    options: SceneWorldOptions = field(default_factory=SceneWorldOptions)
    scene_options: SceneOptions = field(default_factory=SceneOptions)
    mask_model: Path | None = None
    """File of a network that turns clicks into masks."""
    names: SelectionNames = field(default_factory=SelectionNames)
    """Names of the selection's arguments in messages."""


@dataclass(frozen=True)
class SceneProgress:
    """Functions that receive intermediate results during the preparation of a world, so that they are not lost if an
    error follows."""

    show_stage: Callable[[str], object] = lambda stage: None
    """Called with a description of each stage as it starts."""
    show_object: Callable[[str, PreparedScene], object] = lambda name, scene: None
    """Called with the name and the preparation of each object of a scene when it is finished."""
    show_background: Callable[[GaussianCloud], object] = lambda background: None
    """Called with the scene without the objects, in the frame of the capture."""
    show_obstacles: Callable[[SceneObstacles, Surroundings], object] = lambda obstacles, surroundings: None
    """Called with the obstacles of a scene, and the surroundings, before the bodies are created."""


@dataclass(frozen=True)
class SceneParts:
    """The world of a scene, together with the capture, cameras and objects from which it was created."""

    __repr__ = short_repr

    cloud: GaussianCloud
    """The capture."""
    cameras: tuple[Camera, ...]
    """Cameras of the capture; empty if they are unknown."""
    prepared: PreparedObjects
    """The objects and the remaining scene."""
    scene_world: SceneWorld
    """The world, with the objects as bodies."""


def read_scene_parts(
    request: SceneRequest,
    *,
    device: str | None = None,
    solids: Sequence[Solid] = (),
    progress: SceneProgress | None = None,
) -> SceneParts:
    """Read a scene, cut out its objects, and create a world from them.

    A prepared object is read from the cache (``egs_warp.pipelines.scene_cache``), if it was prepared before.

    Args:
        request: The scene and its objects.
        device: Warp device.
        solids: Further obstacles in the frame of the world, m.
        progress: Functions that are called during the preparation.

    Raises:
        UserError: A file or a value is invalid, or a stage failed. A message about an object begins with its name.
    """
    progress = progress or SceneProgress()
    capture = read_capture(request.capture, device=device)
    poses = None if request.cameras is None else read_posed_images(request.cameras).relative_to(capture.origin)
    posed = poses.images if poses is not None else ()
    cameras = tuple(one.camera for one in posed)
    specs: dict[str, ObjectSpec] = {}
    planes: dict[str, Plane] = {}
    bodies: dict[str, SceneBody] = {}
    for name, selected in request.objects.items():
        try:
            specs[name], plane, bodies[name] = _specified(selected, capture, posed, request)
        except UserError as error:
            raise UserError(f"{name}: {error}") from error
        if plane is not None:
            planes[name] = plane
    given = None if request.collision_mesh is None else read_collision_mesh(request.collision_mesh)
    prepare: Preparer = partial(_prepared, posed=posed, options=request.scene_options)
    prepared = prepare_objects(
        capture,
        specs,
        cameras=cameras,
        up=request.up,
        planes=planes,
        prepare=prepare,
        progress=lambda name: progress.show_stage(f"cutting {name} out of the scene"),
        show_object=progress.show_object,
    )
    progress.show_background(prepared.background)
    made = make_scene_world(
        prepared,
        bodies,
        cameras=cameras,
        options=replace(request.options, solids=given),
        solids=solids,
        progress=lambda name: progress.show_stage(f"preparing {name}"),
        show_obstacles=progress.show_obstacles,
    )
    notes = (*capture.notes, *(poses.messages if poses is not None else ()), *made.notes)
    return SceneParts(capture, cameras, prepared, replace(made, notes=notes))


def _specified(
    selected: SceneObject, capture: GaussianCloud, posed: Sequence[PosedImage], request: SceneRequest
) -> tuple[ObjectSpec, Plane | None, SceneBody]:
    """Return the specification, the plane and the body of an object."""
    picked = picked_object(selected.selection, capture, names=request.names)
    if picked is None:
        spec = read_object(
            selected.selection,
            capture,
            posed,
            view=selected.view,
            names=request.names,
            mask_model=request.mask_model,
        )
        return spec, selected.plane, selected.body
    front = selected.body.front if selected.body.front is not None else picked.front
    plane = picked.plane.plane if selected.plane is None and request.up is None else selected.plane
    return ObjectSpec(picked=picked.gaussians), plane, replace(selected.body, front=front)


def _prepared(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    up: Direction | None,
    plane: Plane | None,
    posed: Sequence[PosedImage],
    options: SceneOptions,
) -> PreparedScene:
    """Prepare one object, or read it from the cache."""
    direction = None if up is None else np.asarray(direction_of(up, "up"))
    key = scene_key(cloud, spec, posed=posed, up=direction, plane=plane, options=options)
    scene = read_scene(key)
    if scene is None:
        scene = prepare_scene(
            cloud,
            spec,
            cameras=[one.camera for one in posed],
            # Use photos only for the capture itself, because the photos show objects that have been cut out.
            photographs=photographs_in_colours_of(cloud, posed) if isinstance(cloud, Capture) else None,
            up=direction,
            plane=plane,
            options=options,
        )
        write_scene(key, scene)
    return scene
