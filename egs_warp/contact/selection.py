"""Selection of the contact points of a step: few, evenly spread and stable from step to step (Eq. 8)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactGeometry
from egs_warp.fem.batched import as_warp, padded
from egs_warp.geometry.tetmesh import mean_edge_length
from egs_warp.kernels.contact import selection as kernels
from egs_warp.launching import PinnedMirror, copy_into, grow_capacity, launch_cached, zeros
from egs_warp.precision import real

if TYPE_CHECKING:
    import torch

MAX_CELLS_AT_REST = 32
"""Maximum number of cells that touch the ground at rest. The cage cannot resolve more contact forces than it has nodes
on the ground."""
_MIN_SPACING = 0.4
"""Minimum spacing of the cells in mean edge lengths of the cage, so that small feet stand on several cells."""
GAP_TOLERANCE_FRACTION = 1e-7
"""Gap tolerance as a fraction of the activation distance. Of points whose gaps are equal within the tolerance, the one
closest to the centre of the cell is selected. Without a tolerance, rounding errors in the points of a flat sole would
select different points on different machines."""
ACTIVATION_DEPTH = 0.6
"""Depth at the end of a step beyond which a point is added to the contact set, as a fraction of the penetration
tolerance."""
MAX_SINK = 0.3
"""Fraction of the penetration tolerance by which a point that is already deep may sink in a step without being added.
"""
MAX_CREEP = 0.02
"""``MAX_SINK`` for a point that would end deeper than the penetration tolerance itself."""
_SPACING_GROWTH = 1.1
"""Growth factor of the cell spacing until few enough cells touch the ground."""
_FEW_SEEDS, _ROUNDING = 32, 1.0 + 1e-9
"""Number of seeds from which the distances of points are computed near a new seed only, and the factor of this
neighbourhood's radius that covers rounding."""


