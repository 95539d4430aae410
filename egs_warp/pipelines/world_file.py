"""World files: captures or a scene, and the positions, motions and obstacles of a world, in YAML
(docs/guide/worlds.md)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.io.capture import read_capture
from egs_warp.io.yaml_file import check_schema, line_of, read_yaml
from egs_warp.motions.push import Push, read_pushes
from egs_warp.motions.towards import check_motion
from egs_warp.notes import prefixed
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.friction_table import FrictionTable
from egs_warp.pipelines.prepare_scene import SceneOptions
from egs_warp.pipelines.prop import Prop, make_prop
from egs_warp.pipelines.scene_script import SceneObject, SceneParts, SceneProgress, SceneRequest, read_scene_parts
from egs_warp.pipelines.scene_world import SceneBody, SceneWorldOptions
from egs_warp.pipelines.world import World, unknown_body
from egs_warp.short_repr import short_repr

SCHEMA = "world.schema.json"
"""Name of the schema of world files in the package ``egs_warp.io``."""
_PROP_KEYS = ("density", "path", "repeat")
_CREATURE_KEYS = ("nodes", "front", "motion", "push", "self_contact")
"""Keys that only props have, and keys that only creatures have."""
_PLACE_KEYS = ("at", "above", "heading", "height", "metres_per_unit", "up", "path", "repeat")
"""Keys that an entry of an object of a scene must not have."""
_SCENE_KEYS = ("cameras", "up", "metres_per_unit", "flat", "collision_mesh")
"""Keys of the file that require a scene."""
_MAKER_KEYS = ("capture", "prop", "up", "front", "plane", "metres_per_unit", "height", "nodes", "density")
"""Keys that define a body, as opposed to its place and motion."""


@dataclass(frozen=True)
class WorldScript:
    """Contents of a world file: a world, the motions of its creatures, and the pushes on them."""

    __repr__ = short_repr

    world: World
    motions: Mapping[str, str]
    """Motions by the names of the creatures, as text; creatures without a motion stand."""
    pushes: Mapping[str, tuple[Push, ...]]
    """Pushes on the creatures, by their names."""
    notes: tuple[str, ...]
    """Guesses that were made about the captures, for the user."""
    text: Mapping[str, Any]
    """Contents of the file."""
    parts: SceneParts | None = None
    """Objects and remaining scene of a file that has a scene; None for other files."""


def read_world(
    path: Path | str,
    *,
    device: str | None = None,
    progress: Callable[[str], object] = lambda stage: None,
) -> WorldScript:
    """Read a world file and create its bodies.

    Args:
        path: YAML file; names of captures are relative to its folder.
        device: Warp device; None uses Warp's current device.
        progress: Called with a description of each stage as it starts; not for copies of an earlier body.

    Raises:
        UserError: The file is invalid, or a body cannot be created or placed; the message names the line.
    """
    return read_world_file(Path(path), SceneProgress(progress), device=device)


def read_world_file(path: Path, progress: SceneProgress, *, device: str | None = None) -> WorldScript:
    """Read a world file like ``read_world``; the functions of ``progress`` are called during the preparation."""
    tree, node = read_yaml(path)
    check_schema(path, tree, node, SCHEMA)
    entries = tree["bodies"]
    for index, entry in enumerate(entries):
        _check_keys(f"{path}, line {line_of(node, ['bodies', index])}", index, tree, entry)
    for key in _SCENE_KEYS:
        if key in tree and "scene" not in tree:
            line = line_of(node, [key])
            raise UserError(f"{path}, line {line}: {key} is for a scene; add scene: capture, or leave it out")
    names = _names(path, entries, node)
    for index, entry in enumerate(entries):
        # Check motions and pushes before creating any body, which takes longer.
        with _at_line(path, node, ["bodies", index]):
            if "motion" in entry:
                check_motion(entry["motion"], [name for other, name in names.items() if other != index])
            if "push" in entry:
                read_pushes(entry["push"])
    joints = tree.get("joints", ())
    for index, entry in enumerate(joints):
        with _at_line(path, node, ["joints", index]):
            for name in (entry["body"], entry.get("to", entry["body"])):
                if name not in names.values():
                    raise unknown_body("joint", name, names.values())
    frictions = _frictions(path, tree, node)
    solids = tuple(_solid(each) for each in tree.get("obstacles", ()))
    parts = None
    notes: list[str] = []
    if "scene" in tree:
        objects = {name: index for index, name in names.items() if "object" in entries[index]}
        where = {name: f"{path}, line {line_of(node, ['bodies', index])}" for name, index in objects.items()}
        request = _scene_request(
            path.parent, tree, {name: entries[index] for name, index in objects.items()}, frictions
        )
        try:
            parts = read_scene_parts(request, device=device, solids=solids, progress=progress)
        except UserError as error:
            # An error about an object begins with the object's name.
            line = where.get(str(error).partition(":")[0], f"{path}, line {line_of(node, ['scene'])}")
            raise UserError(f"{line}: {error}") from error
        world = parts.scene_world.world
        notes += parts.scene_world.notes
    else:
        world = World(solids=solids, friction=tree.get("friction"), frictions=frictions)
    bodies: dict[str, Creature | Prop] = {}
    motions: dict[str, str] = {}
    pushes: dict[str, tuple[Push, ...]] = {}
    for index, entry in enumerate(entries):
        name = names[index]
        if "object" not in entry:
            with _at_line(path, node, ["bodies", index]):
                _add_body(world, name, path.parent, entry, bodies, notes, device, progress.show_stage)
        if "motion" in entry:
            motions[name] = entry["motion"]
        if "push" in entry:
            pushes[name] = read_pushes(entry["push"])
    for index, entry in enumerate(joints):
        with _at_line(path, node, ["joints", index]):
            world.add_joint(entry["body"], at=entry["at"], to=entry.get("to"))
    notes += (*world.unused_frictions, *world.thin_parts)
    return WorldScript(world, motions, pushes, tuple(notes), tree, parts)


@contextmanager
def _at_line(path: Path, node: Any, keys: Sequence[str | int]) -> Iterator[None]:
    """Add the file and the line of the entry at ``keys`` to the message of a ``UserError``."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{path}, line {line_of(node, keys)}: {error}") from error


