"""Muscles from a user's JSON file.

A file is an object with ``fibres``, a list of entries. Lengths are in units of the capture. Every entry has ``name``
and ``kind`` and, depending on the kind,

* ``longitudinal``: ``from``, ``to`` (points [x, y, z]) and ``segments`` (default 4): a straight fibre;
* ``polyline``: ``points``, two or more: one segment between consecutive points;
* ``circular``: ``centre``, ``axis``, ``radius`` and ``segments`` (default 8, at least 3): a closed hoop about the axis;
* ``radial``: ``centre``, ``axis``, ``radius`` and ``count`` (default 2): diameters across the axis, one fibre each.

Optional keys of every entry are ``strength`` in body weights (default 2) or ``stiffness`` in N/m, ``group`` (a name),
and ``mirror`` (true or false). If ``mirror`` is true, the mirror image in the ``mirror_plane`` of the file,
``{"point": [x, y, z], "normal": [x, y, z]}``, is added as the symmetric partner. The file may set ``max_strain``
(default 0.3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from egs_warp.io.text import json_excerpt, parse_json, read_text
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.muscle_set import MuscleSet, attach_fibres

MAX_SEGMENTS = 400
"""Maximum number of segments. The quadratic program has one unknown per segment; with more segments, a frame takes
seconds."""

_SAME_FRAME = BodyFrame(np.eye(3), np.zeros(3), 1.0)
_COMMON_KEYS = {"name", "kind", "strength", "stiffness", "group", "mirror"}
_FILE_KEYS = {"fibres", "max_strain", "mirror_plane"}
_DEFAULT_STRENGTH = 2.0
_MAX_VALUES = {"strength": 1e3, "stiffness": 1e9}
"""Maximum strength in body weights, and maximum stiffness in N/m. If muscles are much stiffer than steel cables, the
solver loses precision."""
_MAX_OUTSIDE_EDGES = 1.5
"""Maximum distance of a point from the nearest node, in mean edge lengths."""


def read_muscles(path: Path | str, mesh: TetMesh, *, body_weight: float, frame: BodyFrame = _SAME_FRAME) -> MuscleSet:
    """Read muscles from a JSON file (module docstring) and attach them to ``mesh``.

    Args:
        path: JSON file.
        mesh: cage at rest, m.
        body_weight: weight of the body, N.
        frame: frame of the mesh in the coordinates of the file.

    Raises:
        UserError: the file is invalid; the message names the file, the entry, what is wrong and what to do.
    """
    path = Path(path)
    content = _load(path)
    _refuse_unknown_keys(f"{path}", content, _FILE_KEYS)
    entries = content.get("fibres")
    if not isinstance(entries, list) or not entries:
        raise UserError(f'{path}: it has no fibres; give a list "fibres" with at least one entry')
    max_strain = _positive(f"{path}", content, "max_strain", 0.3)
    if max_strain >= 1.0:
        raise UserError(f'{path}: "max_strain" is {max_strain:g}; give a number below 1')
    mirror = _mirror(f"{path}", content)
    fibres: list[Fibre] = []
    stiffness: list[float] = []
    groups: dict[str, int] = {}
    for index, entry in enumerate(entries):
        entry_fibres, entry_stiffness = _fibres(path, index, entry, mirror, groups, frame, body_weight)
        fibres += entry_fibres
        stiffness += [entry_stiffness] * len(entry_fibres)
    _check(path, fibres, mesh, frame)
    muscles = attach_fibres(mesh, fibres, max_strain=max_strain)
    requested = np.array(stiffness)[muscles.fibre_from_segment]
    return replace(muscles, stiffness=np.where(np.isnan(requested), muscles.stiffness, requested))


def _load(path: Path) -> dict[str, Any]:
    content = parse_json(read_text(path), path)
    if not isinstance(content, dict):
        raise UserError(f'{path}: the file contains no object; write {{"fibres": [...]}}')
    return content


def _fibres(
    path: Path,
    index: int,
    entry: Any,
    mirror: Callable[[np.ndarray], np.ndarray] | None,
    groups: dict[str, int],
    frame: BodyFrame,
    body_weight: float,
) -> tuple[list[Fibre], float]:
    """Return the fibres of one entry, with their mirror images, and their stiffness in N/m, which is NaN if the entry
    has none."""
    where = f"{path}: fibre {index + 1}"
    if not isinstance(entry, dict):
        raise UserError(f"{where} is not an object; write {{...}} with a name and a kind")
    name = entry.get("name")
    if not isinstance(name, str) or not name:
        raise UserError(f'{where} has no name; give it a "name"')
    where = f'{path}: fibre "{name}"'
    kind = entry.get("kind")
    if not isinstance(kind, str) or kind not in _SHAPES:
        near = did_you_mean(kind, _SHAPES)
        raise UserError(f'{where} has the kind {json_excerpt(kind)}{near}; give "kind" as one of {", ".join(_SHAPES)}')
    shape, shape_keys, fibre_kind = _SHAPES[kind]
    _refuse_unknown_keys(where, entry, _COMMON_KEYS | shape_keys)
    if "strength" in entry and "stiffness" in entry:
        raise UserError(f'{where} gives both "strength" and "stiffness"; give one of them')
    force = body_weight * _positive(where, entry, "strength", _DEFAULT_STRENGTH)
    stiffness = _positive(where, entry, "stiffness", 1.0) if "stiffness" in entry else float("nan")
    group = entry.get("group", "")
    if not isinstance(group, str):
        raise UserError(f'{where}: "group" is {json_excerpt(group)}; give a name in quotes')
    mirrored = entry.get("mirror", False)
    if not isinstance(mirrored, bool):
        raise UserError(f'{where}: "mirror" is {json_excerpt(mirrored)}; give true or false')
    if mirrored and mirror is None:
        raise UserError(f'{where} is mirrored but the file has no plane; give "mirror_plane" with point and normal')
    group_index = groups.setdefault(group, len(groups))
    polylines = shape(where, entry)
    fibres = []
    for number, points in enumerate(polylines):
        own = name if len(polylines) == 1 else f"{name} {number + 1}"
        image = f"{own} mirrored" if mirrored else None
        fibres.append(Fibre(own, fibre_kind, frame.points(points), force, group_index, image))
        if mirrored and mirror is not None:
            image_points = frame.points(mirror(points))
            fibres.append(Fibre(f"{own} mirrored", fibre_kind, image_points, force, group_index, own))
    return fibres, stiffness


def _longitudinal(where: str, entry: dict[str, Any]) -> list[np.ndarray]:
    start, end = _point(where, entry, "from"), _point(where, entry, "to")
    along = np.linspace(0.0, 1.0, _count(where, entry, "segments", 4, minimum_value=1) + 1)[:, None]
    return [(1.0 - along) * start + along * end]


def _polyline(where: str, entry: dict[str, Any]) -> list[np.ndarray]:
    points = entry.get("points")
    if not isinstance(points, list) or len(points) < 2:
        raise UserError(f'{where}: "points" is {json_excerpt(points)}; give a list of at least two points [x, y, z]')
    return [np.array([_point(f"{where}, point {number + 1}", {"": point}, "") for number, point in enumerate(points)])]


def _circular(where: str, entry: dict[str, Any]) -> list[np.ndarray]:
    count = _count(where, entry, "segments", 8, minimum_value=3)
    ring = _around(where, entry, 2.0 * np.pi * np.arange(count) / count)
    return [np.concatenate([ring, ring[:1]])]


def _radial(where: str, entry: dict[str, Any]) -> list[np.ndarray]:
    count = _count(where, entry, "count", 2, minimum_value=1)
    ring = _around(where, entry, np.pi * np.arange(2 * count) / count)
    return [ring[[diameter, diameter + count]] for diameter in range(count)]


_SHAPES: dict[str, tuple[Callable[[str, dict[str, Any]], list[np.ndarray]], set[str], FibreKind]] = {
    "longitudinal": (_longitudinal, {"from", "to", "segments"}, FibreKind.LONGITUDINAL),
    "circular": (_circular, {"centre", "axis", "radius", "segments"}, FibreKind.CIRCULAR),
    "radial": (_radial, {"centre", "axis", "radius", "count"}, FibreKind.RADIAL),
    "polyline": (_polyline, {"points"}, FibreKind.USER),
}


def _around(where: str, entry: dict[str, Any], angles: np.ndarray) -> np.ndarray:
    """Return the points at ``angles`` on the entry's circle."""
    first, second = orthonormal_basis(_direction(where, entry, "axis"))
    spokes = -np.cos(angles)[:, None] * first - np.sin(angles)[:, None] * second
    return _point(where, entry, "centre") + _positive(where, entry, "radius", None) * spokes


