"""Contacts of many worlds of one body side by side: gaps, points, frames and forces, on the device (Eq. 8, 9)."""

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
    """The points that take part in one step of c worlds: in each the first of K places, the rest without weight."""

    points: torch.Tensor
    """(c, K) int64."""
    counts: torch.Tensor
    """(c,) int32."""
    nodes: torch.Tensor
    """(c, K, 4) int32."""
    weights: torch.Tensor
    """(c, K, 4)."""
    axes: torch.Tensor
    """(c, K, 3, 3): rows are the normal and two tangents."""
    gaps: torch.Tensor
    """(c, K) metres at the start of the step."""
    faces: torch.Tensor
    """(c, K) int64."""

    @property
    def capacity(self) -> int:
        """K."""
        return self.points.shape[1]

    @property
    def valid(self) -> torch.Tensor:
        """(c, K) bool: the places that are taken."""
        return torch.arange(self.capacity, device=self.counts.device) < self.counts[:, None]

    def _each(self) -> list[Any]:
        pairs = (self.counts, wp.int32), (self.nodes, wp.vec4i), (self.weights, Vec4), (self.axes, Mat33)
        return [(each.contiguous(), kind) for each, kind in pairs]

    def jacobian_transposed(self, node_count: int) -> torch.Tensor:
        """(c, 3N, 3K): each column the impulses on the nodes of one along an axis of a contact."""
        rows = self.weights.new_zeros((len(self.counts), 3 * node_count, 3 * self.capacity))
        self._launch(kernels.contact_jacobian_kernel, (len(rows), self.capacity), [], rows, real)
        return rows

    def contact_velocities(self, velocities: torch.Tensor) -> torch.Tensor:
        """(c, 3K, m) of the contacts at nodal ``velocities`` (c, 3N, m)."""
        made = self.weights.new_empty((len(self.counts), 3 * self.capacity, velocities.shape[2]))
        dim = (len(made), self.capacity, velocities.shape[2])
        self._launch(kernels.contact_velocities_kernel, dim, [(velocities.contiguous(), real)], made, real)
        return made

    def nodal_forces(self, forces: torch.Tensor, node_count: int) -> torch.Tensor:
        """(c, N, 3) newtons of ``forces`` (c, K, 3) along the contacts' axes."""
        made = self.weights.new_empty((len(self.counts), node_count, 3))
        self._launch(kernels.nodal_forces_kernel, made.shape[:2], [(forces.contiguous(), Vec3)], made, Vec3)
        return made

    def end_gaps(self, dt: float, velocities: torch.Tensor) -> torch.Tensor:
        """(c, K) metres after ``dt`` seconds at nodal end ``velocities`` (c, N, 3)."""
        return self.gaps + dt * self.contact_velocities(velocities.flatten(1)[:, :, None])[:, 0::3, 0]

    def _launch(self, kernel: Any, dim: tuple[int, ...], given: list[Any], made: torch.Tensor, kind: Any) -> None:
        if made.numel() > 0:
            launch_on(made.device, kernel, tuple(dim), inputs=[*self._each(), *given], outputs=[(made, kind)])

    def with_capacity(self, most: int) -> BatchContacts:
        """With places for ``most``, at least as many as now."""
        more = most - self.capacity
        wide = {name: padded(value, more) for name, value in self.batched_fields() if name != "counts"}
        return replace(self, **wide)


def padded(values: torch.Tensor, more: int) -> torch.Tensor:
    """``values`` (c, K, ...) with so many ``more`` zeros behind the K."""
    return torch.cat([values, values.new_zeros((len(values), more, *values.shape[2:]))], dim=1) if more else values