def _add_body(
    world: World,
    name: str,
    folder: Path,
    entry: Mapping[str, Any],
    bodies: dict[str, Creature | Prop],
    notes: list[str],
    device: str | None,
    show_stage: Callable[[str], object],
) -> None:
    """Add the body ``name`` of an entry with a capture to ``world``. ``bodies`` contains the bodies created so far,
    which further copies share; notes about a new body are added to ``notes``."""
    key = repr([entry.get(name) for name in _MAKER_KEYS])
    if key not in bodies:
        show_stage(f"preparing {name}")
        bodies[key] = _make_body(folder, entry, device)
        notes += [prefixed(name, note) for note in bodies[key].notes]
    world.add(
        bodies[key],
        at=tuple(entry.get("at", (0.0, 0.0))),
        above=entry.get("above", 0.0),
        heading=entry.get("heading"),
        name=name,
        path=_path(entry) if "path" in entry else None,
        self_contact=entry.get("self_contact", False),
        material=entry.get("material"),
    )


def _frictions(path: Path, tree: Mapping[str, Any], node: Any) -> dict[tuple[str, str], float]:
    """Return the friction table of a file."""
    given: list[tuple[tuple[str, str], float]] = []
    for index, entry in enumerate(tree.get("frictions", ())):
        given.append((tuple(entry["between"]), entry["friction"]))
        with _at_line(path, node, ["frictions", index]):
            FrictionTable.of(given)
    return dict(given)


def _names(path: Path, entries: Sequence[Mapping[str, Any]], node: Any) -> dict[int, str]:
    """Return the names of the bodies by their indices in the file. The objects of the scene come first, because they
    are added to the world first."""
    names: dict[int, str] = {}
    for index in sorted(range(len(entries)), key=lambda index: "object" not in entries[index]):
        entry = entries[index]
        if "name" in entry or "object" in entry:
            name = entry.get("name", f"object-{index + 1}")
            if name in names.values():
                line = line_of(node, ["bodies", index])
                raise UserError(f"{path}, line {line}: another body has the name {name!r}; choose another one")
        else:
            name = _unused_name(names.values(), Path(entry["capture"]).stem)
        names[index] = name
    return names


def _scene_request(
    folder: Path,
    tree: Mapping[str, Any],
    entries: Mapping[str, Mapping[str, Any]],
    frictions: Mapping[tuple[str, str], float],
) -> SceneRequest:
    """Return the scene of a file and its objects, by name; file names are relative to ``folder``."""
    objects = {}
    for name, entry in entries.items():
        given = entry["object"]
        values = [given] if isinstance(given, str) else given
        # JSON Schema accepts 500.0 as an integer.
        nodes = int(entry["nodes"]) if "nodes" in entry else None
        objects[name] = SceneObject(
            tuple(_relative_to(folder, value) for value in values),
            SceneBody(
                *(entry.get("prop", False), entry.get("front"), nodes, entry.get("density")),
                self_contact=entry.get("self_contact", False),
                material=entry.get("material"),
            ),
            Plane.from_coefficients(*entry["plane"]) if "plane" in entry else None,
            entry.get("view"),
        )
    return SceneRequest(
        folder / tree["scene"],
        objects,
        folder / tree["cameras"] if "cameras" in tree else None,
        tree.get("up"),
        folder / tree["collision_mesh"] if "collision_mesh" in tree else None,
        SceneWorldOptions(tree.get("metres_per_unit"), tree.get("friction"), frictions),
        SceneOptions(flat=tree.get("flat", False)),
    )


def _relative_to(folder: Path, value: str) -> str:
    """Return ``value`` with the path of ``folder`` in front if it names a file in it, such as a mask or
    ``picked.json:NAME``."""
    file = value.partition(".json:")[0] + ".json" if ".json:" in value else value
    return str(folder / value) if (folder / file).exists() else value


