"""Contacts of many worlds with copies of one body, as tensors on the device: gaps, selection and records (Eq. 8).

The mathematics is in the kernels that ``ContactDetector`` and ``ContactSelector`` launch for one world or many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp

from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batched import BatchedRecord, as_warp, launch_on
from egs_warp.kernels.contact import contacts as kernels
from egs_warp.precision import Mat33, Vec3, Vec4, real


@dataclass(frozen=True)
class BatchContacts(BatchedRecord):
    """Active contact points of one step in c worlds, padded to the capacity K. Padding has zero weights."""

    points: torch.Tensor
    """(c, K) int32, point indices."""
    counts: torch.Tensor
    """(c,) int32, number of contacts of each world."""
    nodes: torch.Tensor
    """(c, K, 4) int32."""
    weights: torch.Tensor
    """(c, K, 4), barycentric weights."""
    axes: torch.Tensor
    """(c, K, 3, 3), contact frames: the rows are the unit normal and two unit tangents."""
    gaps: torch.Tensor
    """(c, K) m, signed distance at the start of the step."""
    faces: torch.Tensor
    """(c, K) int32, index of the contact plane."""

    @classmethod
    def at(
        cls,
        detector: ContactDetector,
        points: torch.Tensor,
        counts: torch.Tensor,
        positions: torch.Tensor,
        start: Sequence[torch.Tensor],
    ) -> BatchContacts:
        """Build the contacts of the selected points, and block until the device has finished.

        Args:
            detector: detector of the body's points.
            points: (c, L) int32, points, of which each world uses its first ``counts`` (c,).
            counts: int32.
            positions: (c, N, 3) m, at the start of the step.
            start: gaps (c, P) m and faces (c, P) there.
        """
        capacity = int(counts.max()) if len(counts) else 0
        points = points[:, :capacity].contiguous()
        nodes, faces = counts.new_empty((*points.shape, 4)), torch.empty_like(points)
        weights, axes, gaps = (positions.new_empty((*points.shape, *size)) for size in ((4,), (3, 3), ()))
        if points.numel() > 0:
            kinds = (nodes, wp.vec4i), (weights, Vec4), (axes, Mat33), (gaps, real), (faces, wp.int32)
            inputs = _arrays(wp.int32, points, counts) + _arrays(Vec3, positions)
            inputs += _arrays(real, start[0]) + _arrays(wp.int32, start[1])
            detector.enqueue_record(inputs, [as_warp(*each) for each in kinds])
        return cls(points, counts, nodes, weights, axes, gaps, faces)

    @property
    def capacity(self) -> int:
        """Capacity K."""
        return self.points.shape[1]

    @property
    def valid(self) -> torch.Tensor:
        """(c, K) bool, True for entries that are contacts."""
        return torch.arange(self.capacity, device=self.counts.device) < self.counts[:, None]

    def _kernel_inputs(self) -> list[Any]:
        pairs = (self.counts, wp.int32), (self.nodes, wp.vec4i), (self.weights, Vec4), (self.axes, Mat33)
        return [(each.contiguous(), kind) for each, kind in pairs]

    def jacobian_transposed(self, node_count: int) -> torch.Tensor:
        """Return (c, 3N, 3K), the transposed contact Jacobian W^T."""
        rows = self.weights.new_zeros((len(self.counts), 3 * node_count, 3 * self.capacity))
        self._launch(kernels.contact_jacobian_kernel, (len(rows), self.capacity), [], rows, real)
        return rows

    def contact_velocities(self, velocities: torch.Tensor) -> torch.Tensor:
        """Return (c, 3K, m), W v for nodal velocities v (c, 3N, m)."""
        out = self.weights.new_empty((len(self.counts), 3 * self.capacity, velocities.shape[2]))
        dim = (len(out), self.capacity, velocities.shape[2])
        self._launch(kernels.contact_velocities_kernel, dim, [(velocities.contiguous(), real)], out, real)
        return out

    def nodal_forces(self, forces: torch.Tensor, node_count: int) -> torch.Tensor:
        """Return (c, N, 3) newtons, W^T f for contact ``forces`` (c, K, 3)."""
        out = self.weights.new_empty((len(self.counts), node_count, 3))
        self._launch(kernels.nodal_forces_kernel, out.shape[:2], [(forces.contiguous(), Vec3)], out, Vec3)
        return out

    def end_gaps(self, dt: float, velocities: torch.Tensor) -> torch.Tensor:
        """Return (c, K) m, the gaps after ``dt`` seconds at nodal end ``velocities`` (c, N, 3)."""
        return self.gaps + dt * self.contact_velocities(velocities.flatten(1)[:, :, None])[:, 0::3, 0]

    def _launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], out: torch.Tensor, kind: Any) -> None:
        if out.numel() > 0:
            launch_on(out.device, kernel, tuple(dim), inputs=[*self._kernel_inputs(), *inputs], outputs=[(out, kind)])

    def transferred_forces(self, points: torch.Tensor, counts: torch.Tensor, forces: torch.Tensor) -> torch.Tensor:
        """Return (c, K, 3) newtons, the contact ``forces`` (c, L, 3) at the first ``counts`` (c,) of the ``points`` (c,
        L) of the previous step; zero for new points.
        """
        has_force = torch.arange(points.shape[1], device=points.device) < counts[:, None]
        is_same = (self.points[:, :, None] == points[:, None]) & self.valid[:, :, None] & has_force[:, None]
        return is_same.double() @ forces

    def with_capacity(self, capacity: int) -> BatchContacts:
        """Return the contacts padded to ``capacity``, which is at least the current one."""
        more = capacity - self.capacity
        arrays = {name: padded(value, more) for name, value in self.batched_fields() if name != "counts"}
        return replace(self, **arrays)


def padded(values: torch.Tensor, more: int) -> torch.Tensor:
    """Pad ``values`` (c, K, ...) with ``more`` zeros along the second axis."""
    return torch.cat([values, values.new_zeros((len(values), more, *values.shape[2:]))], dim=1) if more else values


def point_gaps(detector: ContactDetector, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (c, P) m, the gap of every point at ``positions`` (c, N, 3), and (c, P) int32, its contact plane."""
    gaps = positions.new_empty((len(positions), detector.point_count))
    faces = torch.empty_like(gaps, dtype=torch.int32)
    if len(positions) > 0:
        detector.enqueue_gaps(as_warp(positions.contiguous(), Vec3), as_warp(gaps, real), as_warp(faces, wp.int32))
    return gaps, faces


