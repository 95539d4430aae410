"""Small cages, motions and clouds for the tests of deformation."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh


def box(cells: tuple[int, int, int] = (3, 3, 3), size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> TetMesh:
    """Return a box cage with slightly perturbed inner nodes, so that the Delaunay tetrahedralisation is unique."""
    axes = [np.linspace(0, length, count + 1) for count, length in zip(cells, size, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    jitter = np.random.default_rng(0).uniform(-0.06, 0.06, nodes.shape) * (np.array(size) / cells)
    nodes = nodes + np.where((nodes > 1e-9) & (nodes < np.array(size) - 1e-9), jitter, 0.0)
    tets = Delaunay(nodes).simplices
    corners = nodes[tets]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) * np.prod(cells) / np.prod(size)
    return TetMesh.oriented(nodes, tets[volume > 1e-2])


def random_cloud(
    count: int, *, seed: int = 0, degree: int = 3, scale: float = 0.1, device: str = "cpu"
) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    return GaussianCloud.from_numpy(
        rng.uniform(0.1, 0.9, (count, 3)),
        rng.normal(size=(count, 4)),
        np.log(scale) + rng.uniform(-4.0, 0.0, (count, 3)),
        rng.normal(size=count),
        rng.normal(size=(count, (degree + 1) ** 2, 3)),
        device=device,
    )


def matrices(cloud: GaussianCloud) -> np.ndarray:
    """Return the rotation matrices [r1 r2 r3] (n, 3, 3) of the Gaussians, float64."""
    return Rotation.from_quat(cloud.rotations.numpy().astype(np.float64)[:, [1, 2, 3, 0]]).as_matrix()


def covariances(cloud: GaussianCloud) -> np.ndarray:
    factor = matrices(cloud) * np.exp(cloud.log_scales.numpy().astype(np.float64))[:, None]
    return factor @ factor.transpose(0, 2, 1)


def bent(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the points of a bar along x bent onto a circle of ``radius`` about an axis parallel to y."""
    angle = points[:, 0] / radius
    r = radius - (points[:, 2] - 0.2)
    return np.stack([r * np.sin(angle), points[:, 1], radius - r * np.cos(angle)], axis=1)
