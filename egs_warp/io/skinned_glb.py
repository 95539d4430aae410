"""Writing of binary glTF 2.0 with a mesh whose joints are the nodes of a cage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.io.glb import write_container

_TYPES = {np.dtype("<f4"): 5126, np.dtype("<u2"): 5123, np.dtype("<u4"): 5125}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_VERTICES, _INDICES = 34962, 34963
"""Targets of the buffer views of vertices and of indices."""


@dataclass(frozen=True)
class SkinnedMesh:
    """A mesh of V vertices that N joints move over K key frames; metres, y up."""

    name: str
    vertices: np.ndarray
    """(V, 3) positions at rest."""
    normals: np.ndarray
    """(V, 3) unit normals at rest."""
    faces: np.ndarray
    """(F, 3) vertex indices of the triangles."""
    joints: np.ndarray
    """(V, 4) indices of the joints that move each vertex."""
    weights: np.ndarray
    """(V, 4) non-negative weights of these joints, with sum 1."""
    rest_joints: np.ndarray
    """(N, 3) positions of the joints at rest."""
    times: np.ndarray
    """(K,) s, times of the key frames."""
    root_rotations: np.ndarray
    """(K, 4) quaternions x, y, z, w, rotation of the whole body."""
    root_positions: np.ndarray
    """(K, 3) translation of the whole body, applied after the rotation."""
    joint_positions: np.ndarray
    """(K, N, 3) positions of the joints before the rotation and translation of the whole body."""


def write_skinned_glb(path: Path, mesh: SkinnedMesh) -> None:
    """Write ``mesh`` as a skin with one animation. Raises ``UserError`` if the file cannot be written.

    The joints of the nodes only translate, so that four barycentric weights move a vertex exactly as its tetrahedron
    does. All of them are children of one joint that rotates with the body, so that the normals rotate, too.
    """
    buffer = _Buffer()
    count = len(mesh.rest_joints)
    attributes = {
        "POSITION": buffer.add(mesh.vertices, target=_VERTICES, has_bounds=True),
        "NORMAL": buffer.add(mesh.normals, target=_VERTICES),
        "JOINTS_0": buffer.add(mesh.joints, "<u2", target=_VERTICES),
        "WEIGHTS_0": buffer.add(mesh.weights, target=_VERTICES),
    }
    indices = buffer.add(mesh.faces.reshape(-1, 1), "<u4", target=_INDICES)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    # The default material of glTF is a metal, which is black without an environment map.
    material = {"name": "surface", "pbrMetallicRoughness": {"metallicFactor": 0.0}}
    inverse = np.tile(np.eye(4), (count, 1, 1))
    # glTF stores matrices in column-major order.
    inverse[:, 3, :3] = -mesh.rest_joints
    skin = {
        "joints": list(range(2, 2 + count)),
        "skeleton": 1,
        "inverseBindMatrices": buffer.add(inverse.reshape(-1, 16)),
    }
    times = buffer.add(mesh.times[:, None], has_bounds=True)
    tracks = [(1, "rotation", mesh.root_rotations), (1, "translation", mesh.root_positions)]
    tracks += [(2 + k, "translation", mesh.joint_positions[:, k]) for k in range(count)]
    samplers = [{"input": times, "output": buffer.add(values)} for _, _, values in tracks]
    channels = [
        {"sampler": k, "target": {"node": node, "path": path_name}} for k, (node, path_name, _) in enumerate(tracks)
    ]
    joints = [{"name": f"node{k}", "translation": place} for k, place in enumerate(mesh.rest_joints.tolist())]
    nodes = [
        {"name": mesh.name, "mesh": 0, "skin": 0},
        {"name": "body", "children": list(range(2, 2 + count))},
        *joints,
    ]
    text = {
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": nodes,
        "meshes": [{"name": mesh.name, "primitives": [primitive]}],
        "materials": [material],
        "skins": [skin],
        "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    }
    write_container(path, text, b"".join(buffer.pieces))


class _Buffer:
    """Arrays of a glTF file, each with its own buffer view and accessor."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self._start = 0

    def add(
        self, values: np.ndarray, dtype: str = "<f4", *, target: int | None = None, has_bounds: bool = False
    ) -> int:
        """Add ``values`` (n, components) and return the index of the accessor."""
        stored = np.ascontiguousarray(values, np.dtype(dtype))
        piece = stored.tobytes()
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self._start, "byteLength": len(piece)}
        if target is not None:
            view["target"] = target
        entry: dict[str, Any] = {"bufferView": len(self.views), "componentType": _TYPES[stored.dtype]}
        entry |= {"count": len(stored), "type": _KINDS[stored.shape[1]]}
        if has_bounds:
            entry |= {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
        self.pieces.append(piece)
        self._start += len(piece)
        self.views.append(view)
        self.accessors.append(entry)
        return len(self.accessors) - 1