def _mirror(where: str, content: dict[str, Any]) -> Callable[[np.ndarray], np.ndarray] | None:
    if "mirror_plane" not in content:
        return None
    plane = content["mirror_plane"]
    if not isinstance(plane, dict):
        raise UserError(f'{where}: "mirror_plane" is {json_excerpt(plane)}; give an object with "point" and "normal"')
    where = f"{where}: mirror_plane"
    _refuse_unknown_keys(where, plane, {"point", "normal"})
    point, normal = _point(where, plane, "point"), _direction(where, plane, "normal")
    return lambda points: points - 2.0 * ((points - point) @ normal)[:, None] * normal


def _check(path: Path, fibres: list[Fibre], mesh: TetMesh, frame: BodyFrame) -> None:
    names: set[str] = set()
    reach = _MAX_OUTSIDE_EDGES * mean_edge_length(mesh)
    for fibre in fibres:
        where = f'{path}: fibre "{fibre.name}"'
        if fibre.name in names:
            raise UserError(f"{where} occurs twice; give each fibre its own name")
        names.add(fibre.name)
        distances = np.linalg.norm(fibre.points[:, None] - mesh.nodes[None], axis=2).min(axis=1)
        worst = int(np.argmax(distances))
        if not distances[worst] <= reach:
            x, y, z = frame.capture_points(fibre.points[worst])
            raise UserError(
                f"{where}: the point [{x:g}, {y:g}, {z:g}] is {distances[worst] / frame.scale:.3g} units away"
                " from the body; give points inside it, in the capture's own coordinates"
            )
        lengths = np.linalg.norm(np.diff(fibre.points, axis=0), axis=1)
        if lengths.min() == 0.0:
            x, y, z = frame.capture_points(fibre.points[int(np.argmin(lengths))])
            raise UserError(f"{where} has two equal points in a row, [{x:g}, {y:g}, {z:g}]; move one of them")
    count = sum(len(fibre.points) - 1 for fibre in fibres)
    if count > MAX_SEGMENTS:
        raise UserError(f"{path}: its fibres have {count} segments in all; use at most {MAX_SEGMENTS}")


