"""Tiled inverse Cholesky factors on a GPU; the kernel is in ``egs_warp.kernels.fem.tiled_inverse``."""

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

_PROCESSOR_FRACTION = 10 / 11
"""Fraction of a GPU's multiprocessors that the kernel occupies; the others are free for concurrent work."""


class TiledInverseFactor:
    """R with S^-1 = R^T R for symmetric matrices S (n, n), computed by one kernel.

    R is L^-1 of S permuted to the order of the dissection, with columns in the order of S.
    """

    def __init__(
        self, dissection: Dissection, matrix: torch.Tensor, inverse: torch.Tensor, stream: GraphStream
    ) -> None:
        """Allocate the scratch memory.

        Args:
            dissection: partition of the unknowns.
            matrix: (n, n) float64, input: the lower triangle of S in the order of the dissection.
            inverse: (n, n) float64, output: R.
            stream: stream of the launches.
        """
        tasks = TileTaskGraph([len(part) for part in dissection.parts], len(dissection.separator))
        device, self._stream = matrix.device, stream
        order = dissection.order.astype(np.int32)
        permutation = np.empty_like(order)
        permutation[order] = np.arange(len(order))
        index_arrays = (
            torch.from_numpy(values).to(device) for values in (tasks.tasks, tasks.pairs, order, permutation)
        )
        self._inputs = [as_warp(matrix, real), *(as_warp(values, wp.int32) for values in index_arrays), tasks.columns]
        numbers = (
            torch.zeros(count * TILE_SIDE**2, dtype=torch.float64, device=device)
            for count in (tasks.tiles, tasks.columns)
        )
        flags = (torch.zeros(count, dtype=torch.int32, device=device) for count in (tasks.tiles + tasks.columns, 4))
        self._inputs += [
            *(as_warp(values, real) for values in numbers),
            *(as_warp(values, wp.int32) for values in flags),
        ]
        self._definite = torch.zeros(1, dtype=torch.bool, device=device)
        self._outputs = [as_warp(inverse, real), as_warp(self._definite, wp.bool)]
        self._device = wp.device_from_torch(device)
        self._blocks = min(len(tasks.tasks), max(1, int(_PROCESSOR_FRACTION * self._device.sm_count)))

    def factor(self) -> torch.Tensor:
        """Queue the computation of R of ``matrix``; return a () bool tensor, True if the matrix is positive
        definite."""
        wp.launch(
            tiled_inverse_kernel,
            (self._blocks, BLOCK),
            inputs=self._inputs,
            outputs=self._outputs,
            device=self._device,
            stream=self._stream.current(),
            block_dim=BLOCK,
        )
        return self._definite[0]
