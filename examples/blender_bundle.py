"""Show a bundle of ``egs-warp export RUN --to bundle`` as moving ellipsoids; run in Blender 4.5 or newer.

Open this script in the Scripting workspace and run it. ``read_bundle.py`` must be in the same folder; BUNDLE names the
file. See docs/guide/export.md.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

BUNDLE = os.environ.get("BUNDLE", "jump.egs")
SIGMAS = 1.3
"""Size of an ellipsoid in standard deviations: a solid ellipsoid of this size looks like a splat, which fades out."""
MIN_OPACITY = 0.3
"""Minimum opacity of a shown splat; fainter ones would look like a crust if they were solid."""

sys.path.append(str(Path(bpy.context.space_data.text.filepath if bpy.context.space_data else __file__).parent))
from read_bundle import Bundle  # noqa: E402

bundle = Bundle(BUNDLE)
visible = np.flatnonzero(bundle.arrays["opacities"] > MIN_OPACITY)
mesh = bpy.data.meshes.new("splats")
mesh.from_pydata(bundle.arrays["means"][visible].tolist(), [], [])
splats = bpy.data.objects.new("splats", mesh)
bpy.context.scene.collection.objects.link(splats)
for name, kind in (("turn", "QUATERNION"), ("size", "FLOAT_VECTOR"), ("colour", "FLOAT_COLOR")):
    mesh.attributes.new(name, kind, "POINT")
srgb = np.clip(bundle.arrays["colours"][visible], 0, 1)
linear = np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
mesh.attributes["colour"].data.foreach_set("color", np.c_[linear, np.ones(len(visible))].astype(np.float32).ravel())


def show(scene: bpy.types.Scene, _: object = None) -> None:
    """Show the frame of the bundle at the time of ``scene``."""
    seconds = (scene.frame_current - scene.frame_start) * scene.render.fps_base / scene.render.fps
    index = round(seconds * bundle.text["rate"])
    means, covariances, _ = bundle.frame(min(max(index, 0), len(bundle.nodes) - 1))
    squares, axes = np.linalg.eigh(covariances[visible])
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    mesh.attributes["position"].data.foreach_set("vector", means[visible].astype(np.float32).ravel())
    sizes = SIGMAS * np.sqrt(np.maximum(squares, 0))
    mesh.attributes["size"].data.foreach_set("vector", sizes.astype(np.float32).ravel())
    mesh.attributes["turn"].data.foreach_set("value", _quaternions(axes).astype(np.float32).ravel())
    mesh.update()


def _quaternions(axes: np.ndarray) -> np.ndarray:
    """(n, 4) w, x, y, z of rotations (n, 3, 3): the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = axes.transpose(1, 2, 0)
    rows = [[a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g]]
    rows += [[c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e]]
    return np.linalg.eigh(np.array(rows).transpose(2, 0, 1))[1][:, :, -1]


def _ellipsoids() -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new("ellipsoids", "GeometryNodeTree")
    for side in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    names = ("NodeGroupInput", "GeometryNodeInstanceOnPoints", "GeometryNodeMeshIcoSphere", "GeometryNodeSetMaterial")
    points, instances, ball, painted = (tree.nodes.new(name) for name in names)
    ball.inputs["Subdivisions"].default_value = 2
    painted.inputs["Material"].default_value = _material()
    for name, kind, socket in (("turn", "QUATERNION", "Rotation"), ("size", "FLOAT_VECTOR", "Scale")):
        read = tree.nodes.new("GeometryNodeInputNamedAttribute")
        read.data_type = kind
        read.inputs["Name"].default_value = name
        tree.links.new(read.outputs["Attribute"], instances.inputs[socket])
    tree.links.new(points.outputs[0], instances.inputs["Points"])
    tree.links.new(ball.outputs["Mesh"], painted.inputs["Geometry"])
    tree.links.new(painted.outputs["Geometry"], instances.inputs["Instance"])
    tree.links.new(instances.outputs["Instances"], tree.nodes.new("NodeGroupOutput").inputs[0])
    return tree


def _material() -> bpy.types.Material:
    material = bpy.data.materials.new("splats")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    read, glow, out = (nodes.new(f"ShaderNode{kind}") for kind in ("Attribute", "Emission", "OutputMaterial"))
    read.attribute_type, read.attribute_name = "INSTANCER", "colour"
    links.new(read.outputs["Color"], glow.inputs["Color"])
    links.new(glow.outputs["Emission"], out.inputs["Surface"])
    return material


splats.modifiers.new("ellipsoids", "NODES").node_group = _ellipsoids()
scene = bpy.context.scene
scene.render.fps = round(bundle.text["rate"])
scene.frame_start, scene.frame_end = 0, len(bundle.nodes) - 1
bpy.app.handlers.frame_change_pre.append(show)
scene.frame_set(0)
