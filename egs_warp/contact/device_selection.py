"""Selection of a step's contact points on a GPU (Eq. 8); only the lowest points are downloaded.

The gaps stay on the device. The kernels in ``kernels/contact/selection.py`` reduce them to the lowest point of each
cell and gather the points of the previous step. ``ContactSelector.select_from`` on the host does the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coupled_step import ACTIVATION_DEPTH, MAX_CREEP, MAX_SINK
from egs_warp.contact.detection import ContactDetector, ContactSet
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, GraphStream, PinnedUpload
from egs_warp.kernels.contact import selection as kernels
from egs_warp.launching import round_up
from egs_warp.precision import Vec4, real

_CAPACITY_STEP = 64
"""Capacities for points of the previous step are multiples of this."""


class DeviceContactSelector:
    """Gaps of all contact points of one body, at the start of a step and at its predicted end, and the selection
    from them.
    """

    def __init__(
        self, detector: ContactDetector, points: ContactSelector, stream: GraphStream, penetration_tolerance: float
    ) -> None:
        """Allocate the buffers.

        Args:
            detector: gaps of the points.
            points: selector on the host, which defines the cells.
            stream: stream on which the work is queued.
            penetration_tolerance: that of ``CoupledSolver``, m.
        """
        self._detector, self._selector, self._stream = detector, points, stream
        self._tolerance = penetration_tolerance
        count, device = len(detector.geometry.tet_from_point), detector.device
        self._gaps, self._start_gaps, self._next_gaps, self._next_start_gaps = (
            wp.zeros(count, dtype=real, device=device) for _ in range(4)
        )
        self._deep = wp.zeros(count, dtype=real, device=device)
        self._faces, self._start_faces, self._next_faces, self._next_start_faces = (
            wp.zeros(count, dtype=int, device=device) for _ in range(4)
        )
        bounds = np.searchsorted(points.cell_from_point[points.order], np.arange(points.cell_count + 1))
        self._cells = [wp.array(each.astype(np.int32), dtype=int, device=device) for each in (points.order, bounds)]
        self._block_dim = 1 if device.is_cpu else kernels.BLOCK
        self._buffers: dict[int, _TransferBuffers] = {}
        self._graphs = GraphCache(stream)

    def start_prefetch(self, positions: wp.array, ends: wp.array, before: np.ndarray) -> None:
        """Start the reductions for ``select``, asynchronously.

        Args:
            positions: (N,) start of the step, on the device.
            ends: (N,) predicted end of the step.
            before: (m,) contact points of the previous step.
        """
        buffers = self._buffers_for(len(before))
        buffers.upload.write(before)

        def work() -> None:
            buffers.upload.send()
            self._detector.enqueue_gaps(positions, self._start_gaps, self._start_faces)
            self._detector.enqueue_gaps(ends, self._gaps, self._faces)
            self._enqueue_choice(buffers, self._gaps, self._start_gaps, self._start_faces)

        with self._stream:
            self._graphs.run((len(buffers.previous), positions.ptr, ends.ptr), work)

    def _buffers_for(self, count: int) -> _TransferBuffers:
        capacity = round_up(count, _CAPACITY_STEP)
        if capacity not in self._buffers:
            self._buffers[capacity] = _TransferBuffers(self._stream, capacity, self._selector.cell_count)
        return self._buffers[capacity]

    def enqueue_prefetch(self, ends: wp.array, points: torch.Tensor) -> None:
        """Queue the reductions for ``select`` in the step that follows the current one, after ``enqueue_penetration``
        at the end of the current one.

        ``advance_prefetch`` makes the result valid.

        Args:
            ends: (N,) predicted end of the next step.
            points: (K,) int32, contact points of the current step.
        """
        buffers = self._buffers_for(len(points))
        buffers.upload.device[: len(points)].copy_(points)
        for target, values in ((self._next_start_gaps, self._gaps), (self._next_start_faces, self._faces)):
            wp.to_torch(target).copy_(wp.to_torch(values))
        self._detector.enqueue_gaps(ends, self._next_gaps, self._next_faces)
        self._enqueue_lowest(
            -ACTIVATION_DEPTH * self._tolerance, [self._deep, self._start_gaps, self._start_faces], buffers.deepest
        )
        self._enqueue_choice(buffers, self._next_gaps, self._next_start_gaps, self._next_start_faces)

    def advance_prefetch(self) -> None:
        """Make the step of ``enqueue_prefetch`` the current one."""
        for target, values in ((self._start_gaps, self._next_start_gaps), (self._start_faces, self._next_start_faces)):
            wp.to_torch(target).copy_(wp.to_torch(values))

    def deepest(self, capacity: int) -> np.ndarray:
        """Return (k, 4) the deepest penetrating point of each cell at the start of ``enqueue_prefetch``: its index,
        its gap in metres, and its gap and face at the start of the step.
        """
        deepest = self._buffers_for(capacity).result()[2]
        return deepest[deepest[:, 0] >= 0.0]

    def select(
        self, before: np.ndarray, loaded: np.ndarray, start: np.ndarray, *, capacity: int | None = None
    ) -> ContactSet:
        """Return the contacts of the prefetched step, the same as those of ``ContactSelector.select``.

        Args:
            before: (m,) contact points of the previous step.
            loaded: (m,) bool, True for points that carried load.
            start: (N, 3) m, start of the step.
            capacity: capacity in ``enqueue_prefetch``, whose result is already downloaded; None blocks for
                ``start_prefetch``.
        """
        if capacity is None:
            self._stream.wait()
        buffers = self._buffers_for(len(before) if capacity is None else capacity)
        lowest, previous, _ = buffers.result()
        previous = previous[: len(before)]
        low = lowest[lowest[:, 0] >= 0.0]
        points = self._selector.select_from(before, loaded, previous[:, 1], low[:, 0].astype(int), low[:, 1])
        candidates = np.concatenate([low, previous])
        # Duplicate rows are equal.
        _, first = np.unique(candidates[:, 0], return_index=True)
        candidates = candidates[first]
        chosen = candidates[np.searchsorted(candidates[:, 0], points)]
        return self._detector.contact_set_at(points, start, chosen[:, 2], chosen[:, 3].astype(np.int32))

    def _enqueue_choice(self, buffers: _TransferBuffers, *gaps: wp.array) -> None:
        """Reduce the ``gaps`` at the end, the gaps at the start and the faces there, and start their download."""
        self._enqueue_lowest(self._selector.activation_distance, gaps, buffers.lowest)
        wp.launch(
            kernels.gather_gaps_kernel,
            len(buffers.previous),
            inputs=[as_warp(buffers.upload.device, real), *gaps],
            outputs=[as_warp(buffers.previous, Vec4)],
            device=self._detector.device,
        )
        buffers.download()

    def _enqueue_lowest(self, near: float, gaps: Sequence[wp.array], lowest: torch.Tensor) -> None:
        wp.launch(
            kernels.lowest_point_per_cell_kernel,
            (self._selector.cell_count, self._block_dim),
            inputs=[*self._cells, near, self._selector.gap_tolerance, *gaps],
            outputs=[as_warp(lowest, Vec4)],
            device=self._detector.device,
            block_dim=self._block_dim,
        )

    def enqueue_penetration(
        self, ends: wp.array, points: torch.Tensor, counts: torch.Tensor, count: torch.Tensor
    ) -> None:
        """Count the points that penetrate too far at the end of the current step.

        Args:
            ends: (N,) end positions.
            points: (K,) int32, contact points of the step, which are not counted.
            counts: (1,) int32, number of valid ``points``.
            count: (1,), overwritten with the number.
        """
        self._detector.enqueue_gaps(ends, self._gaps, self._faces)
        count.zero_()
        wp.launch(
            kernels.penetrating_points_kernel,
            len(self._gaps),
            inputs=[
                *(ACTIVATION_DEPTH * self._tolerance, self._tolerance, MAX_SINK, MAX_CREEP),
                *(as_warp(points, wp.int32), as_warp(counts, wp.int32), self._gaps, self._start_gaps),
            ],
            outputs=[as_warp(count, real), self._deep],
            device=self._detector.device,
        )

    def enqueue_min_gap(self, min_gap: torch.Tensor) -> None:
        """Write the minimum of all gaps in metres to ``min_gap``, a scalar, after ``enqueue_penetration``."""
        torch.amin(wp.to_torch(self._gaps), dim=0, out=min_gap)


class _TransferBuffers:
    """Upload of the previous step's points, and download of the reduced gaps, for ``capacity`` points."""

    def __init__(self, stream: GraphStream, capacity: int, cells: int) -> None:
        self.upload, self._parts = PinnedUpload(stream, capacity), [cells, capacity, cells]
        self._packed_result = torch.zeros((sum(self._parts), 4), dtype=torch.float64, device=stream.device)
        self.lowest, self.previous, self.deepest = self._packed_result.split(self._parts)
        self._host_result = stream.pinned(self._packed_result.numel())

    def download(self) -> None:
        """Start the download."""
        self._host_result.copy_(self._packed_result.view(-1), non_blocking=True)

    def result(self) -> list[np.ndarray]:
        """Return the downloaded points: the lowest point of each cell, the previous step's points, and the deepest
        penetrating point of each cell, (k, 4) each.
        """
        return np.split(self._host_result.numpy().reshape(-1, 4), np.cumsum(self._parts)[:-1])
