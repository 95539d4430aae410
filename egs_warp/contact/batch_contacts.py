"""Contacts of many worlds with copies of one body: gaps, contact points, frames and Coulomb forces, on the device
(Eq. 8, 9).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coulomb import FAILURE_TOLERANCE, MAX_ITERATIONS, REGULARIZATION_STEPS, TOLERANCE
from egs_warp.contact.detection import ContactGeometry
from egs_warp.contact.selection import ContactSelector
from egs_warp.errors import ArgumentError
from egs_warp.fem.batched import BatchedRecord, as_warp, launch_on, nonzero, repeat_offsets
from egs_warp.kernels.contact import batch_contacts as kernels
from egs_warp.kernels.contact import coulomb
from egs_warp.kernels.contact.gaps import point_gaps_kernel
from egs_warp.precision import Mat33, Vec3, Vec4, real


@dataclass(frozen=True)
class BatchContacts(BatchedRecord):
    """Active contact points of one step in c worlds, padded to the capacity K. Padding has zero weights."""

    points: torch.Tensor
    """(c, K) int64, point indices."""
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
    """(c, K) int64, index of the contact plane."""

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

    def with_capacity(self, capacity: int) -> BatchContacts:
        """Return the contacts padded to ``capacity``, which is at least the current one."""
        more = capacity - self.capacity
        arrays = {name: padded(value, more) for name, value in self.batched_fields() if name != "counts"}
        return replace(self, **arrays)


def padded(values: torch.Tensor, more: int) -> torch.Tensor:
    """Pad ``values`` (c, K, ...) with ``more`` zeros along the second axis."""
    return torch.cat([values, values.new_zeros((len(values), more, *values.shape[2:]))], dim=1) if more else values


class BatchDetector:
    """Gaps and selection of contact points for at most ``count`` worlds: the batched ``ContactDetector`` and
    ``ContactSelector``.
    """

    def __init__(self, geometry: ContactGeometry, points: ContactSelector, count: int, *, device: torch.device) -> None:
        """Upload the points and obstacles.

        Args:
            geometry: the points and obstacles of one world.
            points: selector, which defines the cells.
            count: maximum number of worlds.
            device: device of all tensors.

        Raises:
            ArgumentError: for uneven ground.
        """
        if geometry.field is not None:
            raise ArgumentError("geometry", "batched worlds need flat ground; run these jobs in separate processes")
        self.device, self._activation_distance, self._hysteresis, self._gap_tolerance = (
            device,
            points.activation_distance,
            points.hysteresis,
            points.gap_tolerance,
        )
        self.point_count = len(geometry.tet_from_point)
        tet_count, node_count = len(geometry.mesh.tets), len(geometry.mesh.nodes)
        planes = np.array([[*plane.normal, plane.offset] for plane in geometry.planes])
        self._model = [
            as_warp(repeat_offsets(geometry.mesh.tets, count, node_count, device), wp.vec4i),
            as_warp(repeat_offsets(geometry.tet_from_point, count, tet_count, device), wp.int32),
            as_warp(self._reals(geometry.weights).repeat(count, 1), Vec4),
            as_warp(self._reals(planes), Vec4),
            as_warp(torch.as_tensor(geometry.solid_of_each_plane, device=device), wp.int32),
        ]
        self._cells = torch.as_tensor(points.cell_from_point.astype(np.int64), device=device)
        self._cell_count = int(points.cell_from_point.max()) + 1
        self._ranks = torch.as_tensor(np.argsort(points.order), device=device)
        corners = geometry.mesh.tets[geometry.tet_from_point]
        self._nodes = torch.as_tensor(corners.astype(np.int32), device=device)
        self._weights = self._reals(geometry.weights)
        self._axes = self._reals(np.stack([np.stack([p.normal, *p.tangents()]) for p in geometry.planes]))

    def _reals(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, dtype=np.float64), device=self.device)

    def gaps(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (c, P) m, the gap of every point at ``positions`` (c, N, 3), and (c, P) int64, its contact plane."""
        gaps = positions.new_empty((len(positions), self.point_count))
        faces = torch.empty_like(gaps, dtype=torch.int32)
        launch_on(
            self.device,
            point_gaps_kernel,
            gaps.numel(),
            inputs=[*self._model, (positions.reshape(-1, 3), Vec3)],
            outputs=[(gaps.view(-1), real), (faces.view(-1), wp.int32)],
        )
        return gaps, faces.long()

    def select(
        self, previous: torch.Tensor, valid: torch.Tensor, loaded: torch.Tensor, gaps: torch.Tensor
    ) -> torch.Tensor:
        """Select the points of the next step, as ``ContactSelector.select`` does.

        Args:
            previous: (c, K) points of the previous step.
            valid: (c, K) bool, True for entries of ``previous`` that are points.
            loaded: (c, K) bool, True for points that carried load.
            gaps: (c, P) m, at the predicted end of the step.

        Returns:
            (c, P) bool.
        """
        lowest = self._lowest(gaps < self._activation_distance, gaps)
        low = gaps.new_full((len(gaps), self._cell_count), torch.inf)
        low.scatter_reduce_(1, self._cells.expand_as(gaps), torch.where(lowest, gaps, torch.inf), "amin")
        cells, before = self._cells[previous], gaps.gather(1, previous)
        close = before <= low.gather(1, cells) + self._hysteresis
        retained = valid & (before < 2.0 * self._activation_distance) & (loaded | close)
        retained_cells = torch.zeros_like(low, dtype=torch.int32).scatter_reduce_(1, cells, retained.int(), "amax") > 0
        chosen = lowest & ~retained_cells.gather(1, self._cells.expand_as(gaps))
        return chosen | (
            torch.zeros_like(gaps, dtype=torch.int32).scatter_reduce_(1, previous, retained.int(), "amax") > 0
        )

    def find_deeper(self, contacts: BatchContacts, gaps: torch.Tensor, depth: float) -> torch.Tensor:
        """Return (c, P) bool, the deepest point of each cell whose gap in ``gaps`` (c, P) is below ``-depth`` and which
        is not in ``contacts``.
        """
        deep = gaps < -depth
        active = torch.zeros_like(gaps, dtype=torch.int32)
        active.scatter_reduce_(1, contacts.points, contacts.valid.int(), "amax")
        return self._lowest(deep & (active == 0), gaps)

    def _lowest(self, among: torch.Tensor, gaps: torch.Tensor) -> torch.Tensor:
        """Return (c, P) bool, the lowest point of each cell in the mask ``among``. Ties go to the point closest to
        the centre.
        """
        cells, heights = self._cells.expand_as(gaps), (gaps / self._gap_tolerance).round()
        low = gaps.new_full((len(gaps), self._cell_count), torch.inf)
        low.scatter_reduce_(1, cells, torch.where(among, heights, torch.inf), "amin")
        ranks = self._ranks.expand_as(gaps)
        candidates = torch.where(among & (heights == low.gather(1, cells)), ranks, self.point_count)
        first = torch.full_like(low, self.point_count, dtype=torch.int64)
        first.scatter_reduce_(1, cells, candidates, "amin")
        return ranks == first.gather(1, cells)

    def contacts(
        self, selected: torch.Tensor, gaps: torch.Tensor, faces: torch.Tensor, order: torch.Tensor | None = None
    ) -> BatchContacts:
        """Build the contacts of the selected points, and block until the device has finished.

        Args:
            selected: (c, P) bool.
            gaps: (c, P) m, at the start of the step.
            faces: (c, P), at the start of the step.
            order: (c, P) m, gaps by which the points are sorted; None sorts by index.
        """
        counts = selected.sum(dim=1)
        capacity = int(counts.max()) if len(counts) else 0
        columns = (selected.cumsum(dim=1) - 1).clamp(min=0)
        # Points that are not selected are written to an extra column, which is dropped.
        points = torch.zeros((len(selected), capacity + 1), dtype=torch.int64, device=self.device)
        numbers = torch.arange(self.point_count, device=self.device).expand_as(selected)
        points.scatter_(1, torch.where(selected, columns, capacity), torch.where(selected, numbers, 0))
        points = points[:, :capacity]
        valid = torch.arange(capacity, device=self.device) < counts[:, None]
        if order is not None:
            key = torch.where(valid, (order.gather(1, points) / self._gap_tolerance).round(), torch.inf)
            points = points.gather(1, key.argsort(dim=1, stable=True))
        at = faces.gather(1, points)
        return BatchContacts(
            points,
            counts.int(),
            self._nodes[points],
            self._weights[points] * valid[:, :, None],
            self._axes[at] * valid[:, :, None, None],
            gaps.gather(1, points) * valid,
            at,
        )

    def append_contacts(
        self, contacts: BatchContacts, forces: torch.Tensor, added: BatchContacts
    ) -> tuple[BatchContacts, torch.Tensor]:
        """Append the contacts ``added`` to ``contacts``, and zeros to ``forces`` (c, K, 3); block until the device has
        finished.
        """
        wide = contacts.with_capacity(max(int((contacts.counts + added.counts).max()), contacts.capacity))
        forces = padded(forces, wide.capacity - contacts.capacity)
        world, slot = added.valid.nonzero(as_tuple=True)
        at = contacts.counts.long()[world] + slot
        counts = contacts.counts + added.counts
        grown = {name: value.clone() for name, value in wide.batched_fields() if name != "counts"}
        for name, value in grown.items():
            value[world, at] = getattr(added, name)[world, slot]
        return replace(wide, counts=counts, **grown), forces

    def transfer_forces(
        self, contacts: BatchContacts, before: torch.Tensor, valid: torch.Tensor, forces: torch.Tensor
    ) -> torch.Tensor:
        """Map contact forces of the previous step to ``contacts``; they are zero for new points.

        Args:
            contacts: contacts of the step.
            before: (c, L) points of the previous step.
            valid: (c, L) bool, True for entries of ``before`` that are points.
            forces: (c, L, 3) newtons.

        Returns:
            (c, K, 3) newtons.
        """
        by_point = forces.new_zeros((len(forces), self.point_count, 3))
        world, slot = valid.nonzero(as_tuple=True)
        by_point[world, before[world, slot]] = forces[world, slot]
        current = by_point.gather(1, contacts.points[:, :, None].expand(-1, -1, 3))
        return current * contacts.valid[:, :, None]


