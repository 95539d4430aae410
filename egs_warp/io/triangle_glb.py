"""Triangle meshes in binary glTF 2.0 files: named parts without materials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.glb import write_container
from egs_warp.io.gltf import BINARY_CHUNK, EXTENSION, JSON_CHUNK, check_required, is_glb
from egs_warp.io.gltf_nodes import INSTANCING, placements
from egs_warp.io.limits import read_bytes
from egs_warp.io.text import parse_json

_FLOAT, _INTEGER = 5126, 5125
_INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}
_TRIANGLES = 4
_MAX_TRIANGLES = 1 << 21
"""Maximum number of triangles of a file."""


@dataclass(frozen=True)
class TriangleMesh:
    """A named mesh."""

    name: str
    vertices: np.ndarray
    """(V, 3) float64, positions of the vertices."""
    faces: np.ndarray
    """(F, 3) int, vertex indices of the triangles, wound outwards if the mesh is closed."""


def write_triangle_glb(path: Path | str, meshes: Sequence[TriangleMesh]) -> None:
    """Write the meshes, each as a node. Raises ``UserError`` if the file cannot be written."""
    pieces: list[bytes] = []
    views: list[dict[str, object]] = []
    accessors: list[dict[str, object]] = []
    start = 0
    for mesh in meshes:
        points, indices = mesh.vertices.astype("<f4"), mesh.faces.astype("<u4").reshape(-1, 1)
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        for values, kind, shape, target, extra in (
            (points, _FLOAT, "VEC3", 34962, bounds),
            (indices, _INTEGER, "SCALAR", 34963, {}),
        ):
            piece = values.tobytes()
            views.append({"buffer": 0, "byteOffset": start, "byteLength": len(piece), "target": target})
            accessors.append(
                {"bufferView": len(views) - 1, "componentType": kind, "count": len(values), "type": shape, **extra}
            )
            pieces.append(piece)
            start += len(piece)
    text = {
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh.name, "mesh": k} for k, mesh in enumerate(meshes)],
        "meshes": [
            {"name": mesh.name, "primitives": [{"attributes": {"POSITION": 2 * k}, "indices": 2 * k + 1}]}
            for k, mesh in enumerate(meshes)
        ],
        "accessors": accessors,
        "bufferViews": views,
    }
    write_container(path, text, b"".join(pieces))


def read_triangle_glb(path: Path | str) -> list[TriangleMesh]:
    """Read the triangles of a .glb, with the transforms of its nodes; materials, skins and animations are ignored.

    Raises ``UserError`` if the file is not a .glb of uncompressed triangles, or is damaged.
    """
    path = Path(path)
    data = read_bytes(path)
    if not is_glb(data) or len(data) < 20:
        raise UserError(f"{path}: not a .glb file; export the mesh as .glb (binary glTF 2.0)")
    chunks: dict[int, bytes] = {}
    place = 12
    while place + 8 <= len(data):
        length, kind = (int(number) for number in np.frombuffer(data, "<u4", 2, place))
        chunks.setdefault(kind, data[place + 8 : place + 8 + length])
        place += 8 + length
    tree: Any = parse_json(chunks.get(JSON_CHUNK, b"").decode("utf-8", "replace"), path)
    try:
        meshes = _meshes(tree, chunks.get(BINARY_CHUNK, b""), path)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: its glTF is damaged ({type(error).__name__}: {error}); export it again") from error
    if not meshes:
        raise UserError(f"{path}: it has no triangles; export a mesh")
    return meshes


def _meshes(tree: Mapping[str, Any], binary: bytes, source: Path) -> list[TriangleMesh]:
    # For example, quantised or packed positions would be taken for other numbers.
    check_required(tree, source, (INSTANCING, EXTENSION), "uncompressed")

    def accessor(number: int) -> np.ndarray:
        entry = tree["accessors"][number]
        if "sparse" in entry or "bufferView" not in entry:
            raise UserError(
                f"{source}: accessor {number} is sparse or compressed, which is not supported; export it uncompressed"
            )
        view = tree["bufferViews"][entry["bufferView"]]
        kind = "<f4" if entry["componentType"] == _FLOAT else _INDEX_TYPES[entry["componentType"]]
        width, count = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]], entry["count"]
        size = np.dtype(kind).itemsize
        stride = view.get("byteStride", size * width)
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        if count < 1 or start < 0 or start + (count - 1) * stride + size * width > len(binary):
            raise UserError(f"{source}: accessor {number} extends beyond the file; copy or export it again")
        return np.ndarray((count, width), kind, binary, start, (stride, size))

    found, total = [], 0
    for placed in placements(dict(tree), source, accessor, lambda mesh: True):
        mesh = tree["meshes"][placed.mesh]
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
                continue
            points = accessor(primitive["attributes"]["POSITION"]).astype(np.float64)
            indices = accessor(primitive["indices"]) if "indices" in primitive else np.arange(len(points))[:, None]
            faces = indices.astype(np.int64).reshape(-1, 3)
            if not np.isfinite(points).all() or faces.max() >= len(points):
                raise UserError(
                    f"{source}: mesh {placed.mesh} has a vertex that is not finite, or a triangle with too large an"
                    f" index ({faces.max()}, but there are {len(points)} vertices); export it again"
                )
            total += len(faces) * len(placed.transforms)
            if total > _MAX_TRIANGLES:
                raise UserError(f"{source}: more than {_MAX_TRIANGLES} triangles; simplify the mesh")
            for transform in placed.transforms:
                flipped = np.linalg.det(transform[:3, :3]) < 0.0
                found.append(
                    TriangleMesh(
                        str(mesh.get("name", "")),
                        points @ transform[:3, :3].T + transform[:3, 3],
                        faces[:, ::-1] if flipped else faces,
                    )
                )
    return found
