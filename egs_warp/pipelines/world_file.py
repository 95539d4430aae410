"""World files: captures, positions, motions and obstacles of a world in YAML (docs/guide/worlds.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.prop import Prop, make_prop
from egs_warp.pipelines.world import World
from egs_warp.short_repr import short_repr

SCHEMA = "world.schema.json"
"""Schema of world files, in the package ``egs_warp.io``."""
_PROP_KEYS = ("density", "path", "repeat")
_CREATURE_KEYS = ("nodes", "front", "motion", "push")
"""Keys that only props, and only creatures, have."""
_MAKER_KEYS = ("capture", "prop", "up", "front", "plane", "metres_per_unit", "height", "nodes", "density")
"""Keys on which the body depends, apart from its place and motion."""


@dataclass(frozen=True)
class WorldScript:
    """Contents of a world file: a world, and the motions of its creatures and the pushes on them."""

    __repr__ = short_repr

    world: World
    motions: Mapping[str, str]
    """Motions by the names of the creatures, as text; creatures without a motion stand."""
    pushes: Mapping[str, tuple[Push, ...]]
    """Pushes on the creatures, by their names."""
    notes: tuple[str, ...]
    """Guesses about the captures, for the user."""
    text: Mapping[str, Any]
    """Contents of the file."""


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
        progress: Called with the name of each body before it is created; not for copies of an earlier body.

    Raises:
        UserError: The file is invalid, or a body cannot be created or placed; the message names the line.
    """
    path = Path(path)
    tree, node = read_yaml(path)
    check_schema(path, tree, node, SCHEMA)
    entries = tree["bodies"]
    for index, entry in enumerate(entries):
        _check_keys(path, entry, line_of(node, ["bodies", index]))
    world = World(solids=tuple(_solid(each) for each in tree.get("obstacles", ())), friction=tree.get("friction"))
    bodies: dict[str, Creature | Prop] = {}
    motions: dict[str, str] = {}
    pushes: dict[str, tuple[Push, ...]] = {}
    notes: list[str] = []
    for index, entry in enumerate(entries):
        where = f"{path}, line {line_of(node, ['bodies', index])}"
        try:
            # Read first, because the bodies take longer.
            if "motion" in entry:
                check_motion(entry["motion"])
            pushes_on = read_pushes(entry["push"]) if "push" in entry else ()
            key = repr([entry.get(name) for name in _MAKER_KEYS])
            name = entry.get("name", Path(entry["capture"]).stem)
            if key not in bodies:
                progress(name)
                bodies[key] = _make_body(path.parent, entry, device)
                notes += [f"{name}: {note}" for note in bodies[key].notes]
            name = _unused_name(world, name) if "name" not in entry else name
            placed = world.add(
                bodies[key],
                at=tuple(entry.get("at", (0.0, 0.0))),
                above=entry.get("above", 0.0),
                heading=entry.get("heading"),
                name=name,
                path=_path(entry) if "path" in entry else None,
            )
        except UserError as error:
            raise UserError(f"{where}: {error}") from error
        if "motion" in entry:
            motions[placed.name] = entry["motion"]
        if pushes_on:
            pushes[placed.name] = pushes_on
    return WorldScript(world, motions, pushes, tuple(notes), tree)


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


def _check_keys(path: Path, entry: Mapping[str, Any], line: int) -> None:
    is_prop = entry.get("prop", False)
    for key in _CREATURE_KEYS if is_prop else _PROP_KEYS:
        if key in entry:
            advice = "leave it out, or leave out prop: true" if is_prop else "add prop: true, or leave it out"
            kind = "a creature" if is_prop else "a prop"
            raise UserError(f"{path}, line {line}: {key} is for {kind}; {advice}")


def _make_body(folder: Path, entry: Mapping[str, Any], device: str | None) -> Creature | Prop:
    """Create the body of an entry; the name of its capture is relative to ``folder``."""
    cloud = read_capture(folder / entry["capture"], device=device).cloud
    plane = Plane.from_coefficients(*entry["plane"]) if "plane" in entry else None
    up, scale = entry.get("up"), {name: entry.get(name) for name in ("metres_per_unit", "height")}
    if entry.get("prop", False):
        density = {"density": entry["density"]} if "density" in entry else {}
        return make_prop(cloud, up=up, plane=plane, **scale, **density)
    nodes = {"nodes": entry["nodes"]} if "nodes" in entry else {}
    options = CreatureOptions(front=entry.get("front"), **scale, **nodes)
    return make_creature(cloud, up=up, plane=plane, options=options)


def _path(entry: Mapping[str, Any]) -> RigidPath:
    """Return the path of an entry, whose points are given like the place of a body; a key that a point does not have
    keeps its value."""
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


def _unused_name(world: World, name: str) -> str:
    """Return ``name`` with ``-`` for characters that names cannot have, and with a number if it is already taken."""
    base = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)
    names = {placed.name for placed in world.members}
    number = 1
    while (candidate := base if number == 1 else f"{base}-{number}") in names:
        number += 1
    return candidate
