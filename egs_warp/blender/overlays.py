"""Cage, muscles, contact forces, centre of mass and camera as objects.

All except the camera follow the performance, are drawn in front of the splats, and are hidden in renders by default.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np
from mathutils import Matrix  # pyright: ignore[reportMissingImports]

from .performance import Performance

_THICKNESS = 0.004
"""Radius of the tubes of muscles and forces, body heights."""
_WEIGHT_LENGTH = 0.5
"""Length of the line for a force of one body weight, body heights."""
_SENSOR = 36.0
"""Width of the sensor of the camera, mm."""
_GROUP = "egs_warp tubes"


def add_cage(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new mesh of the cage's surface. Its vertices are all nodes of the cage, in the same order."""
    arrays = performance.bundle.arrays
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(arrays["rest_nodes"].tolist(), [], boundary_faces(arrays["cage_tets"]).tolist())
    cage = bpy.data.objects.new(name, mesh)
    cage.display_type, cage.hide_render = "WIRE", True
    return cage


def deform_cage(cage: bpy.types.Object, performance: Performance, index: float) -> None:
    """Move the nodes of the cage to frame ``index``."""
    _set_positions(cage.data, performance.nodes(index))


def add_muscles(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new mesh of the segments of the muscles, whose tubes are coloured by their activation."""
    muscles = performance.muscles
    assert muscles is not None
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata((muscles.ends @ performance.nodes(0)).tolist(), muscles.segments.tolist(), [])
    mesh.attributes.new("activation", "FLOAT", "EDGE")
    mesh.attributes.new("colour", "FLOAT_COLOR", "EDGE")
    return _with_tubes(mesh, name, performance)


def deform_muscles(muscles: bpy.types.Object, performance: Performance, index: float) -> None:
    """Move the muscles to frame ``index`` and colour them by activation: red for contraction, blue for extension, white
    for rest."""
    assert performance.muscles is not None
    mesh, activations = muscles.data, performance.activations(index)
    mesh.attributes["activation"].data.foreach_set("value", activations.astype(np.float32))
    strength = np.abs(activations)[:, None]
    full = np.where(activations[:, None] > 0.0, [0.8, 0.02, 0.02], [0.02, 0.1, 0.8])
    colours = np.c_[(1.0 - strength) * 0.8 + strength * full, np.ones(len(full))]
    mesh.attributes["colour"].data.foreach_set("color", colours.astype(np.float32).ravel())
    _set_positions(mesh, performance.muscles.ends @ performance.nodes(index))


def add_forces(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new mesh for the contact forces."""
    return _with_tubes(bpy.data.meshes.new(name), name, performance)


def deform_forces(forces: bpy.types.Object, performance: Performance, index: float) -> None:
    """Draw a line from each contact point of frame ``index`` along the contact force on the body."""
    points, force = performance.forces(index)
    tips = points + _WEIGHT_LENGTH * performance.height * force
    mesh, count = forces.data, len(points)
    mesh.clear_geometry()
    mesh.from_pydata(np.concatenate([points, tips]).tolist(), np.arange(2 * count).reshape(2, count).T.tolist(), [])
    colours = mesh.attributes.new("colour", "FLOAT_COLOR", "EDGE")
    colours.data.foreach_set("color", np.tile(np.array([0.9, 0.6, 0.05, 1.0], np.float32), count))
    mesh.update()


def add_centre_of_mass(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new empty at the centre of mass."""
    centre = bpy.data.objects.new(name, None)
    centre.show_in_front = True
    centre.empty_display_type, centre.empty_display_size = "SPHERE", 0.03 * performance.height
    return centre


def move_centre_of_mass(centre: bpy.types.Object, performance: Performance, index: float) -> None:
    """Move the marker to the centre of mass in frame ``index``."""
    centre.location = performance.centre_of_mass(index)


def add_path(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new curve along the path of the centre of mass."""
    points = np.array([performance.centre_of_mass(index) for index in range(performance.frame_count)])
    path = bpy.data.objects.new(name, poly_curve(name, points))
    path.hide_render = True
    return path


def add_camera(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new camera with the view of the film's camera."""
    view = performance.camera
    assert view is not None
    (width, height), (x, y) = view.size, view.principal_point
    lens = bpy.data.cameras.new(name)
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", _SENSOR
    lens.lens = _SENSOR * view.focal_length / width
    lens.shift_x, lens.shift_y = (0.5 * width - x) / width, (y - 0.5 * height) / width
    lens.clip_start, lens.clip_end = 0.01 * performance.height, 1000.0 * performance.height
    camera = bpy.data.objects.new(name, lens)
    # A camera of Blender looks along -z, with y up.
    axes = view.rotation.T * [1.0, -1.0, -1.0]
    camera.matrix_world = Matrix(np.block([[axes, view.centre[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist())
    return camera


def poly_curve(name: str, points: np.ndarray, *, cyclic: bool = False) -> bpy.types.Curve:
    """Return a new curve through ``points`` (n, 3)."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    spline = curve.splines.new("POLY")
    spline.points.add(len(points) - 1)
    spline.points.foreach_set("co", np.c_[points, np.ones(len(points))].astype(np.float32).ravel())
    spline.use_cyclic_u = cyclic
    return curve


def boundary_faces(tets: np.ndarray) -> np.ndarray:
    """Return the faces (B, 3) that belong to exactly one of the tetrahedra ``tets`` (T, 4), with their normals
    outward."""
    faces = tets[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


ADD: dict[str, Callable[[Performance, str], bpy.types.Object]] = {
    "cage": add_cage,
    "muscles": add_muscles,
    "contact forces": add_forces,
    "centre of mass": add_centre_of_mass,
}
"""Functions that create the object of each kind."""
MOVE: dict[str, Callable[[bpy.types.Object, Performance, float], None]] = {
    "cage": deform_cage,
    "muscles": deform_muscles,
    "contact forces": deform_forces,
    "centre of mass": move_centre_of_mass,
}
"""Functions that move the object of each kind to a frame."""


def _set_positions(mesh: bpy.types.Mesh, positions: np.ndarray) -> None:
    mesh.attributes["position"].data.foreach_set("vector", positions.astype(np.float32).ravel())
    mesh.update()


def _with_tubes(mesh: bpy.types.Mesh, name: str, performance: Performance) -> bpy.types.Object:
    tubes = bpy.data.objects.new(name, mesh)
    tubes.show_in_front, tubes.hide_render = True, True
    modifier = tubes.modifiers.new("tubes", "NODES")
    modifier.node_group = group = bpy.data.node_groups.get(_GROUP) or _tubes()
    modifier[group.interface.items_tree["Radius"].identifier] = _THICKNESS * performance.height
    return tubes


def _tubes() -> bpy.types.NodeTree:
    """Return the node group that turns edges into tubes with the colours of the edges."""
    tree = bpy.data.node_groups.new(_GROUP, "GeometryNodeTree")
    for socket, kind in (("Geometry", "NodeSocketGeometry"), ("Radius", "NodeSocketFloat")):
        tree.interface.new_socket(socket, in_out="INPUT", socket_type=kind)
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    edges, output = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    split, curves, circle, tubes, painted = (
        tree.nodes.new(f"GeometryNode{kind}")
        for kind in ("SplitEdges", "MeshToCurve", "CurvePrimitiveCircle", "CurveToMesh", "SetMaterial")
    )
    circle.inputs["Resolution"].default_value = 8
    tubes.inputs["Fill Caps"].default_value = True
    painted.inputs["Material"].default_value = bpy.data.materials.get(_GROUP) or _material()
    for source, target in (
        (edges.outputs["Geometry"], split.inputs["Mesh"]),
        (split.outputs["Mesh"], curves.inputs["Mesh"]),
        (edges.outputs["Radius"], circle.inputs["Radius"]),
        (curves.outputs["Curve"], tubes.inputs["Curve"]),
        (circle.outputs["Curve"], tubes.inputs["Profile Curve"]),
        (tubes.outputs["Mesh"], painted.inputs["Geometry"]),
        (painted.outputs["Geometry"], output.inputs[0]),
    ):
        tree.links.new(source, target)
    return tree


def _material() -> bpy.types.Material:
    material = bpy.data.materials.new(_GROUP)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    colour = nodes.new("ShaderNodeAttribute")
    colour.attribute_name = "colour"
    links.new(colour.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    return material
