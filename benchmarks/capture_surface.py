"""Triangle surface of a capture as in SuGaR: a level set of the Gaussians' density."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from skimage import measure

from egs_warp.deformation.baselines import BoundSurface
from egs_warp.geometry.gaussians import GaussianCloud

LEVEL = 0.3
"""Value of the density on SuGaR's level set. The density is the sum of the Gaussians, each multiplied by its
opacity."""
CELLS = 128
"""Number of lattice cells along the longest side."""
REACH = 3.0
"""Cut-off radius of a Gaussian, in standard deviations."""


def capture_surface(cloud: GaussianCloud) -> BoundSurface:
    """Extract the surface of a capture by marching cubes on its density.

    SuGaR applies Poisson reconstruction to points of the same level set instead. A standard deviation below half a cell
    is raised to half a cell, because the lattice would otherwise miss the Gaussian.
    """
    means = cloud.means.numpy().astype(np.float64)
    opacities = cloud.opacities()
    visible = opacities > 0.05
    low, high = means[visible].min(axis=0), means[visible].max(axis=0)
    cell = float((high - low).max()) / CELLS
    scales = np.maximum(np.exp(cloud.log_scales.numpy().astype(np.float64)), 0.5 * cell)
    w, x, y, z = cloud.rotations.numpy().astype(np.float64).T
    rotations = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    origin = low - 4.0 * cell
    density = np.zeros(np.ceil((high - low) / cell).astype(int) + 9)
    spread = np.sqrt(np.einsum("nij,nj->ni", rotations**2, scales**2))
    for n in np.flatnonzero(visible):
        start = np.maximum(np.floor((means[n] - REACH * spread[n] - origin) / cell).astype(int), 0)
        stop = np.minimum(np.ceil((means[n] + REACH * spread[n] - origin) / cell).astype(int) + 1, density.shape)
        axes = [origin[k] + cell * np.arange(start[k], stop[k]) - means[n, k] for k in range(3)]
        local = sum(
            axes[k].reshape([-1 if k == j else 1 for j in range(3)])[..., None] * rotations[n][k] / scales[n]
            for k in range(3)
        )
        box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        density[box] += opacities[n] * np.exp(-0.5 * (np.asarray(local) ** 2).sum(axis=-1))
    vertices, faces, _, _ = measure.marching_cubes(density, LEVEL)
    vertices = vertices.astype(np.float64) * cell + origin
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # Slivers of marching cubes have no well-defined normal.
    return BoundSurface(vertices, faces[areas > 1e-3 * cell**2].astype(np.int32))