def _refuse_unknown_keys(where: str, entry: dict[str, Any], known: set[str]) -> None:
    for key in entry:
        if key not in known:
            raise UserError(
                f'{where}: "{key}" is not known here{did_you_mean(key, known)}; use {", ".join(sorted(known))}'
            )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _point(where: str, entry: dict[str, Any], key: str) -> np.ndarray:
    value = entry.get(key)
    if not isinstance(value, list) or len(value) != 3 or not all(_is_number(number) for number in value):
        what = f': "{key}"' if key else ""
        raise UserError(f"{where}{what} is {json_excerpt(value)}; give three finite numbers [x, y, z]")
    return np.array(value, dtype=np.float64)


def _direction(where: str, entry: dict[str, Any], key: str) -> np.ndarray:
    value = _point(where, entry, key)
    largest = np.abs(value).max()
    if largest == 0.0:
        raise UserError(f'{where}: "{key}" is zero; give a direction [x, y, z]')
    # The square of a large number would overflow.
    value = value / largest
    return value / np.linalg.norm(value)


def _positive(where: str, entry: dict[str, Any], key: str, default: float | None) -> float:
    value = entry.get(key, default)
    maximum_value = _MAX_VALUES.get(key, np.inf)
    if not _is_number(value) or not 0 < value <= maximum_value:
        upto = "" if maximum_value == np.inf else f", at most {maximum_value:g}"
        raise UserError(f'{where}: "{key}" is {json_excerpt(value)}; give a number above 0{upto}')
    return float(value)


def _count(where: str, entry: dict[str, Any], key: str, default: int, *, minimum_value: int) -> int:
    value = entry.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not minimum_value <= value <= MAX_SEGMENTS:
        raise UserError(
            f'{where}: "{key}" is {json_excerpt(value)}; give a whole number from {minimum_value} to {MAX_SEGMENTS}'
        )
    return value