def coulomb_forces_batch(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute Coulomb forces of c worlds, as ``coulomb_forces`` does in one.

    Args:
        counts: (c,) int32, number of contacts of each world.
        delassus: (c, 3K, 3K) m/(N s).
        free_velocity: (c, 3K) m/s without contact forces.
        shift: (c, K) m/s, bias of the normal velocities.
        frictions: (c,).
        start: (c, K, 3) newtons, initial forces.

    Returns:
        (c, K, 3) newtons and the residuals (c,) in m/s.
    """
    worlds, capacity, _ = start.shape
    if worlds == 0 or capacity == 0:
        return start.clone(), start.new_zeros(worlds)
    result, residual = _solve(counts, delassus, free_velocity, shift, frictions, start)
    failed = nonzero(residual > FAILURE_TOLERANCE)
    if len(failed) == 0:
        return result, residual
    counts, operators, free, shift, frictions, forces = (
        each[failed].contiguous() for each in (counts, delassus, free_velocity, shift, frictions, start)
    )
    diagonal = operators.diagonal(dim1=1, dim2=2)
    mean = diagonal.sum(dim=1, keepdim=True) / (3 * counts[:, None])
    for softness in (*REGULARIZATION_STEPS, 0.0):
        soft = operators + torch.diag_embed((softness * mean).expand_as(diagonal))
        forces, new_residual = _solve(counts, soft, free, shift, frictions, forces)
    better = new_residual < residual[failed]
    result[failed[better]], residual[failed[better]] = forces[better], new_residual[better]
    return result, residual


def _solve(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the forces with the kernel alone, without continuation."""
    worlds, capacity, _ = start.shape
    forces, residual, size = start.clone(), start.new_zeros(worlds), 3 * capacity
    vectors = start.new_empty((worlds, 5, size))
    indices = torch.empty((worlds, 2, size), dtype=torch.int32, device=start.device)
    matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))
    lanes = coulomb.BLOCK if start.is_cuda else 1
    values = delassus, free_velocity, shift, frictions
    launch_on(
        start.device,
        coulomb.coulomb_kernel,
        (worlds, lanes),
        inputs=[
            (counts, wp.int32),
            *((each.contiguous(), real) for each in values),
            *(TOLERANCE, MAX_ITERATIONS),
            *((forces.view(worlds, size), real), (vectors, real), (indices, wp.int32), (matrices, Vec4)),
        ],
        outputs=[(residual, real)],
        block_dim=lanes,
    )
    return forces, residual
