"""Export of the motion of a cage as a skinned mesh in glTF, for engines that do not draw splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.deformation.embedding import embed_points
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.limits import MAX_COORDINATE, read_bytes
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.io.skinned_glb import SkinnedMesh, write_skinned_glb
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.pipelines.export import Y_UP, chosen_frames
from egs_warp.pipelines.finished_run import FinishedRun

ENDING = ".glb"
MESH_FORMATS = (".obj", ".ply", ".stl", ".off")
"""Name endings of the supported mesh files."""
_MAX_BYTES = 512 * 2**20


def export_skin(run: FinishedRun, path: Path, *, every: int = 1, mesh: Path | None = None) -> None:
    """Write a mesh and its deformation by the cage of ``run`` to a binary glTF file: metres, y up
    (docs/guide/engines.md).

    Args:
        run: The run to export.
        path: Name that ends in .glb.
        every: Interval of the exported frames, in frames at 60 Hz.
        mesh: File of triangles in the frame and units of the capture; None uses the surface of the cage. Vertices
            outside the cage move with the nearest point of it.

    Raises:
        UserError: ``path`` has another ending, or ``mesh`` cannot be read.
    """
    check_no_file_of_a_run(path)
    if path.suffix.lower() != ENDING:
        raise UserError(f"{path}: give a name that ends in {ENDING}")
    frames = chosen_frames(run, frame=None, every=every)
    write_skinned_glb(path, skin_of(run, frames, mesh=mesh))


def skin_of(run: FinishedRun, frames: np.ndarray, *, mesh: Path | None = None) -> SkinnedMesh:
    """Return the mesh with the positions of its joints in ``frames`` (K,); for the other arguments see
    ``export_skin``."""
    t = run.trajectory
    if mesh is None:
        used, faces = np.unique(run.mesh.boundary_faces(), return_inverse=True)
        vertices, faces = t.rest_positions[used], faces.reshape(-1, 3)
    else:
        vertices, faces = read_triangles(mesh, BodyFrame(t.body_axes, t.body_origin, t.metres_per_unit))
    joints, weights = _weights(run.mesh, vertices)
    nodes = t.positions[run.steps[frames]]
    centre = t.node_mass @ t.rest_positions / t.node_mass.sum()
    centres = np.einsum("n,kni->ki", t.node_mass, nodes) / t.node_mass.sum()
    turns = Rotation.concatenate(
        [
            Rotation.align_vectors(frame - middle, t.rest_positions - centre, weights=t.node_mass)[0]
            for frame, middle in zip(nodes, centres, strict=True)
        ]
    )
    matrices = turns.as_matrix()
    origins = centres - matrices @ centre
    local = (nodes - origins[:, None]) @ matrices
    upright = Rotation.from_matrix(Y_UP.axes)
    rotations = (upright * turns * upright.inv()).as_quat()
    # Choose the sign of each quaternion so that its dot product with the previous one is not negative; otherwise, some
    # programs would interpolate through zero.
    signs = np.cumprod(np.sign(np.einsum("ki,ki->k", rotations[1:], rotations[:-1])))
    rotations[1:] *= np.where(signs == 0.0, 1.0, signs)[:, None]
    return SkinnedMesh(
        name="cage" if mesh is None else mesh.stem,
        vertices=Y_UP.points(vertices),
        normals=_normals(vertices, faces) @ Y_UP.axes.T,
        faces=faces,
        joints=joints,
        weights=weights,
        rest_joints=Y_UP.points(t.rest_positions),
        times=frames / FRAME_RATE,
        root_rotations=rotations,
        root_positions=Y_UP.points(origins),
        joint_positions=local @ Y_UP.axes.T,
    )


def read_triangles(path: Path, frame: BodyFrame) -> tuple[np.ndarray, np.ndarray]:
    """Read a mesh: vertices (V, 3) in ``frame``, m, and triangles (F, 3). Raises ``UserError`` if ``path`` is not a
    readable mesh of triangles or quadrilaterals."""
    import meshio

    if path.suffix.lower() not in MESH_FORMATS:
        raise ArgumentError("mesh", f"give a file of triangles, one of {', '.join(MESH_FORMATS)}", value=path)
    read_bytes(path, at_most=_MAX_BYTES)
    try:
        read = meshio.read(path)
        points = np.asarray(read.points, np.float64)
        pieces = [cells.data for cells in read.cells if cells.type == "triangle"]
        pieces += [cells.data[:, corners] for cells in read.cells if cells.type == "quad" for corners in _HALVES]
        faces = np.concatenate(pieces).astype(np.int64)
    # meshio raises many kinds of errors, and calls ``sys.exit`` for some of them.
    except (Exception, SystemExit) as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(f"{path}: cannot be read as a mesh of triangles ({reason[0][:200]}); write it again") from error
    is_valid = (np.abs(points) <= MAX_COORDINATE).all(axis=1) & (points.shape[1] == 3)
    if not is_valid.all():
        number = int(np.argmin(is_valid))
        raise UserError(
            f"{path}: vertex {number} is at {points[number].tolist()}; give three finite coordinates, at most"
            f" {MAX_COORDINATE:g}"
        )
    if len(faces) == 0:
        raise UserError(f"{path}: it has no triangles; give a mesh that has some")
    if faces.min() < 0 or faces.max() >= len(points):
        raise UserError(
            f"{path}: a triangle refers to a missing vertex (indices {faces.min()} to {faces.max()}, {len(points)}"
            " vertices); write it again"
        )
    return frame.points(points), faces


_HALVES = ([0, 1, 2], [0, 2, 3])
"""Corners of the two triangles of a quadrilateral."""


def _weights(cage: TetMesh, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four nodes and the weights (V, 4) of each vertex.

    glTF allows no negative weights, which vertices outside the cage would need for linear extrapolation. Negative
    weights are therefore replaced by zero.
    """
    embedding = embed_points(cage, vertices, device="cpu")
    weights = np.maximum(embedding.weights.numpy(), 0.0)
    # glTF requires joint 0 where the weight is 0.
    nodes = np.where(weights > 0.0, embedding.nodes.numpy(), 0)
    return nodes, weights / weights.sum(axis=1, keepdims=True)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    # A vertex that belongs to no face is not drawn, but its normal must still be a unit vector.
    return np.where(lengths > 0.0, normals / np.maximum(lengths, 1e-300), [0.0, 0.0, 1.0])
