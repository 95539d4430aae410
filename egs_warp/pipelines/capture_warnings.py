"""Warnings about captures that can be animated but may result in a poor body."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length

MIN_GAUSSIANS = 100
"""Number of Gaussians below which most of the body's shape would be extrapolated."""
_DETACHED_DISTANCE = 0.15
"""Distance from the nearest node of the cage, body heights, beyond which a Gaussian is detached; the distance is at
least the mean edge length of the cage. Floaters that the cage excludes are nearer."""
_MIN_DETACHED_SHARE = 0.01
"""Fraction of the opacity in detached Gaussians above which a warning is given."""

_MAX_THICKENING = 1.3
"""Thickening of the cage above which a warning is given."""


def capture_warnings(cloud: GaussianCloud, cage: TetMesh, height: float, *, thickening: float = 1.0) -> tuple[str, ...]:
    """Return one line for each warning: too few Gaussians, parts of ``cloud`` detached from its ``cage``, or a cage
    that is thicker than the object (``Cage.thickening``).

    ``cloud``, ``cage`` and the body's ``height`` are in the same unit and frame.
    """
    notes = []
    if cloud.count < MIN_GAUSSIANS:
        notes.append(f"only {cloud.count} Gaussians: most of the body is guessed")
    if thickening > _MAX_THICKENING:
        notes.append(
            f"the body is {thickening:.2g} times as thick as the visible object, whose parts are thinner than the"
            " elements; use a cage with more nodes"
        )
    distance, _ = KDTree(cage.nodes).query(cloud.means.numpy().astype(np.float64))
    opacity = cloud.opacities()
    is_detached = distance > max(_DETACHED_DISTANCE * height, mean_edge_length(cage))
    share = float(opacity[is_detached].sum() / max(opacity.sum(), 1e-300))
    if share > _MIN_DETACHED_SHARE:
        notes.append(
            f"{100 * share:.0f} % of the capture lies apart from the body, up to {distance.max() / height:.2g} body"
            " heights away, and moves as if it were attached; remove other objects first"
        )
    return tuple(notes)
