"""Contact points of a step chosen where a GPU has the gaps of all points: only the lowest come to the host."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coupled_step import ADDED, CREEPS, SINKS
from egs_warp.contact.detection import ContactDetector, ContactSet
from egs_warp.contact.points import ContactPoints
from egs_warp.fem.graphs import GraphStream, Recordings, Upload
from egs_warp.fem.worlds import shared
from egs_warp.kernels.contact import sight as kernels
from egs_warp.launching import by_steps
from egs_warp.precision import Vec4, real

_KNOWN = 64
"""Points of the step before are so many at a time."""


class DeviceSight:
    """Gaps of all contact points of one body, at the start of a step and where it may end."""

    def __init__(
        self, detector: ContactDetector, points: ContactPoints, stream: GraphStream, penetration_tolerance: float
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
        self._rooms: dict[int, _Room] = {}
        self._works = Recordings(stream)

    def look(self, positions: wp.array, ends: wp.array, before: np.ndarray) -> None:
        """Begin to ``choose`` for a step from ``positions`` (N,), which may end at ``ends`` (N,), after the points
        ``before`` (m,); nobody waits."""
        room = self._room_of(len(before))
        room.told.write(before)

        def look() -> None:
            room.told.send()
            self._detector.enqueue_gaps(positions, self._start_gaps, self._start_faces)
            self._detector.enqueue_gaps(ends, self._gaps, self._faces)
            self._enqueue_choice(room, self._gaps, self._start_gaps, self._start_faces)

        with self._stream:
            self._works.run((len(room.known), positions.ptr, ends.ptr), look)

    def _room_of(self, count: int) -> _Room:
        places = by_steps(count, _KNOWN)
        if places not in self._rooms:
            self._rooms[places] = _Room(self._stream, places, self._points.cell_count)
        return self._rooms[places]

    def enqueue_next(self, ends: wp.array, points: torch.Tensor) -> None:
        """``look`` for a step from where the one at hand ends, after ``enqueue_sinking`` there, which may end at
        ``ends`` (N,), after ``points`` (K,) int32; it counts if ``go_on`` says so."""
        room = self._room_of(len(points))
        room.told.there[: len(points)].copy_(points)
        for there, values in ((self._next_start_gaps, self._gaps), (self._next_start_faces, self._faces)):
            wp.to_torch(there).copy_(wp.to_torch(values))
        self._detector.enqueue_gaps(ends, self._next_gaps, self._next_faces)
        self._enqueue_lowest(-ADDED * self._tolerance, [self._deep, self._start_gaps, self._start_faces], room.deepest)
        self._enqueue_choice(room, self._next_gaps, self._next_start_gaps, self._next_start_faces)

    def go_on(self) -> None:
        """To the step for which ``enqueue_next`` has looked."""
        for there, values in ((self._start_gaps, self._next_start_gaps), (self._start_faces, self._next_start_faces)):
            wp.to_torch(there).copy_(wp.to_torch(values))

    def deepest(self, places: int) -> np.ndarray:
        """(k, 4) of points that sink where ``enqueue_next`` began the deepest of each cell: its number, its gap there,
        metres, and gap and face at the start of the step."""
        deepest = self._room_of(places).found()[2]
        return deepest[deepest[:, 0] >= 0.0]

    def choose(
        self, before: np.ndarray, loaded: np.ndarray, start: np.ndarray, *, places: int | None = None
    ) -> ContactSet:
        """The contacts of the step for which ``look`` was begun, on the host from ``start`` (N, 3): those of
        ``ContactPoints.choose`` after the points ``before`` (m,), of which those ``loaded`` (m,) bool pressed; or what
        ``enqueue_next`` has found with so many ``places``, which has come already."""
        if places is None:
            self._stream.wait()
        room = self._room_of(len(before) if places is None else places)
        lowest, known, _ = room.found()
        known = known[: len(before)]
        low = lowest[lowest[:, 0] >= 0.0]
        points = self._points.among(before, loaded, known[:, 1], low[:, 0].astype(int), low[:, 1])
        every = np.concatenate([low, known])
        # Of those that are there twice both say the same.
        _, first = np.unique(every[:, 0], return_index=True)
        every = every[first]
        chosen = every[np.searchsorted(every[:, 0], points)]
        return self._detector.contact_set_at(points, start, chosen[:, 2], chosen[:, 3].astype(np.int32))

    def _enqueue_choice(self, room: _Room, *gaps: wp.array) -> None:
        """By ``gaps`` at the end and at the start, and faces there."""
        self._enqueue_lowest(self._points.near, gaps, room.lowest)
        wp.launch(
            kernels.known_kernel,
            len(room.known),
            inputs=[shared(room.told.there, real), *gaps],
            outputs=[shared(room.known, Vec4)],
            device=self._detector.device,
        )
        room.give()

    def _enqueue_lowest(self, near: float, gaps: Sequence[wp.array], lowest: torch.Tensor) -> None:
        wp.launch(
            kernels.lowest_kernel,
            (self._points.cell_count, self._lanes),
            inputs=[*self._cells, near, self._points.alike, *gaps],
            outputs=[shared(lowest, Vec4)],
            device=self._detector.device,
            block_dim=self._lanes,
        )

    def enqueue_sinking(self, ends: wp.array, points: torch.Tensor, counts: torch.Tensor, seen: torch.Tensor) -> None:
        """Into ``seen`` (1,), of a step that was begun by ``choose`` and ends at ``ends`` (N,), how many points sink
        that are none of ``counts`` (1,) ``points`` (K,) int32."""
        self._detector.enqueue_gaps(ends, self._gaps, self._faces)
        seen.zero_()
        wp.launch(
            kernels.sinking_kernel,
            len(self._gaps),
            inputs=[
                *(ADDED * self._tolerance, self._tolerance, SINKS, CREEPS),
                *(shared(points, wp.int32), shared(counts, wp.int32), self._gaps, self._start_gaps),
            ],
            outputs=[shared(seen, real), self._deep],
            device=self._detector.device,
        )

    def enqueue_least(self, least: torch.Tensor) -> None:
        """Into ``least`` () the least gap of all, metres, after ``enqueue_sinking``."""
        torch.amin(wp.to_torch(self._gaps), dim=0, out=least)


class _Room:
    """What goes there and comes back with so many points that are known."""

    def __init__(self, stream: GraphStream, places: int, cells: int) -> None:
        self.told, self._parts = Upload(stream, places), [cells, places, cells]
        self._made = torch.zeros((sum(self._parts), 4), dtype=torch.float64, device=stream.device)
        self.lowest, self.known, self.deepest = self._made.split(self._parts)
        self._made_here = stream.pinned(self._made.numel())

    def give(self) -> None:
        """On its way to the host."""
        self._made_here.copy_(self._made.view(-1), non_blocking=True)

    def found(self) -> list[np.ndarray]:
        """What has come: of the cells, of the points that were told, and of the cells what sinks."""
        return np.split(self._made_here.numpy().reshape(-1, 4), np.cumsum(self._parts)[:-1])
