"""Cage supplied by the user: a tetrahedral mesh from a file, in the frame and units of the capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.tetmesh import TetMesh, edge_graph
from egs_warp.io.limits import MAX_COORDINATE, read_bytes
from egs_warp.meshing.cage import MAX_NODES, MIN_NODES

_FORMATS = (".mesh", ".msh", ".vtu")
"""Name endings of the supported formats."""
_MAX_BYTES = 64 * 2**20
"""Maximum size of a file, bytes; as text, ``MAX_NODES`` nodes need some 10 MB."""
_BELOW_GROUND = 0.01
"""Maximum depth of a node below the ground, as a fraction of the height of the mesh. Nodes below the ground are moved
up to it."""


def read_cage_mesh(path: Path) -> TetMesh:
    """Read the tetrahedra of a Medit, Gmsh or VTK (XML) file; nodes that belong to no tetrahedron are left out.

    Raises:
        UserError: the file is not such a mesh, or it has too few or too many nodes, several parts, or tetrahedra that
            are flat or inverted.
    """
    import meshio

    if path.suffix.lower() not in _FORMATS:
        raise UserError(f"{path}: a cage is a file of tetrahedra; give one of {', '.join(_FORMATS)}")
    read_bytes(path, at_most=_MAX_BYTES)
    try:
        mesh = meshio.read(path)
        points = np.asarray(mesh.points, np.float64)
        tets = np.concatenate([cells.data for cells in mesh.cells if cells.type == "tetra"] or [np.zeros((0, 4), int)])
        nodes, tets = _used(points, tets.astype(np.int64))
    # meshio raises many kinds of errors, and calls ``sys.exit`` for some of them.
    except (Exception, SystemExit) as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(f"{path}: cannot be read as a mesh ({reason[0][:200]}); write it again") from error
    if not MIN_NODES <= len(nodes) <= MAX_NODES:
        raise UserError(f"{path}: its tetrahedra have {len(nodes)} nodes; give a mesh with {MIN_NODES} to {MAX_NODES}")
    if nodes.shape[1] != 3 or not (np.abs(nodes) <= MAX_COORDINATE).all():
        raise UserError(f"{path}: a node does not have three finite coordinates; write it again")
    corners = nodes[tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    turned = volumes <= 0.0 if np.median(volumes) > 0.0 else volumes >= 0.0
    if turned.any():
        x, y, z = corners[turned][0].mean(axis=0)
        raise UserError(
            f"{path}: {int(turned.sum())} of {len(tets)} tetrahedra are flat or turned inside out, the first at"
            f" [{x:g}, {y:g}, {z:g}]; move their nodes apart"
        )
    made = TetMesh.oriented(nodes, tets)
    parts, _ = connected_components(edge_graph(made), directed=False)
    if parts > 1:
        raise UserError(f"{path}: the mesh has {parts} parts; give a mesh in one piece")
    return made


def read_cage_in(path: Path, frame: BodyFrame) -> TetMesh:
    """Read a cage like ``read_cage_mesh``, and return it in the body's ``frame``, above z = 0.

    Raises:
        UserError: as for ``read_cage_mesh``, or a node lies below the ground.
    """
    mesh = read_cage_mesh(path)
    nodes = frame.points(mesh.nodes)
    height = float(np.ptp(nodes[:, 2]))
    lowest = int(np.argmin(nodes[:, 2]))
    if nodes[lowest, 2] < -_BELOW_GROUND * height:
        x, y, z = mesh.nodes[lowest]
        raise UserError(
            f"{path}: the node at [{x:g}, {y:g}, {z:g}] is below the ground by {-nodes[lowest, 2] / height:.2g} times"
            " the height of the mesh; move it up, and check that the mesh is in the capture's coordinates"
        )
    nodes[:, 2] = np.maximum(nodes[:, 2], 0.0)
    return TetMesh.oriented(nodes, mesh.tets)


def _used(points: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that are corners of ``tets``, and the tetrahedra with indices into these points.

    Raises:
        IndexError: an index is out of range.
    """
    if tets.size and not 0 <= tets.min() <= tets.max() < len(points):
        raise IndexError("a tetrahedron has a node that is missing")
    used, corners = np.unique(tets, return_inverse=True)
    return points[used], corners.reshape(-1, 4)
