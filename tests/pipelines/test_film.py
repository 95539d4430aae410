"""Gaussians of a film: those that cross flat ground are cut at it, and those below it are hidden."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.film import split_deformer
from tests.support.meshes import block_mesh


def _performance(ground: np.ndarray) -> Any:
    """Return a bending block with a wide embedded Gaussian, of which a quarter is below the ground."""
    mesh = block_mesh(4, 4, 4)
    middle, height = mesh.nodes.mean(axis=0), float(np.ptp(mesh.nodes[:, 2]))
    mean = [middle[0], middle[1], 0.7 * 0.2 * height]
    cloud = GaussianCloud.from_numpy(
        np.array([mean, [middle[0], middle[1], 0.7 * height]]),
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        np.log(np.array([[0.2, 0.2, 0.2], [0.01, 0.01, 0.01]]) * height),
        np.full(2, 2.0),
        np.zeros((2, 1, 3)),
    )
    bent = mesh.nodes + np.array([2.0, 0.0, 0.0]) * ((mesh.nodes[:, 2:] / height) ** 2) * height
    trajectory = SimpleNamespace(height=height, ground_coefficients=ground, positions=np.stack([mesh.nodes, bent]))
    simulation = SimpleNamespace(trajectory=trajectory, frames=[0, 1])
    return SimpleNamespace(body=SimpleNamespace(cloud=cloud, mesh=mesh), simulation=simulation)


def test_nothing_is_visible_below_flat_ground_after_splitting() -> None:
    rest = split_deformer(_performance(np.zeros(0))).rest
    visible = rest.opacities() > 1.0 / 255.0
    assert visible.sum() > 2 and rest.means.numpy()[visible, 2].min() > -0.006
    # Uneven ground is not the plane at height 0, so nothing is hidden below that plane.
    uneven = split_deformer(_performance(np.ones(3))).rest
    assert uneven.means.numpy()[uneven.opacities() > 1.0 / 255.0, 2].min() < -0.01