def box(at: tuple[float, float], size: tuple[float, float, float], heading: float = 0.0) -> Solid:
    """Return a box on the ground.

    Args:
        at: (2,) m, middle of its base.
        size: (3,) m, length along ``heading``, width and height.
        heading: degrees counter-clockwise from the x axis.
    """
    length, width, height = size
    along, across = _directions(heading)
    middle = np.array([*at, 0.0])
    sides = [
        _face(sign * axis, middle + sign * 0.5 * extent * axis)
        for axis, extent in ((along, length), (across, width))
        for sign in (1.0, -1.0)
    ]
    up = np.array([0.0, 0.0, 1.0])
    return Solid((*sides, _face(up, height * up)))


def ramp(at: tuple[float, float], length: float, width: float, height: float, heading: float = 0.0) -> Solid:
    """Return a ramp on the ground: it rises from 0 to ``height`` over ``length`` and ends in a vertical face.

    Args:
        at: (2,) m, middle of its lower edge.
        length: m, extent along the ground.
        width: m, extent across.
        height: m, rise.
        heading: uphill direction, degrees counter-clockwise from the x axis.
    """
    along, across = _directions(heading)
    foot = np.array([*at, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    slope = length * up - height * along
    sides = [_face(sign * across, foot + sign * 0.5 * width * across) for sign in (1.0, -1.0)]
    return Solid((_face(slope / np.linalg.norm(slope), foot), *sides, _face(along, foot + length * along)))


def _face(normal: np.ndarray, point: np.ndarray) -> Plane:
    return Plane(normal, -float(normal @ point))


def _directions(heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors (3,) along ``heading`` degrees and to the left of it."""
    c, s = np.cos(np.radians(heading)), np.sin(np.radians(heading))
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def _solid(entry: Mapping[str, Any]) -> Solid:
    """Return the solid of an obstacle: a box, a ramp or faces."""
    if "box" in entry:
        return box(**entry["box"])
    if "ramp" in entry:
        return ramp(**entry["ramp"])
    return Solid(tuple(Plane.from_coefficients(*face) for face in entry["solid"]))


def _check_keys(where: str, index: int, tree: Mapping[str, Any], entry: Mapping[str, Any]) -> None:
    if ("object" in entry) == ("capture" in entry):
        given = "both capture and object are given" if "object" in entry else "capture is missing"
        advice = "give the name of a capture, or object for an object of the scene"
        raise UserError(f"{where}: bodies.{index + 1}: {given}; {advice}")
    if "object" in entry:
        if "scene" not in tree:
            raise UserError(f"{where}: object is for a scene; add scene: capture to the file")
        for key in _PLACE_KEYS:
            if key in entry:
                raise UserError(
                    f"{where}: {key} is for a body with a capture; an object has its captured place and"
                    " size; leave it out"
                )
    elif "view" in entry:
        raise UserError(f"{where}: view is for an object of a scene; leave it out")
    is_prop = entry.get("prop", False)
    for key in _CREATURE_KEYS if is_prop else _PROP_KEYS:
        if key in entry:
            advice = "leave it out, or leave out prop: true" if is_prop else "add prop: true, or leave it out"
            kind = "a creature" if is_prop else "a prop"
            raise UserError(f"{where}: {key} is for {kind}; {advice}")


def _make_body(folder: Path, entry: Mapping[str, Any], device: str | None) -> Creature | Prop:
    """Create the body of an entry; the name of its capture is relative to ``folder``."""
    cloud = read_capture(folder / entry["capture"], device=device).cloud
    plane = Plane.from_coefficients(*entry["plane"]) if "plane" in entry else None
    up, scale = entry.get("up"), {name: entry.get(name) for name in ("metres_per_unit", "height")}
    if entry.get("prop", False):
        density = {"density": entry["density"]} if "density" in entry else {}
        return make_prop(cloud, up=up, plane=plane, **scale, **density)
    nodes: dict[str, Any] = {"nodes": int(entry["nodes"])} if "nodes" in entry else {}
    options = CreatureOptions(front=entry.get("front"), **scale, **nodes)
    return make_creature(cloud, up=up, plane=plane, options=options)


def _path(entry: Mapping[str, Any]) -> RigidPath:
    """Return the path of an entry, whose points are given like the place of a body; a key that a point lacks keeps its
    value from the previous point."""
    place = {"at": (0.0, 0.0), "above": 0.0, "heading": 0.0} | {
        key: entry[key] for key in ("at", "above", "heading") if key in entry
    }
    start, times, shifts, turns = dict(place), [], [], []
    for point in entry["path"]:
        place |= {key: value for key, value in point.items() if key != "time"}
        times.append(point["time"])
        moved = np.subtract(place["at"], start["at"])
        shifts.append((*moved.tolist(), place["above"] - start["above"]))
        turns.append(place["heading"] - start["heading"])
    return RigidPath(times, shifts, turns, repeat=entry.get("repeat", False))


def _unused_name(used: Collection[str], name: str) -> str:
    """Return ``name`` with ``-`` in place of characters that names must not contain, and with a number appended if it
    is already taken."""
    base = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)
    number = 1
    while (candidate := base if number == 1 else f"{base}-{number}") in used:
        number += 1
    return candidate
