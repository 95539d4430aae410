"""Selection of the contacts of a step on a GPU while the host still works on the previous step (Eq. 8).

Gaps, selection and contact records stay on the device until one download brings them to the host.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, GraphStream, PinnedUpload
from egs_warp.launching import round_up
from egs_warp.precision import Mat33, Vec4, real

_CAPACITY_STEP = 64
"""Multiple to which capacities for points of the previous step are rounded up."""
_RECORD_SIZE = 17
"""Size of a contact's record in float64 values: 9 for the axes, 4 for the weights, 1 for the gap, and 3 that hold two
int32 each, for 4 nodes, the face and the point."""


class ContactPrefetch:
    """Gaps of all contact points of one body, at the start of a step and at the end of a ballistic step, and the
    contacts selected from them."""

    def __init__(
        self, detector: ContactDetector, selector: ContactSelector, stream: GraphStream, penetration_tolerance: float
    ) -> None:
        """Allocate the buffers on the device of ``detector`` and ``selector``; work is queued on ``stream``. The
        ``penetration_tolerance`` is that of ``CoupledSolver``, m."""
        self._detector, self._selector, self._stream = detector, selector, stream
        self._tolerance = penetration_tolerance
        shape, device = (1, detector.point_count), detector.device
        self._gaps, self._start_gaps, self._next_gaps, self._next_start_gaps = (
            wp.zeros(shape, dtype=real, device=device) for _ in range(4)
        )
        self._faces, self._start_faces, self._next_faces, self._next_start_faces = (
            wp.zeros(shape, dtype=int, device=device) for _ in range(4)
        )
        self._lowest, self._penetrating = (
            wp.zeros((1, selector.cell_count), dtype=int, device=device) for _ in range(2)
        )
        self._buffers: dict[int, _TransferBuffers] = {}
        self._graphs = GraphCache(stream)

    def start(self, positions: wp.array, ends: wp.array, before: np.ndarray, loaded: np.ndarray) -> None:
        """Start the contact selection of a step, asynchronously; ``contacts`` returns the result.

        Args:
            positions: (N,) m, nodes at the start of the step, on the device.
            ends: (N,) m, nodes at the end of a ballistic step.
            before: (m,) contact points of the previous step.
            loaded: (m,) bool, True for points that carried load.
        """
        buffers = self._buffers_for(len(before))
        padding = np.zeros(buffers.capacity - len(before))
        buffers.upload.write(np.array([len(before)]), before, padding, loaded)

        def work() -> None:
            buffers.upload.send()
            counts, points, is_loaded = buffers.upload.device.split([1, buffers.capacity, buffers.capacity])
            buffers.set_previous(points, counts, is_loaded)
            at_start = positions.reshape((1, -1))
            self._detector.enqueue_gaps(at_start, self._start_gaps, self._start_faces)
            self._detector.enqueue_gaps(ends.reshape((1, -1)), self._gaps, self._faces)
            self._enqueue_selection(buffers, self._gaps, at_start, self._start_gaps, self._start_faces)

        with self._stream:
            self._graphs.run((buffers.capacity, positions.ptr, ends.ptr), work)

    def _buffers_for(self, count: int) -> _TransferBuffers:
        capacity = round_up(count, _CAPACITY_STEP)
        if capacity not in self._buffers:
            self._buffers[capacity] = _TransferBuffers(self._stream, capacity, self._selector.cell_count)
        return self._buffers[capacity]

    def enqueue_next(
        self,
        positions: Sequence[wp.array],
        ends: wp.array,
        points: torch.Tensor,
        counts: torch.Tensor,
        loads: torch.Tensor,
    ) -> None:
        """Queue the contact selection for the next step. ``enqueue_penetration`` must have been called for the end of
        the current step before; ``advance`` makes the result valid.

        Args:
            positions: (N,) m, nodes at the start and at the end of the current step.
            ends: (N,) m, nodes at the end of the next step, if it is ballistic.
            points: (K,) int32, contact points of the current step.
            counts: (1,) int32, number of valid ``points``.
            loads: (K,) newtons, normal forces at ``points``.
        """
        buffers = self._buffers_for(len(points))
        buffers.set_previous(points, counts, loads > 0.0)
        start, end = (each.reshape((1, -1)) for each in positions)
        deepest = buffers.deepest
        deepest.clear()
        self._selector.enqueue_append(self._penetrating, self._gaps, deepest.selected)
        self._detector.enqueue_record([*deepest.selected, start, self._start_gaps, self._start_faces], deepest.record)
        for target, values in ((self._next_start_gaps, self._gaps), (self._next_start_faces, self._faces)):
            wp.to_torch(target).copy_(wp.to_torch(values))
        self._detector.enqueue_gaps(ends.reshape((1, -1)), self._next_gaps, self._next_faces)
        self._enqueue_selection(buffers, self._next_gaps, end, self._next_start_gaps, self._next_start_faces)

    def advance(self) -> None:
        """Make the next step of ``enqueue_next`` the current one."""
        for target, values in ((self._start_gaps, self._next_start_gaps), (self._start_faces, self._next_start_faces)):
            wp.to_torch(target).copy_(wp.to_torch(values))

    def _enqueue_selection(self, buffers: _TransferBuffers, gaps: wp.array, *start: wp.array) -> None:
        """Select contacts by the ``gaps`` (1, P) at the end of a ballistic step, write their records from the
        positions, gaps and faces at its ``start``, and start the download."""
        chosen = buffers.selection
        self._selector.enqueue_selection(buffers.previous, gaps, [self._lowest, buffers.candidates], chosen.selected)
        self._detector.enqueue_record([*chosen.selected, *start], chosen.record)
        buffers.download()

    def contacts(self, capacity: int) -> ContactSet:
        """Block until the contacts of the step are downloaded, and return them. Their points are those that
        ``ContactSelector.select`` would select. ``capacity`` is the length of ``before`` in ``start``, or of ``points``
        in ``enqueue_next``."""
        return self._buffers_for(capacity).selection.contact_set(len(self._detector.geometry.mesh.nodes))

    def deepest(self, capacity: int) -> ContactSet:
        """Return the deepest penetrating point of each cell, the deepest first. The step is the one that was current in
        the last call of ``enqueue_next``; ``capacity`` is the length of its argument ``points``."""
        return self._buffers_for(capacity).deepest.contact_set(len(self._detector.geometry.mesh.nodes))

    def enqueue_penetration(
        self, ends: wp.array, points: torch.Tensor, counts: torch.Tensor, count: torch.Tensor
    ) -> None:
        """Count the points that penetrate too far at the end of the current step.

        Args:
            ends: (N,) m, nodes at the end of the step.
            points: (K,) int32, contact points of the step, which are not counted.
            counts: (1,) int32, number of valid ``points``.
            count: (1,) float64, overwritten with the number of penetrating points.
        """
        self._detector.enqueue_gaps(ends.reshape((1, -1)), self._gaps, self._faces)
        count.zero_()
        contacts = [as_warp(points[None], wp.int32), as_warp(counts, wp.int32)]
        found = [as_warp(count, real), self._penetrating]
        self._selector.enqueue_penetrating(contacts, [self._gaps, self._start_gaps], self._tolerance, found)

    def enqueue_min_gap(self, min_gap: torch.Tensor) -> None:
        """Write the minimum of all gaps in metres to ``min_gap``, a scalar, after ``enqueue_penetration``."""
        torch.amin(wp.to_torch(self._gaps), dim=(0, 1), out=min_gap)


class _TransferBuffers:
    """Upload of the previous step's points, and download of the contacts, for ``capacity`` points."""

    def __init__(self, stream: GraphStream, capacity: int, cells: int) -> None:
        self.capacity, device = capacity, stream.device
        self.upload = PinnedUpload(stream, 1 + 2 * capacity)
        self._points, self._loaded = torch.zeros((2, 1, capacity), dtype=torch.int32, device=device)
        self._counts = torch.zeros(1, dtype=torch.int32, device=device)
        self.previous = [as_warp(each, wp.int32) for each in (self._points, self._counts, self._loaded)]
        candidates = torch.zeros((1, capacity + cells), dtype=torch.int32, device=device)
        self.candidates = as_warp(candidates, wp.int32)
        # With an even number of contacts, the records are aligned.
        widths = [round_up(count, 2) for count in (capacity + cells, cells)]
        sizes = [_RECORD_SIZE * width + 1 for width in widths]
        self._packed = torch.zeros(sum(sizes), dtype=torch.float64, device=device)
        self._host = stream.pinned(sum(sizes))
        parts = zip(self._packed.split(sizes), self._host.split(sizes), widths, strict=True)
        self.selection, self.deepest = (_ContactRecords(*part) for part in parts)

    def set_previous(self, points: torch.Tensor, counts: torch.Tensor, loaded: torch.Tensor) -> None:
        """Copy ``points`` (m,) of the previous step, their number ``counts`` (1,) and their flags ``loaded`` (m,)."""
        self._points[0, : len(points)].copy_(points)
        self._counts.copy_(counts)
        self._loaded[0, : len(loaded)].copy_(loaded)

    def download(self) -> None:
        """Start the download."""
        self._host.copy_(self._packed, non_blocking=True)


