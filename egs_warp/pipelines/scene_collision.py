"""The collision mesh of a scene: obstacles and ground as a .glb in the frame of the capture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.box_cover import cover_with_boxes
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.io.triangle_glb import TriangleMesh, read_triangle_glb, write_triangle_glb
from egs_warp.meshing.level_set import MIN_CELLS, level_set_of_surface
from egs_warp.pipelines.scene_obstacles import SceneObstacles, box_between

GROUND_NAME = "ground"
"""Name of the mesh of the ground in the file."""
MAX_FACES = 400
"""Maximum number of faces of all obstacles. The time of contact detection is proportional to it."""
_CONVEX = 1.05
"""Maximum ratio of the volume of the convex hull to the volume of a part that counts as convex."""
_MAX_HULL_FACES = 48
"""Maximum number of faces of a convex part; a part with more is enclosed by planes in 26 directions."""
_CELLS = 24
"""Number of cells along the longest side of a part that is not convex."""
_BOXES_OF_PART = 16
"""Maximum number of boxes that replace a part that is not convex."""
_MIN_RADIUS = 1e-6
"""Minimum radius of a ball that fits into a solid for the solid to be written, relative to the measured box."""
_SAME_PLANE = 1e-4
"""Maximum difference of the normals of faces in one plane, and of their offsets relative to the size."""


def write_collision_mesh(path: Path | str, obstacles: SceneObstacles, frame: BodyFrame) -> None:
    """Write obstacles and ground as a .glb in the frame and units of the capture: a mesh for each solid, and an open
    mesh named ``ground``. Parts outside the measured box are left out.

    Args:
        path: The file.
        obstacles: Ground and obstacles in the frame of the world.
        frame: Frame of the world in the capture.
    """
    parts = [TriangleMesh(GROUND_NAME, *_ground_mesh(obstacles))]
    bounds = box_between(obstacles.low, obstacles.high)
    least = _MIN_RADIUS * float((obstacles.high - obstacles.low).max())
    for number, solid in enumerate(obstacles.solids, start=1):
        bounded = Solid((*solid.faces, *bounds.faces))
        if _inner_ball(_rows(bounded))[1] > least:
            parts.append(TriangleMesh(f"solid-{number}", *solid_mesh(bounded)))
    write_triangle_glb(
        path, [TriangleMesh(each.name, frame.capture_points(each.vertices), each.faces) for each in parts]
    )


def read_collision_mesh(path: Path | str) -> tuple[Solid, ...]:
    """Read obstacles from a .glb in the frame and units of the capture.

    Each connected part becomes a convex solid; a part that is not convex is replaced by boxes along the axes of the
    capture. A mesh named ``ground`` is ignored, because the ground is measured.

    Raises:
        UserError: The file is invalid, a part has no volume, or there are too many faces.
    """
    parts = [each for mesh in read_triangle_glb(path) if mesh.name != GROUND_NAME for each in _connected(mesh)]
    solids = [solid for number, part in enumerate(parts, start=1) for solid in _solids_of(part, path, number)]
    count = sum(len(solid.faces) for solid in solids)
    if count > MAX_FACES:
        raise UserError(
            f"{path}: its obstacles have {count} faces, the limit is {MAX_FACES}; simplify the mesh, or leave"
            " out what is far from the objects"
        )
    return tuple(solids)


def solid_mesh(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) and triangles (F, 3), wound outwards, of a bounded solid."""
    rows = _rows(solid)
    corners = HalfspaceIntersection(rows, _inner_ball(rows)[0]).intersections
    hull = ConvexHull(corners)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    return corners[used], _outward(corners[used], faces.reshape(-1, 3))


def _rows(solid: Solid) -> np.ndarray:
    return np.array([[*face.normal, face.offset] for face in solid.faces])


def _inner_ball(rows: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the centre (3,) and the radius of the largest ball inside the half spaces ``rows`` (n, 4) of a bounded
    solid. The radius is 0 or less if they have no common interior."""
    from scipy.optimize import linprog

    result = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([rows[:, :3], np.ones(len(rows))]),
        b_ub=-rows[:, 3],
        bounds=[(None, None)] * 4,
    )
    return result.x[:3], float(result.x[3])


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the ``faces`` (F, 3) of a convex body, wound outwards."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fi,fi->f", normals, corners[:, 0] - vertices.mean(axis=0)) < 0.0
    return np.where(inward[:, None], faces[:, ::-1], faces)


def _ground_mesh(obstacles: SceneObstacles) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of the ground within the measured box."""
    low, high = obstacles.low, obstacles.high
    field = obstacles.ground or HeightField.through(
        np.eye(3), np.append(low[:2], 0.0), float((high - low)[:2].max()) / 2.0, np.zeros((3, 3))
    )
    nodes = field.nodes()
    rows, columns = nodes.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    corners = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    a, b, c, d = (each.ravel() for each in corners)
    return nodes.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _connected(mesh: TriangleMesh) -> list[TriangleMesh]:
    """Return the connected parts of a mesh, after merging equal vertices."""
    vertices, merged = np.unique(mesh.vertices.astype(np.float32), axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    labels = connected_components(graph, directed=False)[1]
    parts = []
    for label in np.unique(labels[faces[:, 0]]):
        used, own = np.unique(faces[labels[faces[:, 0]] == label], return_inverse=True)
        parts.append(TriangleMesh(mesh.name, vertices[used].astype(np.float64), own.reshape(-1, 3)))
    return parts


def _solids_of(part: TriangleMesh, path: Path | str, number: int) -> Sequence[Solid]:
    """Return the convex solids of a connected part."""
    size = float(np.ptp(part.vertices, axis=0).max())
    try:
        hull = ConvexHull(part.vertices)
    except QhullError as error:
        raise UserError(f"{path}: part {number} ({part.name or 'without a name'}) is flat; give it a volume") from error
    corners = part.vertices[part.faces] - part.vertices.mean(axis=0)
    volume = abs(float(np.linalg.det(corners).sum())) / 6.0
    if hull.volume <= _CONVEX * volume:
        return [_convex(hull, part.vertices, size)]
    level_set = level_set_of_surface(part.vertices, part.faces, cells=MIN_CELLS)
    spacing = size / _CELLS
    low = part.vertices.min(axis=0) + 0.5 * spacing
    counts = np.maximum(np.ceil(np.ptp(part.vertices, axis=0) / spacing).astype(int), 1)
    cells = low + spacing * np.moveaxis(np.indices(tuple(counts.tolist())), 0, -1)
    inside = level_set.evaluate(cells.reshape(-1, 3))[0].reshape(counts) < 0.25 * spacing
    cover = cover_with_boxes(inside, max_boxes=_BOXES_OF_PART)
    return [box_between(low + spacing * (box[0] - 0.5), low + spacing * (box[1] - 0.5)) for box in cover.boxes]


def _convex(hull: ConvexHull, vertices: np.ndarray, size: float) -> Solid:
    """Return the solid of a convex hull, with one face for all triangles in one plane."""
    rows: list[np.ndarray] = []
    scale = np.array([1.0, 1.0, 1.0, 1.0 / size])
    for row in hull.equations:
        if not any(np.abs((row - other) * scale).max() < _SAME_PLANE for other in rows):
            rows.append(row)
    if len(rows) > _MAX_HULL_FACES:
        directions = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        directions = directions[np.abs(directions).sum(axis=1) > 0.0]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return Solid(tuple(Plane(each, -float((vertices @ each).max())) for each in directions))
    return Solid(tuple(Plane.from_coefficients(*row) for row in rows))
