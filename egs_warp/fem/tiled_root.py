"""Inverses of Cholesky factors by tiles, on a GPU."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from egs_warp.fem.graphs import GraphStream
from egs_warp.fem.root_tasks import RootTasks
from egs_warp.fem.slabs import Slabs
from egs_warp.fem.worlds import shared
from egs_warp.kernels.fem.inverse_root import BLOCK, SIDE, inverse_root_kernel
from egs_warp.precision import real

_SHARE = 10 / 11
"""Of a GPU's processors: what is for others may begin meanwhile."""


class TiledRoot:
    """R of S^-1 = R^T R for symmetric matrices S (n, n) by one kernel: L^-1 of S in the order of its slabs, columns in
    that of S."""

    def __init__(self, slabs: Slabs, matrix: torch.Tensor, inverse: torch.Tensor, stream: GraphStream) -> None:
        """``matrix``: the lower triangle of S in the order of the slabs; ``inverse``: where R comes."""
        tasks = RootTasks([len(part) for part in slabs.parts], len(slabs.between))
        device, self._stream = matrix.device, stream
        order = slabs.order.astype(np.int32)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        told = (torch.from_numpy(values).to(device) for values in (tasks.tasks, tasks.pairs, order, place))
        self._given = [shared(matrix, real), *(shared(values, wp.int32) for values in told), tasks.columns]
        numbers = (
            torch.zeros(count * SIDE**2, dtype=torch.float64, device=device) for count in (tasks.tiles, tasks.columns)
        )
        flags = (torch.zeros(count, dtype=torch.int32, device=device) for count in (tasks.tiles + tasks.columns, 4))
        self._given += [*(shared(values, real) for values in numbers), *(shared(values, wp.int32) for values in flags)]
        self._definite = torch.zeros(1, dtype=torch.bool, device=device)
        self._made = [shared(inverse, real), shared(self._definite, wp.bool)]
        self._device = wp.device_from_torch(device)
        self._blocks = min(len(tasks.tasks), max(1, int(_SHARE * self._device.sm_count)))

    def make(self) -> torch.Tensor:
        """R of what lies in the matrix; () bool, whether that is definite."""
        wp.launch(
            inverse_root_kernel,
            (self._blocks, BLOCK),
            inputs=self._given,
            outputs=self._made,
            device=self._device,
            stream=self._stream.current(),
            block_dim=BLOCK,
        )
        return self._definite[0]