class _ContactRecords:
    """Records of up to ``width`` contacts in packed memory on the device, and its copy on the ``host``."""

    def __init__(self, packed: torch.Tensor, host: torch.Tensor, width: int) -> None:
        axes, weights, gaps, nodes, faces, points, self._count = _split(packed, width)
        self.selected = [as_warp(points[None], wp.int32), as_warp(self._count, wp.int32)]
        kinds = (nodes, wp.vec4i), (weights, Vec4), (axes, Mat33), (gaps, real), (faces, wp.int32)
        self.record = [as_warp(values[None], kind) for values, kind in kinds]
        self._on_host = [values.numpy() for values in _split(host, width)]

    def clear(self) -> None:
        """Set the number of contacts on the device to zero."""
        self._count.zero_()

    def contact_set(self, node_count: int) -> ContactSet:
        """Return the downloaded contacts."""
        axes, weights, gaps, nodes, faces, points, count = self._on_host
        arrays = [each[: int(count[0])].copy() for each in (nodes, weights, axes, gaps, faces)]
        return ContactSet(points[: int(count[0])].astype(int), *arrays, node_count=node_count)


def _split(packed: torch.Tensor, width: int) -> list[torch.Tensor]:
    """Return axes (width, 3, 3), weights (width, 4), gaps (width,), nodes (width, 4), faces (width,), points (width,)
    and their number (1,) in ``packed`` memory."""
    axes, weights, gaps, integers = packed.split([9 * width, 4 * width, width, 3 * width + 1])
    nodes, faces, points, count, _ = integers.view(torch.int32).split([4 * width, width, width, 1, 1])
    return [axes.view(-1, 3, 3), weights.view(-1, 4), gaps, nodes.view(-1, 4), faces, points, count]
