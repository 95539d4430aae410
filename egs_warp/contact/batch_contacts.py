"""Contacts of many worlds with copies of one body, as tensors on the device: gaps, selection and records (Eq. 8).

The mathematics is in the kernels that ``ContactDetector`` and ``ContactSelector`` launch for one world or many.
"""

from __future__ import annotations

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
        start: tuple[torch.Tensor, torch.Tensor],
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
            gaps_there, faces_there = (each.contiguous() for each in start)
            detector.enqueue_record(
                [*_integers(points, counts), _vectors(positions), as_warp(gaps_there, real), *_integers(faces_there)],
                [
                    *(as_warp(nodes, wp.vec4i), as_warp(weights, Vec4), as_warp(axes, Mat33), as_warp(gaps, real)),
                    as_warp(faces, wp.int32),
                ],
            )
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
        out = forces.new_zeros((*self.points.shape, 3))
        if out.numel() > 0 and forces.numel() > 0:
            previous = [*_integers(points, counts), _vectors(forces)]
            launch_on(
                out.device,
                kernels.transfer_forces_kernel,
                tuple(self.points.shape),
                inputs=[*_integers(self.points, self.counts), *previous],
                outputs=[(out, Vec3)],
            )
        return out

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
        detector.enqueue_gaps(_vectors(positions), as_warp(gaps, real), as_warp(faces, wp.int32))
    return gaps, faces


def select_contacts(
    selector: ContactSelector,
    previous: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    gaps: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Select the points of the next step, as ``ContactSelector.select`` does.

    Args:
        selector: selector of the body's points.
        previous: points (c, L) of the previous step, their counts (c,), and (c, L) bool, True for those that carried
            load.
        gaps: (c, P) m, at the predicted end of the step.

    Returns:
        (c, K) int32 points, and (c,) int32 counts.
    """
    points, counts, loaded = previous
    cells, slots = selector.cell_count, points.shape[1]
    lowest, candidates, selected = (counts.new_zeros((len(gaps), n)) for n in (cells, slots + cells, slots + cells))
    new_counts = torch.zeros_like(counts)
    if len(gaps) > 0:
        selector.enqueue_selection(
            _integers(points, counts, loaded.int()),
            as_warp(gaps, real),
            _integers(lowest, candidates),
            _integers(selected, new_counts),
        )
    return selected, new_counts


def penetrating_points(
    selector: ContactSelector, contacts: BatchContacts, gaps: torch.Tensor, start_gaps: torch.Tensor, tolerance: float
) -> torch.Tensor:
    """Return (c, C) int32, the deepest point of each cell that would end too deep and is not in ``contacts``, or -1, as
    ``ContactSelector.find_penetrating`` does.

    Args:
        selector: selector of the body's points.
        contacts: contacts of the step.
        gaps: (c, P) m, at the end of the step.
        start_gaps: (c, P) m.
        tolerance: penetration tolerance, m.
    """
    found, lowest = gaps.new_zeros(len(gaps)), contacts.counts.new_empty((len(gaps), selector.cell_count))
    if len(gaps) > 0:
        selector.enqueue_penetrating(
            _integers(contacts.points, contacts.counts),
            [as_warp(each.contiguous(), real) for each in (gaps, start_gaps)],
            tolerance,
            [as_warp(found, real), as_warp(lowest, wp.int32)],
        )
    return lowest


def append_points(
    selector: ContactSelector, contacts: BatchContacts, lowest: torch.Tensor, gaps: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Append the points in ``lowest`` (c, C) that are not negative, those with the smallest ``gaps`` (c, P) in metres
    first; return the points (c, K) and their counts (c,).
    """
    points, counts = padded(contacts.points, selector.cell_count), contacts.counts.clone()
    if len(points) > 0:
        lowest = as_warp(lowest.contiguous(), wp.int32)
        selector.enqueue_append(lowest, as_warp(gaps.contiguous(), real), _integers(points, counts))
    return points, counts


def _integers(*tensors: torch.Tensor) -> list[wp.array]:
    return [as_warp(each.contiguous(), wp.int32) for each in tensors]


def _vectors(positions: torch.Tensor) -> wp.array:
    return as_warp(positions.contiguous(), Vec3)
