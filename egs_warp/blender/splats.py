"""The splats as points of a mesh, with the attributes of a 3DGS ``.ply``, shown as soft ellipsoids.

Other add-ons read these attributes from the evaluated mesh. Therefore the modifier adds the ellipsoids to the points
instead of replacing the points.
"""

from __future__ import annotations

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

from .performance import BAND_0, Performance

NAME = "egs_warp splats"
"""Name of the node group and of the material, which all creatures share."""
_RADIUS = 3.0
"""Radius of an ellipsoid, standard deviations; at this radius, the opacity is 1 % of the opacity at the centre."""
_MOVING = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def add_splats(performance: Performance, name: str) -> bpy.types.Object:
    """Return a new object with the splats at rest."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(performance.band_0))
    constant = {f"f_dc_{channel}": performance.band_0[:, channel] for channel in range(3)}
    for attribute, values in (constant | {"opacity": performance.opacity_logits}).items():
        _set_values(mesh.attributes.new(attribute, "FLOAT", "POINT"), values)
    for attribute in _MOVING:
        mesh.attributes.new(attribute, "FLOAT", "POINT")
    opacities = 1.0 / (1.0 + np.exp(-performance.opacity_logits.astype(float)))
    colour = np.c_[_linear(0.5 + BAND_0 * performance.band_0), opacities]
    colours = mesh.attributes.new("colour", "FLOAT_COLOR", "POINT")
    colours.data.foreach_set("color", colour.astype(np.float32).ravel())
    splats = bpy.data.objects.new(name, mesh)
    splats.modifiers.new(NAME, "NODES").node_group = bpy.data.node_groups.get(NAME) or _ellipsoids()
    return splats


def deform_splats(splats: bpy.types.Object, performance: Performance, index: float) -> None:
    """Move the splats to the frame ``index`` of the performance, which may be fractional."""
    mesh = splats.data
    means, covariances, _ = performance.splats(index)
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    log_scales = 0.5 * np.log(np.maximum(variances, np.finfo(np.float32).tiny))
    mesh.attributes["position"].data.foreach_set("vector", means.astype(np.float32).ravel())
    for attribute, values in zip(_MOVING, (*log_scales.T, *quaternions(axes).T), strict=True):
        _set_values(mesh.attributes[attribute], values)
    mesh.update()


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Return unit quaternions (n, 4), w, x, y, z, of rotations (n, 3, 3).

    The matrix 4 q q^T is linear in the rotation; its column with the largest diagonal element is the most accurate.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotations.transpose(1, 2, 0)
    rows = [[1 + a + e + i, h - f, c - g, d - b], [h - f, 1 + a - e - i, b + d, c + g]]
    rows += [[c - g, b + d, 1 + e - a - i, f + h], [d - b, c + g, f + h, 1 + i - a - e]]
    products = np.array(rows).transpose(2, 0, 1)
    largest = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=1)
    columns = products[np.arange(len(products)), :, largest]
    return columns / np.linalg.norm(columns, axis=1, keepdims=True)


def _set_values(attribute: bpy.types.Attribute, values: np.ndarray) -> None:
    attribute.data.foreach_set("value", np.ascontiguousarray(values, np.float32))


def _linear(srgb: np.ndarray) -> np.ndarray:
    srgb = np.clip(srgb, 0.0, 1.0)
    return np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _ellipsoids() -> bpy.types.NodeTree:
    """Return the node group that adds an ellipsoid of ``_RADIUS`` standard deviations to each point."""
    tree = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    for side in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    points, joined, output = (
        tree.nodes.new(kind) for kind in ("NodeGroupInput", "GeometryNodeJoinGeometry", "NodeGroupOutput")
    )
    instances, ball, painted = (
        tree.nodes.new(f"GeometryNode{kind}") for kind in ("InstanceOnPoints", "MeshIcoSphere", "SetMaterial")
    )
    ball.inputs["Radius"].default_value = _RADIUS
    ball.inputs["Subdivisions"].default_value = 2
    painted.inputs["Material"].default_value = bpy.data.materials.get(NAME) or _material()
    rotation, scale = tree.nodes.new("FunctionNodeQuaternionToRotation"), tree.nodes.new("ShaderNodeCombineXYZ")
    for part in range(4):
        tree.links.new(_attribute(tree, f"rot_{part}"), rotation.inputs[part])
    for axis in range(3):
        exponential = tree.nodes.new("ShaderNodeMath")
        exponential.operation = "EXPONENT"
        tree.links.new(_attribute(tree, f"scale_{axis}"), exponential.inputs[0])
        tree.links.new(exponential.outputs[0], scale.inputs[axis])
    for source, target in (
        (points.outputs[0], instances.inputs["Points"]),
        (ball.outputs["Mesh"], painted.inputs["Geometry"]),
        (painted.outputs["Geometry"], instances.inputs["Instance"]),
        (rotation.outputs[0], instances.inputs["Rotation"]),
        (scale.outputs[0], instances.inputs["Scale"]),
        (instances.outputs["Instances"], joined.inputs[0]),
        (points.outputs[0], joined.inputs[0]),
        (joined.outputs[0], output.inputs[0]),
    ):
        tree.links.new(source, target)
    return tree


def _attribute(tree: bpy.types.NodeTree, name: str) -> bpy.types.NodeSocket:
    node = tree.nodes.new("GeometryNodeInputNamedAttribute")
    node.data_type = "FLOAT"
    node.inputs["Name"].default_value = name
    return node.outputs["Attribute"]


def _material() -> bpy.types.Material:
    """Return a material whose opacity is the maximum of the Gaussian along the line of sight.

    In the space of the unit Gaussian, a line through p with unit direction d passes the centre at the squared distance
    p.p - (p.d)^2. The back faces of an ellipsoid are invisible, so that a ray meets each ellipsoid once.
    """
    material = bpy.data.materials.new(NAME)
    material.use_nodes = True
    material.use_backface_culling = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    colour, place, sight = (nodes.new(f"ShaderNode{kind}") for kind in ("Attribute", "TexCoord", "NewGeometry"))
    colour.attribute_type, colour.attribute_name = "INSTANCER", "colour"
    local, along = nodes.new("ShaderNodeVectorTransform"), nodes.new("ShaderNodeVectorMath")
    local.vector_type, local.convert_from, local.convert_to = "VECTOR", "WORLD", "OBJECT"
    links.new(sight.outputs["Incoming"], local.inputs[0])
    along.operation = "NORMALIZE"
    links.new(local.outputs[0], along.inputs[0])

    def dot(first: bpy.types.NodeSocket, second: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        node = nodes.new("ShaderNodeVectorMath")
        node.operation = "DOT_PRODUCT"
        links.new(first, node.inputs[0])
        links.new(second, node.inputs[1])
        return node.outputs["Value"]

    def math(operation: str, *values: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        node = nodes.new("ShaderNodeMath")
        node.operation = operation
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, float):
                socket.default_value = value
            else:
                links.new(value, socket)
        return node.outputs[0]

    point = place.outputs["Object"]
    ahead = dot(point, along.outputs[0])
    squared = math("SUBTRACT", dot(point, point), math("MULTIPLY", ahead, ahead))
    value = math("EXPONENT", math("MULTIPLY", squared, -0.5))
    front = math("SUBTRACT", 1.0, sight.outputs["Backfacing"])
    opacity = math("MULTIPLY", math("MULTIPLY", value, colour.outputs["Alpha"]), front)
    clear, glow, mixed, output = (
        nodes.new(f"ShaderNode{kind}") for kind in ("BsdfTransparent", "Emission", "MixShader", "OutputMaterial")
    )
    links.new(colour.outputs["Color"], glow.inputs["Color"])
    links.new(opacity, mixed.inputs[0])
    links.new(clear.outputs[0], mixed.inputs[1])
    links.new(glow.outputs[0], mixed.inputs[2])
    links.new(mixed.outputs[0], output.inputs["Surface"])
    return material