class BatchDetector:
    """Gaps, and the choice of points, of at most ``count`` worlds: ``ContactDetector`` and ``ContactPoints``."""

    def __init__(self, geometry: ContactGeometry, points: ContactSelector, count: int, *, device: torch.device) -> None:
        """Raises ``ArgumentError`` for ground that is not flat."""
        if geometry.field is not None:
            raise ArgumentError("geometry", "many worlds stand on flat ground only; run these over processes")
        self.device, self.near, self.lower, self.alike = (
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
        """(c, P) metres of every point at ``positions`` (c, N, 3), and (c, P) int64 the plane it is held to."""
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
        self, previous: torch.Tensor, there: torch.Tensor, loaded: torch.Tensor, gaps: torch.Tensor
    ) -> torch.Tensor:
        """(c, P) bool, the points of the next step: ``ContactPoints.choose``. ``previous`` (c, K) were the last's,
        where ``there`` (c, K), ``loaded`` (c, K) those that pressed; ``gaps`` (c, P) as it may end."""
        lowest = self._lowest(gaps < self.near, gaps)
        low = gaps.new_full((len(gaps), self._cell_count), torch.inf)
        low.scatter_reduce_(1, self._cells.expand_as(gaps), torch.where(lowest, gaps, torch.inf), "amin")
        cells, before = self._cells[previous], gaps.gather(1, previous)
        close = before <= low.gather(1, cells) + self.lower
        kept = there & (before < 2.0 * self.near) & (loaded | close)
        held = torch.zeros_like(low, dtype=torch.int32).scatter_reduce_(1, cells, kept.int(), "amax") > 0
        chosen = lowest & ~held.gather(1, self._cells.expand_as(gaps))
        return chosen | (torch.zeros_like(gaps, dtype=torch.int32).scatter_reduce_(1, previous, kept.int(), "amax") > 0)

    def find_deeper(self, contacts: BatchContacts, gaps: torch.Tensor, depth: float) -> torch.Tensor:
        """(c, P) bool: ``ContactPoints.deeper`` of these ``contacts`` at ``gaps`` (c, P)."""
        deep = gaps < -depth
        taken = torch.zeros_like(gaps, dtype=torch.int32)
        taken.scatter_reduce_(1, contacts.points, contacts.valid.int(), "amax")
        return self._lowest(deep & (taken == 0), gaps)

    def _lowest(self, among: torch.Tensor, gaps: torch.Tensor) -> torch.Tensor:
        """(c, P) bool: of the points ``among`` the lowest of each cell, of several that lie alike the one next to its
        middle."""
        cells, heights = self._cells.expand_as(gaps), (gaps / self.alike).round()
        low = gaps.new_full((len(gaps), self._cell_count), torch.inf)
        low.scatter_reduce_(1, cells, torch.where(among, heights, torch.inf), "amin")
        ranks = self._ranks.expand_as(gaps)
        candidates = torch.where(among & (heights == low.gather(1, cells)), ranks, self.point_count)
        first = torch.full_like(low, self.point_count, dtype=torch.int64)
        first.scatter_reduce_(1, cells, candidates, "amin")
        return ranks == first.gather(1, cells)

    def contacts(
        self, chosen: torch.Tensor, gaps: torch.Tensor, faces: torch.Tensor, order: torch.Tensor | None = None
    ) -> BatchContacts:
        """At the points ``chosen`` (c, P), in ascending order, or in that of ``order``, metres; ``gaps`` and ``faces``
        (c, P) at the start of the step. Waits for the device."""
        counts = chosen.sum(dim=1)
        most = int(counts.max()) if len(counts) else 0
        places = (chosen.cumsum(dim=1) - 1).clamp(min=0)
        # Behind the last place lies what was not chosen.
        points = torch.zeros((len(chosen), most + 1), dtype=torch.int64, device=self.device)
        numbers = torch.arange(self.point_count, device=self.device).expand_as(chosen)
        points.scatter_(1, torch.where(chosen, places, most), torch.where(chosen, numbers, 0))
        points = points[:, :most]
        there = torch.arange(most, device=self.device) < counts[:, None]
        if order is not None:
            key = torch.where(there, (order.gather(1, points) / self.alike).round(), torch.inf)
            points = points.gather(1, key.argsort(dim=1, stable=True))
        at = faces.gather(1, points)
        return BatchContacts(
            points,
            counts.int(),
            self._nodes[points],
            self._weights[points] * there[:, :, None],
            self._axes[at] * there[:, :, None, None],
            gaps.gather(1, points) * there,
            at,
        )

    def append_contacts(
        self, contacts: BatchContacts, forces: torch.Tensor, added: BatchContacts
    ) -> tuple[BatchContacts, torch.Tensor]:
        """The ``added`` behind the ``contacts``, with ``forces`` (c, K, 3) of zero. Waits for the device."""
        wide = contacts.with_capacity(max(int((contacts.counts + added.counts).max()), contacts.capacity))
        forces = padded(forces, wide.capacity - contacts.capacity)
        world, place = added.valid.nonzero(as_tuple=True)
        at = contacts.counts.long()[world] + place
        counts = contacts.counts + added.counts
        grown = {name: value.clone() for name, value in wide.batched_fields() if name != "counts"}
        for name, value in grown.items():
            value[world, at] = getattr(added, name)[world, place]
        return replace(wide, counts=counts, **grown), forces

    def transfer_forces(
        self, contacts: BatchContacts, before: torch.Tensor, there: torch.Tensor, forces: torch.Tensor
    ) -> torch.Tensor:
        """(c, K, 3) the ``forces`` (c, L, 3) of the points ``before`` (c, L), where ``there`` (c, L), on those of them
        that are in contact now, zero on others."""
        every = forces.new_zeros((len(forces), self.point_count, 3))
        world, place = there.nonzero(as_tuple=True)
        every[world, before[world, place]] = forces[world, place]
        now = every.gather(1, contacts.points[:, :, None].expand(-1, -1, 3))
        return now * contacts.valid[:, :, None]


