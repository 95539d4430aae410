"""Gaussians of a live creature are split before it moves, for poses that it is likely to take.

What it will do is not known; but whatever it does, its softest modes bend most.
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

MODE_COUNT = 6
MODE_AMPLITUDE = 0.3
"""Body heights that the node which moves furthest is moved by."""


def presplit_gaussians(creature: Creature) -> GaussianCloud:
    """The creature's splats at rest, those that its softest modes bend in parts."""
    embedding = embed_gaussians(creature.cloud, creature.cage.mesh)
    return split_for_motion(creature.cloud, embedding, likely_poses(creature.body)).cloud


def likely_poses(body: SoftBody) -> list[np.ndarray]:
    """(N, 3) nodes each, metres: the ``MODES`` softest modes of the body held at its feet, either way."""
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
        moved = np.zeros(nodes.size)
        moved[free_dofs] = mode
        moved = moved.reshape(-1, 3)
        moved *= MODE_AMPLITUDE * body.height / np.linalg.norm(moved, axis=1).max()
        poses += [nodes + moved, nodes - moved]
    return poses