class ContactSelector:
    """Selector of contact points, in one world or in many: cells of the surface, at least 0.4 mean cage edges apart,
    with at most one point each.

    A cell contributes its lowest point. A selected point is dropped once its gap exceeds twice the activation distance.
    A point without load is also dropped if its cell has a clearly lower point. Without this hysteresis points would
    alternate, and the load would oscillate.

    During a step, points that would be too deep at its end are added: points that would be deeper than
    ``ACTIVATION_DEPTH`` of the penetration tolerance and would sink by more than ``MAX_SINK`` of it (by more than
    ``MAX_CREEP`` if they would be deeper than the tolerance). Again only the lowest point of each cell is added.
    """

    def __init__(
        self, geometry: ContactGeometry, *, activation_distance: float, hysteresis: float, device: str | None = None
    ) -> None:
        """Divide the surface into cells.

        Args:
            geometry: the points.
            activation_distance: m. A cell is active if its lowest point may come this close to a solid in the
                step.
            hysteresis: m. Another point of the cell replaces an unloaded one only if it is lower by this much.
            device: device of the selection.
        """
        self.activation_distance, self.hysteresis = activation_distance, hysteresis
        self.gap_tolerance = GAP_TOLERANCE_FRACTION * activation_distance
        corners = geometry.mesh.tets[geometry.tet_from_point]
        positions = np.einsum("pw,pwi->pi", geometry.weights, geometry.mesh.nodes[corners])
        # Positions are rounded so that every machine assigns points that are equally far from two centres to the same
        # cell.
        positions = self.gap_tolerance * np.rint(positions / self.gap_tolerance)
        heights = geometry.ground_heights(positions)
        sole = np.flatnonzero(heights < heights.min() + 2.0 * activation_distance)
        spacing = _MIN_SPACING * mean_edge_length(geometry.mesh)
        self.cell_from_point, away = _few_cells(positions, heights, sole, spacing, MAX_CELLS_AT_REST)
        # The points are sorted by cell; within a cell, those closest to its centre come first.
        order = np.lexsort((np.rint(away / self.gap_tolerance), self.cell_from_point))
        self.cell_count = int(self.cell_from_point.max()) + 1
        bounds = np.searchsorted(self.cell_from_point[order], np.arange(self.cell_count + 1))
        self.device = wp.get_device(device)
        self._order, self._bounds, self._cell_from_point = (
            wp.array(each, dtype=int, device=device) for each in (order, bounds, self.cell_from_point)
        )
        self._lanes = 1 if self.device.is_cpu else kernels.BLOCK
        self._buffers: _SelectionBuffers | None = None

    def enqueue_selection(
        self, previous: Sequence[wp.array], gaps: wp.array, work: Sequence[wp.array], selected: Sequence[wp.array]
    ) -> None:
        """Select the points of the next step, in ascending order, asynchronously.

        Args:
            previous: points (B, L) of the previous step, their counts (B,), and (B, L) int, 1 for points that carried
                load.
            gaps: (B, P) m, at the end of a ballistic step.
            work: workspaces (B, C) int and (B, L + C) int.
            selected: points (B, K) with K at least L + C, and counts (B,), overwritten.
        """
        lowest, candidates = work
        inputs = [self._order, self._bounds, self.activation_distance, self.gap_tolerance, gaps]
        self._launch(kernels.lowest_point_per_cell_kernel, (*lowest.shape, self._lanes), inputs, [lowest])
        inputs = [self._cell_from_point, self.activation_distance, self.hysteresis, *previous, gaps, lowest]
        self._launch(kernels.select_points_kernel, (len(lowest), self._lanes), inputs, [candidates, *selected])

    def enqueue_penetrating(
        self, contacts: Sequence[wp.array], gaps: Sequence[wp.array], tolerance: float, penetrating: Sequence[wp.array]
    ) -> None:
        """Find the points that would be too deep at the end of a step and are not contacts, asynchronously.

        Args:
            contacts: points (B, K) and counts (B,).
            gaps: (B, P) m, at the end and at the start of the step.
            tolerance: penetration tolerance, m.
            penetrating: (B,), increased by the number of such points, and (B, C) int, overwritten with the deepest such
                point of each cell, -1 if there is none.
        """
        inputs = [self._order, self._bounds, self.gap_tolerance, ACTIVATION_DEPTH * tolerance, tolerance]
        inputs += [MAX_SINK, MAX_CREEP, *contacts, *gaps]
        self._launch(kernels.penetrating_points_kernel, (*penetrating[1].shape, self._lanes), inputs, penetrating)

    def enqueue_append(self, lowest: wp.array, gaps: wp.array, contacts: Sequence[wp.array]) -> None:
        """Append points to contacts in ascending order of their gaps, asynchronously.

        Args:
            lowest: (B, C) int, points that are not contacts yet, or -1.
            gaps: (B, P) m, gaps of all points.
            contacts: points (B, K) and counts (B,), extended. K must be large enough.
        """
        inputs = [self.gap_tolerance, lowest, gaps]
        self._launch(kernels.append_points_kernel, (len(lowest), self._lanes), inputs, contacts)

    def _launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], outputs: Sequence[wp.array]) -> None:
        if self.device.is_cpu:
            launch_cached(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)
        else:
            wp.launch(kernel, dim, inputs=inputs, outputs=list(outputs), device=self.device, block_dim=self._lanes)

    def select(self, previous: np.ndarray, loaded: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Select the points of the next step in one world.

        Args:
            previous: (m,) points of the previous step.
            loaded: (m,) bool, True for points that carried load.
            gaps: (P,) m, at the end of a ballistic step.

        Returns:
            (n,) points in ascending order.
        """
        buffers = self._buffers_for(len(previous))
        buffers.write(previous, loaded)
        copy_into(buffers.gaps, gaps[None])
        self.enqueue_selection(buffers.previous, buffers.gaps, buffers.work, buffers.selected)
        return buffers.read()

    def find_penetrating(
        self, points: np.ndarray, gaps: np.ndarray, start_gaps: np.ndarray, tolerance: float
    ) -> np.ndarray:
        """Find the points that would be too deep at the end of a step and are not contacts.

        Args:
            points: (n,) contact points of the step.
            gaps: (P,) m, at the end of the step.
            start_gaps: (P,) m, at the start of the step.
            tolerance: penetration tolerance, m.

        Returns:
            (k,) the deepest such point of each cell, sorted by depth, deepest first.
        """
        buffers = self._buffers_for(len(points))
        buffers.write(points, np.zeros(len(points), bool))
        copy_into(buffers.gaps, gaps[None])
        copy_into(buffers.start_gaps, start_gaps[None])
        buffers.selected[1].zero_()
        both, lowest = [buffers.gaps, buffers.start_gaps], buffers.work[0]
        self.enqueue_penetrating(buffers.previous[:2], both, tolerance, [buffers.penetrating, lowest])
        self.enqueue_append(lowest, buffers.gaps, buffers.selected)
        return buffers.read()

    def _buffers_for(self, count: int) -> _SelectionBuffers:
        if self._buffers is None or self._buffers.capacity < count:
            self._buffers = _SelectionBuffers(self, grow_capacity(count))
        return self._buffers

    def select_in_worlds(
        self, previous: Sequence[torch.Tensor], gaps: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the points (c, L + C) int32 of the next step in c worlds and their counts (c,) int32; arguments as in
        ``enqueue_selection``, but tensors on the device."""
        before, capacity = previous[1], previous[0].shape[1] + self.cell_count
        lowest, *arrays = (before.new_zeros((len(gaps), n)) for n in (self.cell_count, capacity, capacity))
        candidates, points, counts = *arrays, before.new_zeros(len(before))
        if len(gaps) > 0:
            work, selected = _arrays(wp.int32, lowest, candidates), _arrays(wp.int32, points, counts)
            self.enqueue_selection(_arrays(wp.int32, *previous), as_warp(gaps, real), work, selected)
        return points, counts

    def find_penetrating_in_worlds(
        self, contacts: ContactSet, gaps: Sequence[torch.Tensor], tolerance: float
    ) -> torch.Tensor:
        """Return (c, C) int32, in c worlds, the deepest point of each cell that would be too deep at the end of a step
        and is not a contact, or -1; arguments as in ``enqueue_penetrating``."""
        found = gaps[0].new_zeros(len(contacts.counts))
        lowest = contacts.counts[:, None].repeat(1, self.cell_count)
        if len(found) > 0:
            inputs = _arrays(wp.int32, contacts.points, contacts.counts), _arrays(real, *gaps)
            self.enqueue_penetrating(*inputs, tolerance, [*_arrays(real, found), *_arrays(wp.int32, lowest)])
        return lowest

    def append_in_worlds(
        self, contacts: ContactSet, lowest: torch.Tensor, gaps: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Append points to the contacts of c >= 1 worlds, and return all points (c, K) and their counts (c,); arguments
        as in ``enqueue_append``."""
        points, counts = padded(contacts.points, self.cell_count), contacts.counts.clone()
        inputs = as_warp(lowest.contiguous(), wp.int32), as_warp(gaps.contiguous(), real)
        self.enqueue_append(*inputs, _arrays(wp.int32, points, counts))
        return points, counts


def _arrays(kind: type, *tensors: torch.Tensor) -> list[wp.array]:
    """Return Warp arrays that share the memory of the ``tensors``, or of copies of those that are not contiguous."""
    return [as_warp(each.contiguous(), kind) for each in tensors]


class _SelectionBuffers:
    """Buffers of the selection in one world, with up to ``capacity`` points of the previous step."""

    def __init__(self, selector: ContactSelector, capacity: int) -> None:
        device, cells, count = selector.device, selector.cell_count, len(selector.cell_from_point)
        self.capacity = capacity
        self.gaps, self.start_gaps = (zeros((1, count), real, device) for _ in range(2))
        self.penetrating = zeros(1, real, device)
        points, loaded = (zeros((1, capacity), int, device) for _ in range(2))
        self.previous = [points, zeros(1, int, device), loaded]
        self.work = [zeros((1, cells), int, device), zeros((1, capacity + cells), int, device)]
        self.selected = [zeros((1, capacity + cells), int, device), zeros(1, int, device)]
        self._inputs, self._results = (
            [PinnedMirror(each) for each in arrays] for arrays in (self.previous, self.selected)
        )
        self._padded = np.zeros((2, 1, capacity), np.int32)

    def write(self, points: np.ndarray, loaded: np.ndarray) -> None:
        """Upload ``points`` (m,) of the previous step and the flags ``loaded`` (m,), True if they carried load."""
        for target, values in zip(self._padded, (points, loaded), strict=True):
            target[0, : len(values)] = values
        for mirror, values in zip(
            self._inputs, (self._padded[0], np.array([len(points)]), self._padded[1]), strict=True
        ):
            mirror.put(values)

    def read(self) -> np.ndarray:
        """Return the selected points."""
        points, counts = PinnedMirror.get_all(*self._results)
        return points[0, : counts[0]].astype(int)


def _few_cells(
    positions: np.ndarray, heights: np.ndarray, sole: np.ndarray, spacing: float, maximum: int
) -> tuple[np.ndarray, np.ndarray]:
    """Assign points to cells, at most ``maximum`` of which touch the ground.

    Args:
        positions: (P, 3) m, points at rest.
        heights: (P,) m above the ground.
        sole: indices of the points near the ground.
        spacing: minimum distance of the cell centres, m; it grows until the cells are few enough.
        maximum: maximum number of cells with points of the sole.

    Returns:
        (P,) cell of each point and (P,) its distance to the cell centre, m.
    """
    seeds, apart = _spread(positions, int(np.argmin(heights)), spacing)
    while True:
        first = seeds[: np.count_nonzero(apart >= spacing)]
        away, nearest = (np.asarray(each) for each in KDTree(positions[first]).query(positions))
        if len(np.unique(nearest[sole])) <= maximum:
            return nearest.astype(int), away
        spacing *= _SPACING_GROWTH


def _spread(positions: np.ndarray, start: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Select points by farthest-point sampling, at least ``spacing`` metres apart.

    A coarser sampling is a prefix of the result.

    Args:
        positions: (P, 3) m.
        start: index of the first point.
        spacing: minimum distance, m.

    Returns:
        (k,) indices and (k,) m, the distance of each point to the nearest one before it.
    """
    tree = KDTree(positions)
    seeds, apart = [start], [np.inf]
    distance = np.full(len(positions), np.inf)
    furthest, near = start, np.arange(len(positions))
    while True:
        if len(seeds) > _FEW_SEEDS:
            # Only points that are nearer to the new seed than the furthest point was to any seed can come closer.
            reach = _ROUNDING * distance[furthest]
            near = np.array(tree.query_ball_point(positions[furthest], reach, return_sorted=False))
        x, y, z = (positions[near] - positions[furthest]).T
        distance[near] = np.minimum(distance[near], np.sqrt(x * x + y * y + z * z))
        furthest = int(np.argmax(distance))
        if distance[furthest] < spacing:
            return np.array(seeds), np.array(apart)
        seeds.append(furthest)
        apart.append(float(distance[furthest]))
