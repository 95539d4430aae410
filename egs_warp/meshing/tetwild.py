"""Tetrahedral meshes by fTetWild."""

from __future__ import annotations

import sys
import tempfile
import types
from collections.abc import Callable
from contextlib import chdir
from typing import Any, Protocol

import numpy as np
from skimage import measure

from egs_warp.errors import UserError
from egs_warp.geometry.tetmesh import TetMesh


class SampledField(Protocol):
    """Signed distance function, sampled on a lattice."""

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (nx, ny, nz) on the lattice, negative inside, with layer 0 in the plane; and the position
        (3,) of its first point."""
        ...


def flat_bottomed_surface(field: SampledField) -> tuple[np.ndarray, np.ndarray]:
    """Return marching-cubes vertices (v, 3) and outward faces (f, 3) of the field, closed by an exactly flat bottom at
    z = 0."""
    values, start = field.samples()
    closed = np.concatenate([np.full_like(values[:, :, :1], 2.0), values], axis=2)
    vertices, faces, _, _ = measure.marching_cubes(closed, 0.0)
    vertices = vertices.astype(np.float64) + start - [0.0, 0.0, 1.0]
    vertices[:, 2] = np.maximum(vertices[:, 2], 0.0)
    return vertices, faces[:, ::-1].astype(np.int32)


def tetwild(field: SampledField, target_nodes: int) -> TetMesh | None:
    """Build a mesh of about ``target_nodes`` nodes with fTetWild; return None if it fails. Two runs give different
    meshes."""
    vertices, faces = flat_bottomed_surface(field)
    tetrahedralize = _tetrahedralize()
    edge_length = 0.05 * (600.0 / target_nodes) ** 0.5
    try:
        # fTetWild writes a file with a fixed name into the working directory.
        with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
            nodes, tets = tetrahedralize(
                vertices,
                faces,
                edge_length_fac=edge_length,
                coarsen=True,
                epsilon=5e-3,
                stop_energy=10.0,
                num_opt_iter=40,
                num_threads=1,
            )
        # fTetWild may move nodes of the bottom within its tolerance, so they are moved back into the plane.
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        nodes[np.abs(nodes[:, 2]) < 6e-3 * diagonal, 2] = 0.0
        return TetMesh.oriented(nodes, tets)
    except (RuntimeError, ValueError, UserError):
        return None


def _tetrahedralize() -> Callable[..., Any]:
    """Import and return the meshing function of pytetwild.

    pytetwild 0.4.2 imports pyvista, and thereby all of VTK, for an accessor that is not used here, although its
    metadata declare pyvista as optional. An empty module replaces pyvista during the import.
    """
    try:
        import pyvista  # noqa: F401
    except ImportError:
        sys.modules["pyvista"] = types.ModuleType("pyvista")
        try:
            from pytetwild.pytetwild import tetrahedralize
        finally:
            del sys.modules["pyvista"]
    else:
        from pytetwild.pytetwild import tetrahedralize
    return tetrahedralize
