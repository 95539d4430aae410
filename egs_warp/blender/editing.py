"""Editable cage and muscles at rest, and the files of both that ``egs-warp animate`` reads."""

from __future__ import annotations

import json
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

from .overlays import add_cage, poly_curve
from .performance import Performance

STRENGTH = "strength"
"""Name of a curve's custom property: the maximum force in body weights."""
_DEFAULT_STRENGTH = 2.0
_NO_REST_OBJECTS = "a bundle has neither muscles nor a cage to edit; import the folder of the run"
_SUFFIX = "to edit"
"""Suffix of the name of the collection of editable objects."""


def add_rest_objects(performance: Performance, root: bpy.types.Object, collection: bpy.types.Collection) -> None:
    """Add a hidden collection with the cage at rest, and one curve for each fibre, to ``collection``."""
    muscles = performance.muscles
    assert muscles is not None
    rest = bpy.data.collections.new(f"{root.name} {_SUFFIX}")
    collection.children.link(rest)
    rest.hide_viewport = rest.hide_render = True
    cage = add_cage(performance, f"{root.name} cage {_SUFFIX}")
    cage.parent = root
    rest.objects.link(cage)
    ends = muscles.ends @ muscles.rest_nodes
    for fibre, name in enumerate(muscles.names):
        segments = muscles.segments[muscles.fibre_from_segment == fibre]
        course = np.concatenate([segments[:, 0], segments[-1:, 1]])
        is_hoop = bool(course[0] == course[-1])
        curve = poly_curve(name, ends[course[:-1] if is_hoop else course], cyclic=is_hoop)
        curve.bevel_depth = 0.004 * performance.height
        thread = bpy.data.objects.new(name, curve)
        thread[STRENGTH] = round(float(muscles.strengths[fibre]), 3)
        thread.parent = root
        rest.objects.link(thread)


def write_muscles(path: Path, root: bpy.types.Object, performance: Performance) -> int:
    """Write the curves as a file of muscles; return the number of fibres.

    Raises:
        ValueError: as for ``muscles_as_json``.
        OSError: the file cannot be written.
    """
    text = muscles_as_json(root, performance)
    path.write_text(text + "\n", encoding="utf-8")
    return len(json.loads(text)["fibres"])


def write_cage(path: Path, root: bpy.types.Object, performance: Performance) -> int:
    """Write the edited cage with its tetrahedra as a Medit file; return the number of its nodes.

    Raises:
        ValueError: the creature is from a bundle, or there is not one cage with all nodes.
        OSError: the file cannot be written.
    """
    muscles = performance.muscles
    if muscles is None:
        raise ValueError(_NO_REST_OBJECTS)
    cages = _rest_objects(root, "MESH")
    if len(cages) != 1:
        name = f"{root.name} {_SUFFIX}"
        raise ValueError(f'the collection "{name}" has {len(cages)} meshes; it must contain exactly one, the cage')
    points = np.array([vertex.co for vertex in cages[0].data.vertices], float).reshape(-1, 3)
    if len(points) != len(muscles.rest_nodes):
        raise ValueError(
            f"the cage has {len(points)} vertices, but the run has {len(muscles.rest_nodes)} nodes; move vertices"
            " without adding or removing any"
        )
    nodes, tets = muscles.in_capture(_in_root(points, cages[0], root)), performance.bundle.arrays["cage_tets"]
    lines = ["MeshVersionFormatted 2", "Dimension 3", "Vertices", str(len(nodes))]
    lines += [f"{x:.9g} {y:.9g} {z:.9g} 0" for x, y, z in nodes]
    lines += ["Tetrahedra", str(len(tets)), *(f"{a} {b} {c} {d} 0" for a, b, c, d in tets + 1), "End"]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return len(nodes)


def muscles_as_json(root: bpy.types.Object, performance: Performance) -> str:
    """Return the text of a file of muscles: each spline of a curve is a fibre, and each of its control points ends a
    segment.

    Raises:
        ValueError: the creature is from a bundle, there is no curve, or a spline has fewer than two points.
    """
    muscles = performance.muscles
    if muscles is None:
        raise ValueError(_NO_REST_OBJECTS)
    threads = _rest_objects(root, "CURVE")
    if not threads:
        raise ValueError(f'the collection "{root.name} {_SUFFIX}" has no curve; add one')
    fibres = []
    for thread in threads:
        for number, spline in enumerate(thread.data.splines):
            points = _in_root(_points(spline), thread, root)
            name = thread.name if len(thread.data.splines) == 1 else f"{thread.name} {number + 1}"
            if len(points) < 2:
                raise ValueError(f'the curve "{name}" has fewer than two points; add one or remove the curve')
            if spline.use_cyclic_u:
                points = np.concatenate([points, points[:1]])
            fibres.append(
                {
                    "name": name,
                    "kind": "polyline",
                    "points": muscles.in_capture(points).round(6).tolist(),
                    "strength": float(thread.get(STRENGTH, _DEFAULT_STRENGTH)),
                }
            )
    return json.dumps({"fibres": fibres}, indent=1)


def _rest_objects(root: bpy.types.Object, kind: str) -> list[bpy.types.Object]:
    """Return the objects of type ``kind`` in the collection of a creature's editable objects."""
    return [
        member
        for home in root.users_collection
        for collection in home.children
        if _SUFFIX in collection.name
        for member in collection.objects
        if member.type == kind
    ]


def _in_root(points: np.ndarray, member: bpy.types.Object, root: bpy.types.Object) -> np.ndarray:
    """Transform points (n, 3) from the space of ``member`` to the space of ``root``. ``matrix_world`` is not used,
    because Blender does not update it for hidden objects."""
    if member.parent == root:
        matrix = np.array(member.matrix_parent_inverse @ member.matrix_basis)
    else:
        matrix = np.array(root.matrix_world.inverted() @ member.matrix_world)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _points(spline: bpy.types.Spline) -> np.ndarray:
    """Return the control points (n, 3) of ``spline`` in the space of the curve."""
    if spline.type == "BEZIER":
        return np.array([point.co for point in spline.bezier_points], float).reshape(-1, 3)
    return np.array([point.co[:3] for point in spline.points], float).reshape(-1, 3)
