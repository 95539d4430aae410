"""Contacts of a step, in one world or in many, and the products with their Jacobian W (Eq. 8).

A contact consists of a surface point that moves with the four nodes of its tetrahedron, and a frame of a unit normal
and two unit tangents. If the point touches another body, a second tetrahedron with negative weights follows, so that
the contact velocity is relative to that body. W maps nodal velocities to contact velocities in these frames; W^T maps
contact forces to nodal forces.

``ContactSet`` is the record of contacts for one world on the host, one world on a GPU, and many worlds. Its arrays are
NumPy arrays or PyTorch tensors; the kernels in ``kernels/contact/contacts.py`` accept both without copying.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.batched import BatchedRecord, array_module, as_warp, contiguous, empty_like, launch_on, padded
from egs_warp.kernels.contact import contacts as kernels
from egs_warp.precision import Mat33, Vec3, Vec4, real


@dataclass(frozen=True)
class ContactSet(BatchedRecord):
    """Active contact points of one step: n of one world, or up to K in each of B worlds.

    The arrays of B worlds have a leading world axis, and each world uses its first ``counts`` entries; its other
    entries have zero weights. The arrays of one world on the host have no world axis and no padding.
    """

    points: Any
    """(n,) or (B, K) int, indices into the geometry's points."""
    nodes: Any
    """(n, 4) or (B, K, 4) int32, nodes of each point's tetrahedron. In worlds of several bodies (n, 8): the nodes of
    the tetrahedron of the other body follow."""
    weights: Any
    """(n, 4) or (B, K, 4) float64, barycentric weights, sum 1. The weights of another body's tetrahedron are negative,
    sum -1; for a contact with the ground they are 0."""
    axes: Any
    """(n, 3, 3) or (B, K, 3, 3), contact frames: the rows are the unit normal and two unit tangents."""
    gaps: Any
    """(n,) or (B, K) m, signed distance at the start of the step."""
    faces: Any
    """(n,) or (B, K) int32, index of the contact plane of each point; 0 is the ground, flat or not. For a contact with
    another body, the value is -1 minus the index of the body."""
    node_count: int
    """Number N of nodes of a world."""
    counts: Any = None
    """(B,) int32, number of contacts of each world; None without a world axis."""

    @property
    def capacity(self) -> int:
        """Number of entries of each world: n of one world on the host, otherwise K."""
        return self.points.shape[-1]

    @property
    def count(self) -> int:
        """Number n of contacts of one world on the host."""
        assert self.counts is None
        return self.capacity

    @property
    def valid(self) -> Any:
        """(B, K) bool, True for entries that are contacts."""
        return valid_entries(self.counts, self.capacity)

    @property
    def nearest_nodes(self) -> np.ndarray:
        """(n,) for each contact of one world, the node of its tetrahedron with the largest weight."""
        return self.nodes[np.arange(self.count), np.argmax(self.weights, axis=1)]

    @cached_property
    def jacobian(self) -> sparse.csr_matrix:
        """Sparse (3n, 3N) contact Jacobian W of one world. Rows 3i to 3i + 2 map nodal velocities to the normal and two
        tangential velocities of contact i."""
        entries = self.weights[:, None, :, None] * self.axes[:, :, None]
        columns = 3 * self.nodes[:, None, :, None] + np.arange(3, dtype=np.int32)
        offsets = np.arange(0, entries.size + 1, 3 * self.nodes.shape[1], dtype=np.int32)
        indices = np.broadcast_to(columns, entries.shape).reshape(-1)
        return sparse.csr_matrix((entries.reshape(-1), indices, offsets), (3 * self.count, 3 * self.node_count))

    @cached_property
    def jacobian_columns(self) -> sparse.csr_matrix:
        """Sparse (3N, 3n) transposed contact Jacobian W^T of one world."""
        return self.jacobian.T.tocsr()

    def jacobian_transposed(self, out: Any = None) -> Any:
        """Return the transposed contact Jacobian W^T, (3N, 3n) or (B, 3N, 3K). ``out`` is zeroed memory for the
        result."""
        if out is None:
            out = empty_like(self.weights, self._shape(3 * self.node_count, 3 * self.capacity))
            out[:] = 0.0
        by_world = out.reshape((self._worlds, *out.shape[-2:]))
        self._launch(kernels.contact_jacobian_kernel, (self.capacity,), [], by_world, real)
        return out

    def contact_velocities(self, velocities: Any, out: Any = None) -> Any:
        """Return W v, (3n,) or (B, 3K) m/s, for nodal velocities v (3N,) or (B, 3N). If v has a trailing axis of
        columns, so has the result. ``out`` is memory for the result."""
        shape = self._shape(3 * self.capacity, *velocities.shape[self.points.ndim :])
        out = empty_like(velocities, shape) if out is None else out
        columns = shape[-1] if velocities.ndim > self.points.ndim else 1
        by_column, out_by_column = (
            each.reshape((self._worlds, 3 * count, columns))
            for each, count in ((velocities, self.node_count), (out, self.capacity))
        )
        dim = self.capacity, columns
        self._launch(kernels.contact_velocities_kernel, dim, [(by_column, real)], out_by_column, real)
        return out

    def nodal_forces(self, forces: Any) -> Any:
        """Return W^T f, (N, 3) or (B, N, 3) newtons, for contact ``forces`` f (n, 3) or (B, K, 3)."""
        if isinstance(forces, np.ndarray) and self.counts is None:
            # The sparse product is faster than a kernel launch.
            return (self.jacobian_columns @ forces.ravel()).reshape(-1, 3)
        out = empty_like(forces, self._shape(self.node_count, 3))
        by_contact, by_node = (
            each.reshape((self._worlds, count, 3)) for each, count in ((forces, self.capacity), (out, self.node_count))
        )
        self._launch(kernels.nodal_forces_kernel, (self.node_count,), [(by_contact, Vec3)], by_node, Vec3)
        return out

    def end_gaps(self, dt: float, velocities: Any) -> Any:
        """Return (n,) or (B, K) m, the gaps after a step of ``dt`` seconds with nodal end velocities (N, 3) or (B, N,
        3). On uneven ground, gaps are distances to the tangent plane at the start of the step."""
        flat = velocities.reshape(self._shape(3 * self.node_count))
        return self.gaps + dt * self.contact_velocities(flat)[..., 0::3]

    @property
    def _worlds(self) -> int:
        return 1 if self.counts is None else len(self.counts)

    def _shape(self, *of_one_world: int) -> tuple[int, ...]:
        """Return the shape of an array that holds one array of the shape ``of_one_world`` for each world."""
        return (*self.points.shape[:-1], *of_one_world)

    @cached_property
    def arrays(self) -> list[wp.array]:
        """Warp arrays (B,) and (B, K) of counts, nodes, weights and axes, the arguments of the kernels."""
        counts = np.array([self.capacity], np.int32) if self.counts is None else self.counts
        shape = *self.points.shape[:-1], self.capacity * (self.nodes.shape[-1] // 4), 4
        by_side = [each.reshape(shape) for each in (self.nodes, self.weights)]
        pairs = (by_side[0], wp.vec4i), (by_side[1], Vec4), (self.axes, Mat33)
        return [as_warp(counts, wp.int32), *(self._array(*pair) for pair in pairs)]

    def _array(self, values: Any, kind: Any) -> wp.array:
        """Return a Warp array (B, ...) of elements of type ``kind``, which shares the memory of contiguous values."""
        return as_warp(contiguous(values if self.counts is not None else values.reshape((1, *values.shape))), kind)

    def _launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[tuple[Any, Any]], out: Any, kind: Any) -> None:
        if 0 in out.shape:
            return
        arrays = [as_warp(contiguous(each[0]), each[1]) for each in inputs]
        launch_on(out, kernel, (self._worlds, *dim), inputs=[*self.arrays, *arrays], outputs=[(out, kind)])

    def transferred_forces(self, before: Any, forces: Any, counts: Any = None) -> Any:
        """Map the contact forces of the previous step to these contacts.

        Args:
            before: (m,) or (B, L), contact points of the previous step.
            forces: (m, 3) or (B, L, 3) newtons, contact forces at these points.
            counts: (B,) number of valid entries of ``before`` in each world, or None.

        Returns:
            (n, 3) or (B, K, 3) newtons; zero for points that had no contact before.
        """
        is_same = self.points[..., None] == before[..., None, :]
        if counts is not None:
            is_same = is_same & self.valid[..., None] & valid_entries(counts, before.shape[-1])[:, None]
        return array_module(forces).where(is_same[..., None], forces[..., None, :, :], 0.0).sum(-2)

    def concatenate(self, others: ContactSet) -> ContactSet:
        """Return these contacts of one world followed by ``others`` of the same body."""
        return ContactSet.concatenated([self, others])

    def of_entries(self, entries: np.ndarray) -> ContactSet:
        """Return the contacts with the indices ``entries`` (k,) of this record of one world."""
        return self.gather(entries)

    def with_nodes_of(self, nodes: slice) -> ContactSet:
        """Return the contacts of one world with node numbers relative to the start of ``nodes``, and -1 for nodes
        outside this range. The result can only be used to compare node numbers."""
        if nodes == slice(None):
            return self
        is_inside = (self.nodes >= nodes.start) & (self.nodes < nodes.stop)
        return replace(self, nodes=np.where(is_inside, self.nodes - nodes.start, -1))

    def with_capacity(self, capacity: int) -> ContactSet:
        """Return the contacts padded to ``capacity``, which must not be below the current one."""
        more = capacity - self.capacity
        return replace(self, **{k: padded(v, more) for k, v in self.batched_fields() if k != "counts"})

    def download(self) -> list[ContactSet]:
        """Return the contacts of each world as a record on the host."""
        arrays = {name: value.cpu().numpy() for name, value in self.batched_fields()}
        counts, arrays["points"] = arrays.pop("counts").tolist(), arrays["points"].astype(int)
        return [
            ContactSet(**{name: values[world, :count] for name, values in arrays.items()}, node_count=self.node_count)
            for world, count in enumerate(counts)
        ]


def valid_entries(counts: Any, capacity: int) -> Any:
    """Return (B, capacity) bool, True for the first ``counts`` (B,) entries of each world."""
    return counts.new_ones(capacity).cumsum(0) <= counts[:, None]


def push_out_speeds(gaps: Any, dt: float, cap: float, factor: float, slop: float) -> Any:
    """Return the velocity-independent terms of the normal measure, m/s (docs/concepts/contact.md).

    The normal measure at the velocity u' is c = N^T u' + max(phi, 0) / dt + max(min(phi + slop, 0) b / dt, -cap).

    Args:
        gaps: phi, m, an array or a tensor of any shape.
        dt: step size, s.
        cap: maximum push-out speed, m/s.
        factor: b, fraction of the depth removed in a step.
        slop: depth that is tolerated, m.
    """
    return gaps.clip(0.0, None) / dt + ((gaps + slop).clip(None, 0.0) * factor / dt).clip(-cap, None)
