"""Contacts between bodies: the contact points of each body against the level sets of the other bodies.

``PairContactDetector`` finds the pairs of bodies that may touch in a step, selects contact points with the
``ContactSelector`` of each body, and builds a two-sided ``PairContactSet``. The mathematics is in
``kernels/contact/pair_contact.py``. The step does not use it yet (docs/concepts/bodies.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.contact.detection import ContactGeometry
from egs_warp.contact.selection import ContactSelector
from egs_warp.kernels.contact import pair_contact as kernels
from egs_warp.launching import copy_into, empty, launch_cached, zeros
from egs_warp.meshing.level_set import LevelSet
from egs_warp.precision import Mat33, Vec3, Vec4, real
from egs_warp.short_repr import short_repr

BODY_INFLATION = 1.0
"""Inflation of the bounding box of each body, in multiples of its activation distance."""
TET_INFLATION = 2.0
"""Inflation of the bounding boxes of the tetrahedra, in multiples of the activation distance. It equals the gap at
which a selected point is dropped. Parts of a body that are further outside its cage cannot be touched, because elements
extrapolate badly.
"""
_STRETCH = 1.01
"""Upper bound of the stretch of a prop. A prop has a single tetrahedron, which extrapolates exactly."""


@dataclass(frozen=True)
class PairBody:
    """Data of a body that contact with other bodies needs."""

    __repr__ = short_repr

    geometry: ContactGeometry
    """Cage at rest and contact points."""
    selector: ContactSelector
    """Cells of the contact points, activation distance and hysteresis."""
    level_set: LevelSet
    """Level set of the shape at rest, in the frame of the cage."""


@dataclass(frozen=True, eq=False)
class PairContactSet:
    """n contacts between bodies, sorted by key. Contact velocities are the velocities of body a relative to body b."""

    keys: np.ndarray
    """(n, 3) int: body a, body b, contact point of body a."""
    nodes: np.ndarray
    """(n, 2, 4) int, nodes of body a and of body b, in the numbering of all bodies."""
    weights: np.ndarray
    """(n, 2, 4) float64, barycentric weights of the contact point in the tetrahedra of body a and of body b, sum 1."""
    axes: np.ndarray
    """(n, 3, 3), contact frames: the rows are the unit normal, from b to a, and two unit tangents."""
    gaps: np.ndarray
    """(n,) m, signed distance at the start of the step."""
    node_count: int
    """Number N of nodes of all bodies."""

    @property
    def count(self) -> int:
        """Number n of contacts."""
        return len(self.keys)

    @cached_property
    def jacobian(self) -> sparse.csr_matrix:
        """Sparse (3n, 3N) contact Jacobian W. The rows of a contact are its axes times the weights, with positive sign
        at the nodes of body a and negative sign at the nodes of body b.
        """
        signed = self.weights * np.array([[1.0], [-1.0]])
        entries = self.axes[:, :, None, None, :] * signed[:, None, :, :, None]
        columns = np.broadcast_to(3 * self.nodes[:, None, :, :, None] + np.arange(3), entries.shape)
        rows = np.repeat(np.arange(3 * self.count), 24)
        shape = 3 * self.count, 3 * self.node_count
        return sparse.csr_matrix((entries.ravel(), (rows, columns.ravel())), shape)


class PairContactDetector:
    """Detector of the contacts between the bodies of one world.

    The nodes of the bodies are concatenated; the nodes of body i begin at ``node_starts[i]``.
    """

    def __init__(self, bodies: Sequence[PairBody], *, device: str | None = None) -> None:
        self.bodies, self.device = tuple(bodies), wp.get_device(device)
        sizes = [len(body.geometry.mesh.nodes) for body in bodies]
        self.node_starts = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        """(nbody + 1,) first node of each body, and the number of all nodes."""
        self._margins = [BODY_INFLATION * body.selector.activation_distance + _protrusion(body) for body in bodies]
        self._states = [_DeformedBody(body, self.device) for body in bodies]

    def body_pairs(self, positions: np.ndarray) -> list[tuple[int, int]]:
        """Return the ordered pairs (a, b) of bodies whose inflated boxes overlap at ``positions`` (N, 3), both (a, b)
        and (b, a), in ascending order.
        """
        boxes = [
            (part.min(axis=0) - margin, part.max(axis=0) + margin)
            for part, margin in zip(self._split(positions), self._margins, strict=True)
        ]
        lows, highs = (np.array(each).reshape(-1, 3) for each in zip(*boxes, strict=True))
        overlaps = np.all((lows[:, None] <= highs) & (lows <= highs[:, None]), axis=2)
        np.fill_diagonal(overlaps, False)
        return [(int(a), int(b)) for a, b in np.argwhere(overlaps)]

    def select(
        self, end_positions: np.ndarray, previous: PairContactSet | None = None, loaded: np.ndarray | None = None
    ) -> np.ndarray:
        """Select the contacts of a step: in each cell of body a at most one point against each body b, by the rules of
        ``ContactSelector``.

        Args:
            end_positions: (N, 3) m, at the predicted end of the step.
            previous: contacts of the previous step.
            loaded: (m,) bool, True for contacts of ``previous`` that carried load.

        Returns:
            (n, 3) int, keys in ascending order.
        """
        pairs = self.body_pairs(end_positions)
        self._place(end_positions, {body for pair in pairs for body in pair})
        keys = []
        for a, b in pairs:
            points, was_loaded = np.zeros(0, int), np.zeros(0, bool)
            if previous is not None and loaded is not None:
                same = (previous.keys[:, :2] == (a, b)).all(axis=1)
                points, was_loaded = previous.keys[same, 2], loaded[same]
            selected = self.bodies[a].selector.select(points, was_loaded, self._gaps(a, b))
            keys.append(np.column_stack([np.tile([a, b], (len(selected), 1)), selected]))
        return np.concatenate([np.zeros((0, 3), int), *keys])

    def gaps(self, a: int, b: int, positions: np.ndarray) -> np.ndarray:
        """Return (P,) m, the gaps of the contact points of body ``a`` to body ``b`` at ``positions`` (N, 3) of all
        bodies; infinite for points outside the inflated tetrahedra of body ``b``.
        """
        self._place(positions, {a, b})
        return self._gaps(a, b)

    def contact_set(self, keys: np.ndarray, positions: np.ndarray) -> PairContactSet:
        """Return the contacts with the ``keys`` (n, 3) from ``select``, for nodal ``positions`` (N, 3) m at the start
        of the step.
        """
        keys = np.asarray(keys, int).reshape(-1, 3)
        self._place(positions, set(keys[:, :2].ravel().tolist()))
        starts, changes = np.unique(keys[:, :2], axis=0, return_index=True)
        records = []
        bounds = np.append(changes, len(keys)).tolist()
        for (a, b), start, end in zip(starts.tolist(), bounds[:-1], bounds[1:], strict=True):
            records.append(self._record(a, b, keys[start:end, 2]))
        empty = np.zeros((0, 2, 4), int), np.zeros((0, 2, 4)), np.zeros((0, 3, 3)), np.zeros(0)
        fields = [np.concatenate(each) for each in zip(empty, *records, strict=True)]
        return PairContactSet(keys, *fields, node_count=int(self.node_starts[-1]))

    def _split(self, positions: np.ndarray) -> list[np.ndarray]:
        return np.split(positions, self.node_starts[1:-1])

    def _place(self, positions: np.ndarray, bodies: Iterable[int]) -> None:
        parts = self._split(positions)
        for body in bodies:
            self._states[body].place(parts[body])

    def _gaps(self, a: int, b: int) -> np.ndarray:
        first, second = self._states[a], self._states[b]
        launch_cached(
            kernels.pair_gaps_kernel,
            first.gaps.shape,
            inputs=[*first.points, *second.shape, first.positions, second.positions],
            outputs=[first.gaps, first.tets_of(b)],
            device=self.device,
        )
        return first.gaps.numpy()[0].copy()

    def _record(self, a: int, b: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        first, second, shape = self._states[a], self._states[b], (1, len(points))
        outputs = [zeros(shape, kind, self.device) for kind in (wp.vec4i, Vec4, wp.vec4i, Vec4, Mat33, real)]
        chosen = wp.array(points[None], dtype=int, device=self.device)
        count = wp.array([len(points)], dtype=int, device=self.device)
        launch_cached(
            kernels.pair_record_kernel,
            shape,
            inputs=[*first.points, *second.shape, chosen, count, first.tets_of(b), first.positions, second.positions],
            outputs=outputs,
            device=self.device,
        )
        nodes, weights, other_nodes, other_weights, axes, gaps = (each.numpy()[0] for each in outputs)
        both = np.stack([nodes + self.node_starts[a], other_nodes + self.node_starts[b]], axis=1)
        return both, np.stack([weights, other_weights], axis=1), axes, gaps


class _DeformedBody:
    """Constants of a body on a device, its deformed tetrahedra in a bounding volume hierarchy, and gap buffers."""

    def __init__(self, body: PairBody, device: wp.Device) -> None:
        geometry, mesh, self.device = body.geometry, body.geometry.mesh, device
        self._margin = TET_INFLATION * body.selector.activation_distance + _protrusion(body)
        self.points = [
            wp.array(mesh.tets[geometry.tet_from_point], dtype=wp.vec4i, device=device),
            wp.array(geometry.weights, dtype=Vec4, device=device),
        ]
        self.positions = wp.array(mesh.nodes[None], dtype=Vec3, device=device)
        self._tets = wp.array(mesh.tets, dtype=wp.vec4i, device=device)
        self._lowers, self._uppers = (empty(len(mesh.tets), wp.vec3, device) for _ in range(2))
        self._compute_boxes()
        self._hierarchy = wp.Bvh(self._lowers, self._uppers, groups=zeros(len(mesh.tets), int, device))
        rest = wp.array(mesh.nodes[None], dtype=Vec3, device=device)
        level_set = body.level_set
        self.shape = [self._tets, rest, self._hierarchy.id, level_set.lattice, level_set.on_device(device)]
        self.gaps = zeros((1, len(geometry.weights)), real, device)
        self._tets_of: dict[int, wp.array] = {}

    def place(self, positions: np.ndarray) -> None:
        """Move the nodes to ``positions`` (N, 3)."""
        copy_into(self.positions, positions[None])
        self._compute_boxes()
        self._hierarchy.refit()

    def tets_of(self, other: int) -> wp.array:
        """Return the buffer (1, P) for the tetrahedron of body ``other`` at each point, initially -1."""
        if other not in self._tets_of:
            self._tets_of[other] = wp.full(self.gaps.shape, -1, dtype=int, device=self.device)
        return self._tets_of[other]

    def _compute_boxes(self) -> None:
        inputs = [self._tets, self._margin, self.positions]
        launch_cached(
            kernels.tet_boxes_kernel,
            (1, len(self._tets)),
            inputs=inputs,
            outputs=[self._lowers, self._uppers],
            device=self.device,
        )


def _protrusion(body: PairBody) -> float:
    """Return an upper bound, in metres, of the distance between the contact points of a prop and its tetrahedron. It is
    0 for a cage of several tetrahedra, which encloses the body.
    """
    mesh, weights = body.geometry.mesh, body.geometry.weights
    if len(mesh.tets) > 1:
        return 0.0
    inside = np.maximum(weights, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    offsets = (weights - inside) @ mesh.nodes[mesh.tets[0]]
    return _STRETCH * float(np.linalg.norm(offsets, axis=1).max())
