"""Objects with true meshes, solid textures and gloss for Table 1 and Figure 8."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness import data_folder

Paint = Callable[[np.ndarray], np.ndarray]
"""Solid texture: function that returns colours (P, 3), 0 to 1, at points (P, 3) of the rest shape."""
MAX_EDGE_LENGTH = 0.02
"""Maximum edge length on an object of height 1. In a bend by 80 degrees, the midpoint of an edge of this length
deviates by 7e-5 from the true surface."""


@dataclass(frozen=True)
class PaintedMesh:
    """A triangle mesh, z up, on the plane z = 0, 1 high, with a solid texture."""

    name: str
    vertices: np.ndarray
    """(V, 3) float64, vertices."""
    faces: np.ndarray
    """(F, 3) int32, triangles as indices of vertices."""
    paint: Paint
    glossy: bool = False
    """True if the mesh is lit by lamps that rotate with each part of the body. A capture stores light in this form."""


def checkers(cell: float, colours: tuple[tuple[float, ...], ...]) -> Paint:
    """Solid texture of cubes with side ``cell`` in two colours, with a tint that varies with height."""

    def paint(points: np.ndarray) -> np.ndarray:
        parity = np.floor(points / cell + 1e-6).astype(int).sum(axis=1) % 2
        tint = 0.12 * np.sin(7.0 * points[:, 2:3] + np.array([0.0, 2.0, 4.0]))
        return np.clip(np.array(colours)[parity] + tint, 0.0, 1.0)

    return paint


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) - 1 for word in words[1:]]
            faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
    return np.array(vertices), np.array(faces, dtype=np.int32)


def _read_glb(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the first mesh of a binary glTF file with one buffer, in the axes of the mesh."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    described, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    part = described["meshes"][0]["primitives"][0]

    def rows(number: int, form: str, columns: int) -> np.ndarray:
        accessor = described["accessors"][number]
        view = described["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", np.dtype(form).itemsize * columns)
        return np.ndarray((accessor["count"], columns), form, body, start, (stride, np.dtype(form).itemsize))

    vertices = rows(part["attributes"]["POSITION"], "<f4", 3).astype(np.float64)
    return vertices, rows(part["indices"], "<u4", 1).reshape(-1, 3).astype(np.int32)


def standing(vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the offset to subtract from ``vertices`` (V, 3) so that they stand on z = 0 at the origin, and the factor
    that then scales them to a height of 1."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    return np.array([*((lower + upper)[:2] / 2), lower[2]]), 1.0 / float(upper[2] - lower[2])


def _standing(vertices: np.ndarray) -> np.ndarray:
    middle, scale = standing(vertices)
    return (vertices - middle) * scale


def subdivided(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Subdivide edges until none is longer than ``MAX_EDGE_LENGTH``.

    The deformed mesh is the ground truth, and a long edge would stay straight where the surface bends.
    """
    while True:
        sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
        long = np.linalg.norm(vertices[sides[..., 0]] - vertices[sides[..., 1]], axis=2) > MAX_EDGE_LENGTH
        if not long.any():
            return vertices, faces.astype(np.int32)
        edges, edge_from_side = np.unique(np.sort(sides[long], axis=1), axis=0, return_inverse=True)
        middle = np.full(faces.shape, -1)
        middle[long] = len(vertices) + edge_from_side.ravel()
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        count = long.sum(axis=1)
        parts = [faces[count == 0]]
        # Permute the corners cyclically so that a single subdivided edge is the first, and a single undivided edge the
        # last.
        for halved in (1, 2, 3):
            chosen = count == halved
            first = {1: long.argmax(axis=1), 2: (~long).argmax(axis=1) + 1, 3: np.zeros(len(faces), dtype=int)}[halved][
                chosen
            ]
            rotated = (first[:, None] + np.arange(3)) % 3
            x, y, z = np.take_along_axis(faces[chosen], rotated, axis=1).T
            a, b, c = np.take_along_axis(middle[chosen], rotated, axis=1).T
            pieces = {
                1: ((x, a, z), (a, y, z)),
                2: ((x, a, z), (a, y, b), (a, b, z)),
                3: ((x, a, c), (a, y, b), (c, b, z), (a, b, c)),
            }[halved]
            parts += [np.stack(piece, axis=1) for piece in pieces]
        faces = np.concatenate(parts)


