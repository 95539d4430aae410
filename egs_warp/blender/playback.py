"""Objects of a performance, and the handler that moves them with the timeline."""

from __future__ import annotations

from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
from bpy.app.handlers import persistent  # pyright: ignore[reportMissingImports]

from .editing import add_rest_objects
from .overlays import ADD, MOVE, add_camera, add_path
from .performance import Performance, ReadError, read_performance
from .splats import add_splats, deform_splats

_SPLATS = "splats"
_TRANSPARENT_BOUNCES = 256
"""Maximum number of splats that a Cycles ray passes through."""
_performances: dict[tuple[str, float], Performance] = {}
"""Loaded performances, by file and modification time."""


class Playback(bpy.types.PropertyGroup):
    """Properties of a creature's objects: ``source`` is set on its empty, ``part`` on each moving object."""

    source: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Source", subtype="FILE_PATH", description="Bundle, or folder of the run"
    )
    start: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Start", description="Frame of the scene at which the motion starts"
    )
    speed: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Speed", default=1.0, min=0.0, description="1 is real time at the frame rate of the scene"
    )
    part: bpy.props.StringProperty()  # type: ignore[valid-type]


def add_creature(context: bpy.types.Context, path: Path, *, set_up_scene: bool) -> bpy.types.Object:
    """Add a creature to the collection of ``context``; return the empty that is the parent of all its objects.

    Args:
        context: The context of Blender.
        path: A bundle or a run, as for ``read_performance``.
        set_up_scene: True to set the frame rate, the frame range and the render settings that the splats need.

    Raises:
        ReadError: the files cannot be read.
    """
    performance = read_performance(path)
    if set_up_scene:
        _set_up(context.scene, performance)
    name = performance.name
    collection = bpy.data.collections.new(name)
    context.collection.children.link(collection)
    root = bpy.data.objects.new(name, None)
    root.empty_display_size = 0.5 * performance.height
    root.egs_warp.source = str(path)
    root.egs_warp.start = context.scene.frame_start
    collection.objects.link(root)
    parts = {_SPLATS: add_splats(performance, f"{name} {_SPLATS}")}
    kinds = list(ADD) if performance.muscles is not None else ["cage"]
    parts |= {kind: ADD[kind](performance, f"{name} {kind}") for kind in kinds}
    for kind, part in parts.items():
        part.egs_warp.part = kind
    if performance.muscles is not None:
        parts["path"] = add_path(performance, f"{name} path")
    if performance.camera is not None:
        parts["camera"] = add_camera(performance, f"{name} camera")
    for part in parts.values():
        part.parent = root
        collection.objects.link(part)
    if performance.muscles is not None:
        add_rest_objects(performance, root, collection)
    if set_up_scene and performance.camera is not None:
        context.scene.camera = parts["camera"]
        context.scene.render.resolution_x, context.scene.render.resolution_y = performance.camera.size
    _performances[_key(path)] = performance
    show(context.scene)
    return root


@persistent
def show(scene: bpy.types.Scene, _: object = None) -> None:
    """Move all creatures to the frame of ``scene``; a creature whose source is missing does not move."""
    for root in scene.objects:
        if not root.egs_warp.source:
            continue
        try:
            performance = performance_of(root)
        except ReadError as error:
            print(f"egs_warp: {error}")
            continue
        index = performance.clamped(_index(scene, root, performance))
        for part in root.children:
            if part.egs_warp.part == _SPLATS:
                deform_splats(part, performance, index)
            elif part.egs_warp.part in MOVE:
                MOVE[part.egs_warp.part](part, performance, index)


def performance_of(root: bpy.types.Object) -> Performance:
    """Return the performance of a creature; its files are read only once.

    Raises:
        ReadError: its source cannot be read.
    """
    path = Path(bpy.path.abspath(root.egs_warp.source))
    key = _key(path)
    if key not in _performances:
        _performances[key] = read_performance(path)
    return _performances[key]


def creature_of(part: bpy.types.Object | None) -> bpy.types.Object | None:
    """Return the empty of the creature to which ``part`` belongs; None if there is none."""
    while part is not None and not part.egs_warp.source:
        part = part.parent
    return part


def forget() -> None:
    """Drop all performances from memory."""
    _performances.clear()


def _index(scene: bpy.types.Scene, root: bpy.types.Object, performance: Performance) -> float:
    """Return the frame of the performance, with a fraction, at the time of ``scene``."""
    frames = scene.frame_current_final - root.egs_warp.start
    return root.egs_warp.speed * frames * scene.render.fps_base / scene.render.fps * performance.fps


def _key(path: Path) -> tuple[str, float]:
    return str(path), path.stat().st_mtime if path.exists() else 0.0


def _set_up(scene: bpy.types.Scene, performance: Performance) -> None:
    scene.render.fps, scene.render.fps_base = round(performance.fps), round(performance.fps) / performance.fps
    # Frames are numbered from 0, like the frames of a run.
    scene.frame_start, scene.frame_end = 0, performance.frame_count - 1
    scene.frame_set(0)
    # The handler changes meshes; the user interface must not draw them at the same time.
    scene.render.use_lock_interface = True
    # Show the colours of the splats unchanged.
    scene.view_settings.view_transform = "Standard"
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = _TRANSPARENT_BOUNCES
