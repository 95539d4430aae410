"""Small generated meshes for tests."""

from __future__ import annotations

import itertools

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh


def block_mesh(nx: int = 3, ny: int = 3, nz: int = 5, size: tuple[float, float, float] = (0.4, 0.4, 1.0)) -> TetMesh:
    """A box centred on the z axis, standing on z = 0: nx x ny x nz nodes, six tetrahedra a cell, irregular inside."""
    axes = [np.linspace(-size[0] / 2, size[0] / 2, nx), np.linspace(-size[1] / 2, size[1] / 2, ny)]
    axes.append(np.linspace(0, size[2], nz))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    index = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    tets = []
    for order in itertools.permutations(range(3)):
        corner = np.zeros(3, int)
        path = [corner.copy()]
        for axis in order:
            corner[axis] += 1
            path.append(corner.copy())
        tets.append(
            np.stack([index[c[0] : nx - 1 + c[0], c[1] : ny - 1 + c[1], c[2] : nz - 1 + c[2]].ravel() for c in path], 1)
        )
    inside = (np.abs(points[:, :2]) < np.array(size[:2]) / 2 - 1e-9).all(1) & (points[:, 2] > 0)
    inside &= points[:, 2] < size[2] - 1e-9
    points[inside] += np.random.default_rng(0).uniform(-0.02, 0.02, (inside.sum(), 3))
    return TetMesh.oriented(points, np.concatenate(tets))
