"""Inverses of Cholesky factors by tiles, on a GPU."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphStream
from egs_warp.fem.dissection import Dissection
from egs_warp.fem.tile_tasks import TileTaskGraph
from egs_warp.kernels.fem.tiled_inverse import BLOCK, TILE_SIDE, tiled_inverse_kernel
from egs_warp.precision import real

_SHARE = 10 / 11
"""Of a GPU's processors: what is for others may begin meanwhile."""


class TiledInverseFactor:
    """R of S^-1 = R^T R for symmetric matrices S (n, n) by one kernel: L^-1 of S in the order of its slabs, columns in
    that of S."""

    def __init__(self, slabs: Dissection, matrix: torch.Tensor, inverse: torch.Tensor, stream: GraphStream) -> None:
        """``matrix``: the lower triangle of S in the order of the slabs; ``inverse``: where R comes."""
        tasks = TileTaskGraph([len(part) for part in slabs.parts], len(slabs.separator))
        device, self._stream = matrix.device, stream
        order = slabs.order.astype(np.int32)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        told = (torch.from_numpy(values).to(device) for values in (tasks.tasks, tasks.pairs, order, place))
        self._given = [as_warp(matrix, real), *(as_warp(values, wp.int32) for values in told), tasks.columns]
        numbers = (
            torch.zeros(count * TILE_SIDE**2, dtype=torch.float64, device=device)
            for count in (tasks.tiles, tasks.columns)
        )
        flags = (torch.zeros(count, dtype=torch.int32, device=device) for count in (tasks.tiles + tasks.columns, 4))
        self._given += [
            *(as_warp(values, real) for values in numbers),
            *(as_warp(values, wp.int32) for values in flags),
        ]
        self._definite = torch.zeros(1, dtype=torch.bool, device=device)
        self._made = [as_warp(inverse, real), as_warp(self._definite, wp.bool)]
        self._device = wp.device_from_torch(device)
        self._blocks = min(len(tasks.tasks), max(1, int(_SHARE * self._device.sm_count)))

    def make(self) -> torch.Tensor:
        """R of what lies in the matrix; () bool, whether that is definite."""
        wp.launch(
            tiled_inverse_kernel,
            (self._blocks, BLOCK),
            inputs=self._given,
            outputs=self._made,
            device=self._device,
            stream=self._stream.current(),
            block_dim=BLOCK,
        )
        return self._definite[0]
