"""Synergies: groups of muscle segments that share one activation, so that the QP of a step has fewer variables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from egs_warp.muscles.muscle_set import MuscleSet

MAX_SYNERGIES = 120
"""Maximum number of synergies."""
_MIN_SYNERGY_LIMIT, _SYNERGIES_PER_NODE = 80, 0.32
"""Lower limit of the maximum number of synergies, and maximum number of synergies per node of the cage."""


@dataclass(frozen=True)
class Synergies:
    """Groups of muscle segments. The segments of a group share one activation, which is a fraction of their bounds."""

    group_from_muscle: np.ndarray
    """(M,) int32, group of each segment."""

    @cached_property
    def count(self) -> int:
        """Number of groups."""
        return int(self.group_from_muscle.max(initial=-1)) + 1

    @cached_property
    def members(self) -> sparse.csr_matrix:
        """(M, groups) membership matrix: 1 where the segment is in the group."""
        count = len(self.group_from_muscle)
        return sparse.csr_matrix((np.ones(count), (np.arange(count), self.group_from_muscle)), (count, self.count))

    @cached_property
    def _sizes(self) -> np.ndarray:
        return np.bincount(self.group_from_muscle, minlength=self.count)

    def mean(self, activations: np.ndarray) -> np.ndarray:
        """Return (groups,), the mean of ``activations`` (M,) over each group."""
        return np.bincount(self.group_from_muscle, activations, minlength=self.count) / self._sizes


def find_synergies(
    muscles: MuscleSet, effects: np.ndarray, node_mass: np.ndarray, *, max_count: int | None = None
) -> Synergies:
    """Group muscle segments that accelerate the body in similar directions.

    The clustering uses average linkage. The distance between two segments is one minus the cosine between their
    effects, in the norm of the kinetic energy.

    Args:
        muscles: muscles of the body.
        effects: (3N, M) m/s, nodal velocities that each segment causes at its bound.
        node_mass: (N,) kg, lumped masses.
        max_count: maximum number of groups; None sets it to 0.32 per node, at least 80 and at most 120.
    """
    if max_count is None:
        max_count = int(min(max(_MIN_SYNERGY_LIMIT, _SYNERGIES_PER_NODE * len(node_mass)), MAX_SYNERGIES))
    if muscles.segment_count <= max_count:
        return Synergies(np.arange(muscles.segment_count, dtype=np.int32))
    weighted = effects * np.sqrt(np.repeat(node_mass, 3))[:, None]
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    distances = np.clip(1.0 - unit.T @ unit, 0.0, 2.0)
    np.fill_diagonal(distances, 0.0)
    tree = linkage(squareform(0.5 * (distances + distances.T), checks=False), method="average")
    groups = fcluster(tree, max_count, criterion="maxclust")
    # Number the groups by their first segment.
    _, first, inverse = np.unique(groups, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return Synergies(rank[inverse].astype(np.int32))
