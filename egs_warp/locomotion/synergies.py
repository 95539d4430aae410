"""Muscles that act alike act together: fewer unknowns for the program of a step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from egs_warp.muscles.muscle_set import MuscleSet

MOST_SYNERGIES = 120
_LEAST, _A_NODE = 80, 0.32
"""Of a coarse body: as many as it has nodes for, and so many at least."""


@dataclass(frozen=True)
class Synergies:
    """Groups of muscles that take the same activation, in their bounds."""

    group_from_muscle: np.ndarray
    """(M,) int32."""

    @cached_property
    def count(self) -> int:
        """Number of groups."""
        return int(self.group_from_muscle.max(initial=-1)) + 1

    @cached_property
    def members(self) -> sparse.csr_matrix:
        """(M, groups) 1 where the muscle is of the group."""
        count = len(self.group_from_muscle)
        return sparse.csr_matrix((np.ones(count), (np.arange(count), self.group_from_muscle)), (count, self.count))

    @cached_property
    def _sizes(self) -> np.ndarray:
        return np.bincount(self.group_from_muscle, minlength=self.count)

    def mean(self, activations: np.ndarray) -> np.ndarray:
        """(groups,) mean of ``activations`` (M,) over each."""
        return np.bincount(self.group_from_muscle, activations, minlength=self.count) / self._sizes


def find_synergies(
    muscles: MuscleSet, effects: np.ndarray, node_mass: np.ndarray, *, most: int | None = None
) -> Synergies:
    """At most ``most`` groups of muscles whose ``effects`` (3N, M), nodal velocities of each at its bound, point the
    same way. If that is not told: from 80 of 250 nodes to 120 of 375 and more.

    Average linkage on one minus the cosine between them, in the norm of the kinetic energy.
    """
    if most is None:
        most = int(min(max(_LEAST, _A_NODE * len(node_mass)), MOST_SYNERGIES))
    if muscles.segment_count <= most:
        return Synergies(np.arange(muscles.segment_count, dtype=np.int32))
    weighted = effects * np.sqrt(np.repeat(node_mass, 3))[:, None]
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    apart = np.clip(1.0 - unit.T @ unit, 0.0, 2.0)
    np.fill_diagonal(apart, 0.0)
    tree = linkage(squareform(0.5 * (apart + apart.T), checks=False), method="average")
    groups = fcluster(tree, most, criterion="maxclust")
    # Numbered by their first muscle.
    _, first, inverse = np.unique(groups, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return Synergies(rank[inverse].astype(np.int32))
