"""Contact points of a step chosen where a GPU has the gaps of all points: only the lowest come to the host."""

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

_KNOWN = 64
"""Points of the step before are so many at a time."""


class DeviceContactSelector:
    """Gaps of all contact points of one body, at the start of a step and where it may end."""

    def __init__(
        self, detector: ContactDetector, points: ContactSelector, stream: GraphStream, penetration_tolerance: float
    ) -> None:
        """``penetration_tolerance`` metres, as ``CoupledSolver`` has it."""
        self._detector, self._points, self._stream = detector, points, stream
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
        self._lanes = 1 if device.is_cpu else kernels.BLOCK
        self._rooms: dict[int, _TransferBuffers] = {}
        self._works = GraphCache(stream)

    def start_prefetch(self, positions: wp.array, ends: wp.array, before: np.ndarray) -> None:
        """Begin to ``choose`` for a step from ``positions`` (N,), which may end at ``ends`` (N,), after the points
        ``before`` (m,); nobody waits."""
        room = self._buffers_for(len(before))
        room.upload.write(before)

        def look() -> None:
            room.upload.send()
            self._detector.enqueue_gaps(positions, self._start_gaps, self._start_faces)
            self._detector.enqueue_gaps(ends, self._gaps, self._faces)
            self._enqueue_choice(room, self._gaps, self._start_gaps, self._start_faces)

        with self._stream:
            self._works.run((len(room.known), positions.ptr, ends.ptr), look)

    def _buffers_for(self, count: int) -> _TransferBuffers:
        places = round_up(count, _KNOWN)
        if places not in self._rooms:
            self._rooms[places] = _TransferBuffers(self._stream, places, self._points.cell_count)
        return self._rooms[places]

    def enqueue_prefetch(self, ends: wp.array, points: torch.Tensor) -> None:
        """``look`` for a step from where the one at hand ends, after ``enqueue_sinking`` there, which may end at
        ``ends`` (N,), after ``points`` (K,) int32; it counts if ``go_on`` says so."""
        room = self._buffers_for(len(points))
        room.upload.device[: len(points)].copy_(points)
        for there, values in ((self._next_start_gaps, self._gaps), (self._next_start_faces, self._faces)):
            wp.to_torch(there).copy_(wp.to_torch(values))
        self._detector.enqueue_gaps(ends, self._next_gaps, self._next_faces)
        self._enqueue_lowest(
            -ACTIVATION_DEPTH * self._tolerance, [self._deep, self._start_gaps, self._start_faces], room.deepest
        )
        self._enqueue_choice(room, self._next_gaps, self._next_start_gaps, self._next_start_faces)

    def advance_prefetch(self) -> None:
        """To the step for which ``enqueue_next`` has looked."""
        for there, values in ((self._start_gaps, self._next_start_gaps), (self._start_faces, self._next_start_faces)):
            wp.to_torch(there).copy_(wp.to_torch(values))

    def deepest(self, places: int) -> np.ndarray:
        """(k, 4) of points that sink where ``enqueue_next`` began the deepest of each cell: its number, its gap there,
        metres, and gap and face at the start of the step."""
        deepest = self._buffers_for(places).result()[2]
        return deepest[deepest[:, 0] >= 0.0]

    def select(
        self, before: np.ndarray, loaded: np.ndarray, start: np.ndarray, *, places: int | None = None
    ) -> ContactSet:
        """The contacts of the step for which ``look`` was begun, on the host from ``start`` (N, 3): those of
        ``ContactPoints.choose`` after the points ``before`` (m,), of which those ``loaded`` (m,) bool pressed; or what
        ``enqueue_next`` has found with so many ``places``, which has come already."""
        if places is None:
            self._stream.wait()
        room = self._buffers_for(len(before) if places is None else places)
        lowest, known, _ = room.result()
        known = known[: len(before)]
        low = lowest[lowest[:, 0] >= 0.0]
        points = self._points.select_from(before, loaded, known[:, 1], low[:, 0].astype(int), low[:, 1])
        every = np.concatenate([low, known])
        # Of those that are there twice both say the same.
        _, first = np.unique(every[:, 0], return_index=True)
        every = every[first]
        chosen = every[np.searchsorted(every[:, 0], points)]
        return self._detector.contact_set_at(points, start, chosen[:, 2], chosen[:, 3].astype(np.int32))

    def _enqueue_choice(self, room: _TransferBuffers, *gaps: wp.array) -> None:
        """By ``gaps`` at the end and at the start, and faces there."""
        self._enqueue_lowest(self._points.activation_distance, gaps, room.lowest)
        wp.launch(
            kernels.gather_gaps_kernel,
            len(room.known),
            inputs=[as_warp(room.upload.device, real), *gaps],
            outputs=[as_warp(room.known, Vec4)],
            device=self._detector.device,
        )
        room.download()

    def _enqueue_lowest(self, near: float, gaps: Sequence[wp.array], lowest: torch.Tensor) -> None:
        wp.launch(
            kernels.lowest_point_per_cell_kernel,
            (self._points.cell_count, self._lanes),
            inputs=[*self._cells, near, self._points.gap_tolerance, *gaps],
            outputs=[as_warp(lowest, Vec4)],
            device=self._detector.device,
            block_dim=self._lanes,
        )

    def enqueue_penetration(
        self, ends: wp.array, points: torch.Tensor, counts: torch.Tensor, seen: torch.Tensor
    ) -> None:
        """Into ``seen`` (1,), of a step that was begun by ``choose`` and ends at ``ends`` (N,), how many points sink
        that are none of ``counts`` (1,) ``points`` (K,) int32."""
        self._detector.enqueue_gaps(ends, self._gaps, self._faces)
        seen.zero_()
        wp.launch(
            kernels.penetrating_points_kernel,
            len(self._gaps),
            inputs=[
                *(ACTIVATION_DEPTH * self._tolerance, self._tolerance, MAX_SINK, MAX_CREEP),
                *(as_warp(points, wp.int32), as_warp(counts, wp.int32), self._gaps, self._start_gaps),
            ],
            outputs=[as_warp(seen, real), self._deep],
            device=self._detector.device,
        )

    def enqueue_min_gap(self, least: torch.Tensor) -> None:
        """Into ``least`` () the least gap of all, metres, after ``enqueue_sinking``."""
        torch.amin(wp.to_torch(self._gaps), dim=0, out=least)


class _TransferBuffers:
    """What goes there and comes back with so many points that are known."""

    def __init__(self, stream: GraphStream, places: int, cells: int) -> None:
        self.upload, self._parts = PinnedUpload(stream, places), [cells, places, cells]
        self._made = torch.zeros((sum(self._parts), 4), dtype=torch.float64, device=stream.device)
        self.lowest, self.known, self.deepest = self._made.split(self._parts)
        self._made_here = stream.pinned(self._made.numel())

    def download(self) -> None:
        """On its way to the host."""
        self._made_here.copy_(self._made.view(-1), non_blocking=True)

    def result(self) -> list[np.ndarray]:
        """What has come: of the cells, of the points that were told, and of the cells what sinks."""
        return np.split(self._made_here.numpy().reshape(-1, 4), np.cumsum(self._parts)[:-1])
