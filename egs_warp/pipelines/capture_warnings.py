"""What a user should know of a capture that becomes a body, though nothing stops it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length

FEWEST_GAUSSIANS = 100
"""Fewer leave most of a body to guesswork."""
_APART = 0.15
"""Body heights from the cage, at least an edge of it: fuzz and floaters that the cage leaves out are nearer."""
_LEAST_SHARE = 0.01
"""Of the opacity."""


def capture_warnings(cloud: GaussianCloud, cage: TetMesh, height: float) -> tuple[str, ...]:
    """One line for each: too few Gaussians for a body, parts of ``cloud`` that lie apart from its ``cage``.

    ``cloud``, ``cage`` and ``height`` in the same unit and frame.
    """
    notes = []
    if cloud.count < FEWEST_GAUSSIANS:
        notes.append(f"only {cloud.count} Gaussians: most of the body is guessed")
    distance, _ = KDTree(cage.nodes).query(cloud.means.numpy().astype(np.float64))
    opacity = cloud.opacities()
    apart = distance > max(_APART * height, mean_edge_length(cage))
    share = float(opacity[apart].sum() / max(opacity.sum(), 1e-300))
    if share > _LEAST_SHARE:
        notes.append(
            f"{100 * share:.0f} % of the capture lies apart from the body, up to {distance.max() / height:.2g} body"
            " heights away, and moves with it as if they were one; cut other objects away first"
        )
    return tuple(notes)
