"""Impulses of muscles on a body's nodes, for each synergy at its bound (Eq. 7)."""

from __future__ import annotations

import numpy as np
import warp as wp

from egs_warp.kernels.locomotion.impulses import impulses_kernel
from egs_warp.launching import device_of, launch_again, put, zeros
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import FULL, SLACK
from egs_warp.precision import Vec3, real


class SynergyImpulses:
    """Kernel, index maps and memory of one body's synergies, on the host."""

    def __init__(self, muscles: MuscleSet, synergies: Synergies) -> None:
        rows, groups = muscles.difference_rows, synergies.group_from_muscle
        order = np.argsort(groups, kind="stable")
        offsets = np.searchsorted(groups[order], np.arange(synergies.count + 1))
        self._maps = [
            *(wp.array(part.astype(np.int32), dtype=int, device="cpu") for part in (offsets, order)),
            *(wp.array(part.astype(np.int32), dtype=int, device="cpu") for part in (rows.indptr, rows.indices)),
            *(
                wp.array(part, dtype=real, device="cpu")
                for part in (rows.data, muscles.stiffness * muscles.bounds, muscles.rest_lengths)
            ),
            *(SLACK, FULL),
        ]
        self._count = synergies.count
        self._positions = zeros(muscles.node_count, Vec3, "cpu")
        self._impulses = np.zeros((synergies.count + 1, 3 * muscles.node_count))
        self._rows = wp.array(self._impulses.reshape(len(self._impulses), -1, 3), dtype=Vec3, device="cpu", copy=False)

    def beside(self, other: np.ndarray, positions: np.ndarray, dt: float) -> np.ndarray:
        """(3N, m + 1) N s over ``dt`` seconds at node ``positions`` (N, 3), the last column ``other`` (3N,); it is
        overwritten the next time."""
        put(self._positions, positions)
        launch_again(
            impulses_kernel,
            self._count,
            inputs=[*self._maps, self._positions, dt],
            outputs=[self._rows],
            device=device_of(self._positions),
        )
        self._impulses[-1] = other
        return self._impulses.T
