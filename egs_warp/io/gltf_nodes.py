"""Nodes of glTF: the placement of meshes in the scene, with instances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError

INSTANCING = "EXT_mesh_gpu_instancing"
_FLAT = 1e-9
"""Ratio of the smallest to the largest singular value up to which a transform is considered singular."""


@dataclass(frozen=True)
class Placement:
    """Placement of one mesh in the scene."""

    mesh: int
    transforms: np.ndarray
    """(k, 4, 4) affine transforms from the mesh to the scene, one for each instance."""


def placements(
    tree: dict[str, Any], source: Path, accessor: Callable[[int], np.ndarray], is_wanted: Callable[[int], bool]
) -> list[Placement]:
    """Return the placements of the wanted meshes in the default scene, in the order of its nodes.

    If there are no scenes, or the default scene contains no wanted mesh, all nodes are used. A mesh without any node is
    placed by the identity.

    Args:
        tree: JSON tree of the file.
        source: name for messages.
        accessor: function that returns the values (n, width) of an accessor by its index.
        is_wanted: function that returns True for the index of a wanted mesh.

    Raises:
        UserError: the nodes do not form a tree, or a transform is singular or not finite.
    """
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in parents]
    shown = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else roots
    for starts in (shown, roots):
        placed = _placed(nodes, _topmost(starts, parents), source, accessor, is_wanted)
        if placed:
            return placed
    count = len(tree.get("meshes", []))
    return [Placement(mesh, np.eye(4)[None]) for mesh in range(count) if is_wanted(mesh)]


def _topmost(starts: list[int], parents: dict[int, int]) -> list[int]:
    """Return the root nodes of the trees that contain ``starts``. glTF requires a scene to list only root nodes, but
    some files list other nodes."""
    found: dict[int, None] = {}
    seen: set[int] = set()
    for number in starts:
        while number in parents and number not in seen:
            seen.add(number)
            number = parents[number]
        if number not in parents:
            found[number] = None
    return list(found)


def _placed(
    nodes: list[dict[str, Any]],
    roots: list[int],
    source: Path,
    accessor: Callable[[int], np.ndarray],
    is_wanted: Callable[[int], bool],
) -> list[Placement]:
    found = []
    seen: set[int] = set()
    stack = [(number, np.eye(4)) for number in reversed(roots)]
    while stack:
        number, above = stack.pop()
        if number in seen or number < 0:
            raise UserError(f"{source}: its nodes are not a tree: node {number} has two parents; export it again")
        seen.add(number)
        node = nodes[number]
        whole = above @ _transform(node)
        stack.extend((child, whole) for child in reversed(node.get("children", [])))
        mesh = node.get("mesh")
        if mesh is None or not is_wanted(mesh):
            continue
        instancing = node.get("extensions", {}).get(INSTANCING)
        transforms = whole[None] if instancing is None else whole @ _instances(instancing["attributes"], accessor)
        sizes = np.linalg.svd(np.nan_to_num(transforms[:, :3, :3], nan=0.0, posinf=0.0, neginf=0.0), compute_uv=False)
        if not np.isfinite(transforms).all() or (sizes[:, 2] <= _FLAT * sizes[:, 0]).any():
            raise UserError(f"{source}: the transform of a node is singular or not finite; export it again")
        found.append(Placement(mesh, transforms))
    return found


def _instances(attributes: dict[str, int], accessor: Callable[[int], np.ndarray]) -> np.ndarray:
    """Return the transforms (k, 4, 4) of the instances of a node."""
    values = {name: accessor(attributes[name]) for name in ("TRANSLATION", "ROTATION", "SCALE") if name in attributes}
    counts = {len(value) for value in values.values()}
    if len(counts) != 1:
        raise ValueError(f"{INSTANCING} has attributes of {sorted(counts)} instances")
    count = counts.pop()
    transforms = np.tile(np.eye(4), (count, 1, 1))
    if "ROTATION" in values:
        transforms[:, :3, :3] = Rotation.from_quat(values["ROTATION"].astype(float)).as_matrix()
    if "SCALE" in values:
        transforms[:, :3, :3] *= values["SCALE"].astype(float)[:, None, :]
    if "TRANSLATION" in values:
        transforms[:, :3, 3] = values["TRANSLATION"]
    return transforms


def _transform(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() @ np.diag(
        np.array(node.get("scale", [1, 1, 1]), float)
    )
    turn[:3, 3] = node.get("translation", [0, 0, 0])
    return turn
