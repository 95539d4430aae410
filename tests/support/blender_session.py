"""Script for Blender's Python: install the extension, import a run, play it, edit muscles and render.

Arguments: the extension, the run or bundle, a folder for the results, and the frame. The results are written as JSON.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

ATTRIBUTES = (
    "opacity",
    *(f"{name}_{i}" for name, count in (("f_dc", 3), ("scale", 3), ("rot", 4)) for i in range(count)),
)


def evaluated_splats(splats: Any) -> dict[str, np.ndarray]:
    """Return positions and attributes of the evaluated mesh, which other add-ons read."""
    mesh = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    arrays = {"positions": np.empty(3 * len(mesh.vertices), np.float32)}
    mesh.vertices.foreach_get("co", arrays["positions"])
    for name in ATTRIBUTES:
        arrays[name] = np.empty(len(mesh.vertices), np.float32)
        mesh.attributes[name].data.foreach_get("value", arrays[name])
    return arrays


def positions(part: Any) -> list[list[float]]:
    return [list(vertex.co) for vertex in part.data.vertices]


def edit(root: Any) -> None:
    """Edit the run as a user would: remove the first muscle, move the second one, draw another one, and widen the
    cage."""
    (home,) = root.users_collection
    (rest,) = home.children
    (cage,) = (thing for thing in rest.objects if thing.type == "MESH")
    first, second, third = [thing for thing in rest.objects if thing.type == "CURVE"][:3]
    bpy.data.objects.remove(first)
    second.location.z += 0.01
    drawn = bpy.data.objects.new("drawn", third.data.copy())
    rest.objects.link(drawn)
    drawn.parent, drawn["strength"] = root, 3.0
    for vertex in cage.data.vertices:
        vertex.co.x *= 1.05


def main(extension: str, source: str, out: str, frame: int) -> None:
    """Write results.json, splats.npz, muscles.json, picture.png and scene.blend into ``out``."""
    folder, scene = Path(out), None
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=extension, repo="user_default", enable_on_install=True)
    bpy.ops.import_scene.egs_warp(filepath=source)
    scene, root = bpy.context.scene, bpy.context.view_layer.objects.active
    scene.frame_set(frame)
    parts = {part.egs_warp.part: part for part in root.children if part.egs_warp.part}
    np.savez(folder / "splats.npz", **evaluated_splats(parts["splats"]))  # pyright: ignore[reportArgumentType]
    results: dict[str, Any] = {"range": [scene.frame_start, scene.frame_end], "rate": scene.render.fps}
    results["cage"] = positions(parts["cage"])
    if "muscles" in parts:
        results["muscles"] = positions(parts["muscles"])
        results["forces"] = positions(parts["contact forces"])
        results["com"] = list(parts["centre of mass"].location)
        edit(root)
        results["export"] = list(bpy.ops.export_scene.egs_warp_muscles(filepath=str(folder / "muscles.json")))
        results["export of the cage"] = list(bpy.ops.export_scene.egs_warp_cage(filepath=str(folder / "cage.mesh")))
        scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 8, False
        scene.render.film_transparent = True
        scene.render.resolution_x = scene.render.resolution_y = 96
        scene.render.filepath = str(folder / "picture.png")
        bpy.ops.render.render(write_still=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))
    bpy.context.scene.frame_set(0)
    again = next(each for each in bpy.data.objects if each.egs_warp.part == "cage")
    results["reopened cage at 0"] = positions(again)
    (folder / "results.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