def _turned_profile(profile: np.ndarray, around: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Surface of revolution of the (radius, z) polyline ``profile`` about z."""
    angle = np.linspace(0.0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([r * ring, np.full(around, z)]) for r, z in profile])
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, b + around), (a, b + around, a + around))])
    return vertices, faces.astype(np.int32)


def chair() -> PaintedMesh:
    """The armchair with a texture of checkered cloth."""
    vertices, faces = _read_obj(data_folder() / "meshes" / "armchair" / "armchair.obj")
    vertices, faces = subdivided(_standing(vertices[:, [0, 2, 1]] * [1, -1, 1]), faces)
    return PaintedMesh("chair", vertices, faces, checkers(0.07, ((0.75, 0.3, 0.2), (0.9, 0.8, 0.6))))


def plant() -> PaintedMesh:
    """The potted aloe with green leaves and a banded pot."""
    parts = [_read_obj(path) for path in sorted((data_folder() / "meshes" / "plant").glob("*.obj"))]
    starts = np.cumsum([0, *[len(v) for v, _ in parts]])
    faces = np.concatenate([f + start for (_, f), start in zip(parts, starts, strict=False)])
    vertices, faces = subdivided(_standing(np.concatenate([v for v, _ in parts])), faces.astype(np.int32))
    return PaintedMesh("plant", vertices, faces, checkers(0.06, ((0.15, 0.5, 0.2), (0.65, 0.85, 0.4))))


def microphone() -> PaintedMesh:
    """A generated table microphone: a ball on a thin stem with a round foot."""
    foot = [(0.0, 0.0), (0.22, 0.0), (0.22, 0.03), (0.06, 0.06)]
    stem = [(0.03, z) for z in np.linspace(0.08, 0.66, 30)]
    arc = np.linspace(-1.2, np.pi / 2, 24)
    ball = [(0.17 * np.cos(t), 0.83 + 0.17 * np.sin(t)) for t in arc]
    vertices, faces = subdivided(*_turned_profile(np.array([*foot, *stem, *ball])))
    return PaintedMesh("microphone", vertices, faces, checkers(0.06, ((0.15, 0.15, 0.2), (0.75, 0.75, 0.8))))


def spot() -> PaintedMesh:
    """Keenan Crane's cow."""
    vertices, faces = _read_obj(data_folder() / "meshes" / "spot" / "spot_triangulated.obj")
    vertices, faces = subdivided(_standing(vertices[:, [0, 2, 1]] * [1, -1, 1]), faces)
    return PaintedMesh("spot", vertices, faces, checkers(0.07, ((0.9, 0.9, 0.85), (0.35, 0.25, 0.2))))


def stool() -> PaintedMesh:
    """The bar stool."""
    vertices, faces = _read_obj(data_folder() / "meshes" / "stool" / "stools_stool_model_0.obj")
    vertices, faces = subdivided(_standing(vertices), faces)
    return PaintedMesh("stool", vertices, faces, checkers(0.07, ((0.3, 0.35, 0.6), (0.85, 0.75, 0.5))))


def cat() -> PaintedMesh:
    """The Egyptian cat."""
    vertices, faces = _read_glb(data_folder() / "meshes" / "cat" / "cat.glb")
    vertices, faces = subdivided(_standing(vertices[:, [0, 2, 1]] * [1, -1, 1]), faces)
    return PaintedMesh("cat", vertices, faces, checkers(0.06, ((0.3, 0.3, 0.35), (0.8, 0.65, 0.35))))


def vase() -> PaintedMesh:
    """A generated vase with a thin neck."""
    height = np.linspace(0.0, 1.0, 60)
    radius = 0.06 + 0.16 * np.exp(-(((height - 0.3) / 0.18) ** 2)) + 0.05 * height**4
    vertices, faces = subdivided(*_turned_profile(np.array([(0.0, 0.0), *zip(radius, height, strict=True)])))
    return PaintedMesh("vase", vertices, faces, checkers(0.08, ((0.2, 0.35, 0.6), (0.85, 0.85, 0.8))))


def table() -> PaintedMesh:
    """A generated table: a slab on four legs."""
    slab = ((-0.45, -0.3, 0.93), (0.45, 0.3, 1.0))
    legs = [((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, 0.95)) for x in (-0.4, 0.4) for y in (-0.25, 0.25)]
    vertices, faces = subdivided(*_boxes([slab, *legs]))
    return PaintedMesh("table", vertices, faces, checkers(0.07, ((0.5, 0.3, 0.15), (0.8, 0.6, 0.4))))


def slender_chair() -> PaintedMesh:
    """A generated chair with its back towards -x, on four legs whose thickness is 1/25 of its height."""
    seat, back = ((-0.22, -0.22, 0.42), (0.22, 0.22, 0.48)), ((-0.22, -0.22, 0.7), (-0.17, 0.22, 1.0))
    legs = [((x - 0.02, y - 0.02, 0.0), (x + 0.02, y + 0.02, 0.45)) for x in (-0.19, 0.19) for y in (-0.19, 0.19)]
    posts = [((-0.215, y - 0.02, 0.45), (-0.175, y + 0.02, 0.8)) for y in (-0.19, 0.19)]
    paint = checkers(0.07, ((0.2, 0.45, 0.4), (0.85, 0.75, 0.55)))
    return PaintedMesh("slender chair", *subdivided(*_boxes([seat, back, *legs, *posts])), paint)


_Corners = tuple[tuple[float, float, float], tuple[float, float, float]]


def _boxes(corners: Sequence[_Corners]) -> tuple[np.ndarray, np.ndarray]:
    """Boxes between opposite corners, without shared vertices."""
    parts = [_box(low, high) for low, high in corners]
    faces = np.concatenate([part + 8 * number for number, (_, part) in enumerate(parts)])
    return np.concatenate([vertices for vertices, _ in parts]), faces


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
        + [[1, 5, 7], [1, 7, 3]],
        dtype=np.int32,
    )
    return np.where(corners == 0, low, high).astype(float), faces


def bar() -> PaintedMesh:
    """The checkered bar of Figure 8, a quarter as thick as high, with long bricks, which are represented by long
    Gaussians."""
    corners, faces = _box((-0.125, -0.125, 0.0), (0.125, 0.125, 1.0))
    vertices, faces = subdivided(corners, faces)

    def paint(points: np.ndarray) -> np.ndarray:
        # Faces of the bar lie on borders between cells, so colours are sampled slightly inside, where rounding does not
        # change them.
        inside = (points - [0.0, 0.0, 0.5]) * 0.99 + [0.0, 0.0, 0.5]
        parity = np.floor(inside / [0.125, 0.125, 0.25]).astype(int).sum(axis=1) % 2
        return np.where(parity[:, None] == 0, [[0.9, 0.9, 0.85]], [[0.15, 0.2, 0.45]])

    return PaintedMesh("bar", vertices, faces, paint)