def coulomb_forces_batch(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """``coulomb_forces`` of c worlds with ``counts`` (c,) int32 contacts in K places: (c, K, 3) newtons, and (c,) m/s
    by which they miss contact and friction. ``delassus`` (c, 3K, 3K), ``free_velocity`` (c, 3K), ``shift`` (c, K),
    ``frictions`` (c,), ``start`` (c, K, 3)."""
    worlds, most, _ = start.shape
    if worlds == 0 or most == 0:
        return start.clone(), start.new_zeros(worlds)
    found, missed = _found(counts, delassus, free_velocity, shift, frictions, start)
    astray = nonzero(missed > FAILURE_TOLERANCE)
    if len(astray) == 0:
        return found, missed
    counts, operators, free, shift, frictions, forces = (
        each[astray].contiguous() for each in (counts, delassus, free_velocity, shift, frictions, start)
    )
    diagonal = operators.diagonal(dim1=1, dim2=2)
    mean = diagonal.sum(dim=1, keepdim=True) / (3 * counts[:, None])
    for softness in (*REGULARIZATION_STEPS, 0.0):
        soft = operators + torch.diag_embed((softness * mean).expand_as(diagonal))
        forces, left = _found(counts, soft, free, shift, frictions, forces)
    better = left < missed[astray]
    found[astray[better]], missed[astray[better]] = forces[better], left[better]
    return found, missed


def _found(
    counts: torch.Tensor,
    delassus: torch.Tensor,
    free_velocity: torch.Tensor,
    shift: torch.Tensor,
    frictions: torch.Tensor,
    start: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same by the kernel alone."""
    worlds, most, _ = start.shape
    forces, missed, size = start.clone(), start.new_zeros(worlds), 3 * most
    vectors = start.new_empty((worlds, 5, size))
    numbers = torch.empty((worlds, 2, size), dtype=torch.int32, device=start.device)
    matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))
    lanes = coulomb.BLOCK if start.is_cuda else 1
    given = delassus, free_velocity, shift, frictions
    launch_on(
        start.device,
        coulomb.coulomb_kernel,
        (worlds, lanes),
        inputs=[
            (counts, wp.int32),
            *((each.contiguous(), real) for each in given),
            *(TOLERANCE, MAX_ITERATIONS),
            *((forces.view(worlds, size), real), (vectors, real), (numbers, wp.int32), (matrices, Vec4)),
        ],
        outputs=[(missed, real)],
        block_dim=lanes,
    )
    return forces, missed