def select_contacts(
    selector: ContactSelector, previous: Sequence[torch.Tensor], gaps: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Select the points of the next step, as ``ContactSelector.select`` does.

    Args:
        selector: selector of the body's points.
        previous: points (c, L) int32 of the previous step, their counts (c,) int32, and (c, L) int32, 1 for those that
            carried load.
        gaps: (c, P) m, at the predicted end of the step.

    Returns:
        (c, L + C) int32 points, and (c,) int32 counts.
    """
    cells, slots = selector.cell_count, previous[0].shape[1]
    lowest, candidates, points = (previous[1].new_zeros((len(gaps), n)) for n in (cells, slots + cells, slots + cells))
    counts = torch.zeros_like(previous[1])
    if len(gaps) > 0:
        arrays = (_arrays(wp.int32, *each) for each in (previous, (lowest, candidates), (points, counts)))
        before, work, selected = arrays
        selector.enqueue_selection(before, as_warp(gaps, real), work, selected)
    return points, counts


def penetrating_points(
    selector: ContactSelector, contacts: BatchContacts, gaps: Sequence[torch.Tensor], tolerance: float
) -> torch.Tensor:
    """Return (c, C) int32, the deepest point of each cell that would end too deep and is not in ``contacts``, or -1;
    ``gaps`` (c, P) m at the end and at the start of the step, penetration ``tolerance`` m.
    """
    found, lowest = gaps[0].new_zeros(len(contacts.counts)), contacts.counts[:, None].repeat(1, selector.cell_count)
    if len(found) > 0:
        inputs = _arrays(wp.int32, contacts.points, contacts.counts), _arrays(real, *gaps)
        selector.enqueue_penetrating(*inputs, tolerance, [*_arrays(real, found), *_arrays(wp.int32, lowest)])
    return lowest


def append_points(
    selector: ContactSelector, contacts: BatchContacts, lowest: torch.Tensor, gaps: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Append the points in ``lowest`` (c, C) that are not negative, those with the smallest ``gaps`` (c, P) in metres
    first; return the points (c, K) and their counts (c,). There is at least one world.
    """
    points, counts = padded(contacts.points, selector.cell_count), contacts.counts.clone()
    selected = _arrays(wp.int32, points, counts)
    selector.enqueue_append(as_warp(lowest.contiguous(), wp.int32), as_warp(gaps.contiguous(), real), selected)
    return points, counts


def _arrays(kind: Any, *tensors: torch.Tensor) -> list[wp.array]:
    """Return Warp arrays that share the memory of the ``tensors``, or of copies of those that are not contiguous."""
    return [as_warp(each.contiguous(), kind) for each in tensors]
