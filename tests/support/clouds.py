"""Gaussians on the surface of a mesh."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh


def surface_cloud(mesh: TetMesh, count: int, *, lowest: float = 0.0, scale: float = 0.01) -> GaussianCloud:
    """Return ``count`` Gaussians with random rotations on the surface of the mesh; the heights of their means are at
    least ``lowest`` m."""
    rng = np.random.default_rng(0)
    faces = mesh.boundary_faces()
    shares = rng.dirichlet([1.0, 1.0, 1.0], count)
    means = np.einsum("ni,nij->nj", shares, mesh.nodes[faces[rng.integers(len(faces), size=count)]])
    means[:, 2] = np.maximum(means[:, 2], lowest)
    return GaussianCloud.from_numpy(
        means,
        rng.standard_normal((count, 4)),
        np.log(scale * rng.uniform(0.3, 1.0, (count, 3))),
        rng.uniform(-2, 3, count),
        np.zeros((count, 1, 3)),
        device="cpu",
    )
