"""Split the Gaussians of a live creature before it moves.

Because the motion is not known in advance, the Gaussians are split for deformations along the softest modes of the
body: in any motion, the body bends most along these modes.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.splitting import split_for_motion
from egs_warp.fem.body import SoftBody
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.film import above_ground, below_ground_hidden

MODE_COUNT = 6
"""Number of modes for which the Gaussians are split."""
MODE_AMPLITUDE = 0.3
"""Largest nodal displacement of a mode, body heights."""


def presplit_gaussians(creature: Creature, *, hides_ground: bool) -> GaussianCloud:
    """Return the Gaussians of the creature at rest, split where the softest modes bend them.

    Args:
        creature: The creature.
        hides_ground: True if the page draws a flat floor instead of a scene. In this case, as in a film, Gaussians that
            cross the floor are cut at it, and Gaussians below it are hidden.
    """
    height = creature.body.height
    cloud = above_ground(creature.cloud, height) if hides_ground else creature.cloud
    split = split_for_motion(cloud, embed_gaussians(cloud, creature.cage.mesh), likely_poses(creature.body)).cloud
    return below_ground_hidden(split, height) if hides_ground else split


def likely_poses(body: SoftBody) -> list[np.ndarray]:
    """Return poses, (N, 3) m each: the ``MODE_COUNT`` softest modes of the body fixed at its feet, in both directions.

    The nodes below a height of 0.05 body heights are fixed.
    """
    nodes = body.mesh.nodes
    up = -body.gravity / np.linalg.norm(body.gravity)
    heights = nodes @ up
    free = heights > heights.min() + 0.05 * body.height
    free_dofs = np.flatnonzero(np.repeat(free, 3))
    upper = body.assembly.matrix(body.assembly.hessian_entries(nodes))
    stiffness = (upper + sparse.triu(upper, 1).T).tocsc()[free_dofs][:, free_dofs]
    mass = sparse.diags(np.repeat(body.node_mass, 3)[free_dofs]).tocsc()
    _, modes = sparse_linalg.eigsh(stiffness, k=MODE_COUNT, M=mass, sigma=0.0, v0=np.ones(len(free_dofs)))
    poses = []
    for mode in modes.T:
        displacement = np.zeros(nodes.size)
        displacement[free_dofs] = mode
        displacement = displacement.reshape(-1, 3)
        displacement *= MODE_AMPLITUDE * body.height / np.linalg.norm(displacement, axis=1).max()
        poses += [nodes + displacement, nodes - displacement]
    return poses
