"""Contacts between bodies, and of bodies with themselves: contact points of each body against level sets.

``PairContactDetector`` finds the pairs of bodies that may touch in a step, selects contact points with the
``ContactSelector`` of each body, and builds a ``ContactSet`` of contacts with two sides. The mathematics is in
``kernels/contact/pair_contact.py``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.deformed_shape import DeformedShape, protrusion
from egs_warp.contact.detection import ContactGeometry
from egs_warp.contact.selection import ACTIVATION_DEPTH, ContactSelector
from egs_warp.kernels.contact import pair_contact as kernels
from egs_warp.launching import launch_cached, run_concurrently, zeros
from egs_warp.meshing.level_set import LevelSet
from egs_warp.precision import Mat33, Vec4, real
from egs_warp.short_repr import short_repr

BODY_INFLATION = 1.0
"""Inflation of the bounding box of each body, in multiples of its activation distance."""
TET_INFLATION = 2.0
"""Inflation of the bounding boxes of the tetrahedra, in multiples of the activation distance. It equals the gap at
which a selected point is dropped. Parts of a body that are further outside its cage cannot be touched, because elements
extrapolate inaccurately so far outside."""


@dataclass(frozen=True)
class PairBody:
    """Data of a body that contact with other bodies needs."""

    __repr__ = short_repr

    geometry: ContactGeometry
    """Cage at rest and contact points."""
    selector: ContactSelector
    """Cells of the contact points, with the activation distance and the hysteresis of the selection."""
    level_set: LevelSet
    """Level set of the shape at rest."""
    rest_positions: np.ndarray
    """(N, 3) m, nodes of the cage at rest in the frame of the level set."""
    is_driven: bool = False
    """True if the body follows a path, so that no contact moves it."""
    self_contact: bool = False
    """True if contacts of parts of the body with each other are detected."""


class PairContactDetector:
    """Detector of the contacts between the bodies of one world.

    The nodes and the contact points of the bodies are concatenated. Each contact of the world has an index: point p of
    all P points has the index p for its contact with the ground, and (b + 1) P + p for its contact with body b.
    """

    def __init__(
        self, bodies: Sequence[PairBody], *, connected: Iterable[tuple[int, int]] = (), device: str | None = None
    ) -> None:
        """Make the detector of some ``bodies``; the ``connected`` pairs, which have a common joint, do not touch."""
        self.device = wp.get_device(device)
        driven = np.array([body.is_driven for body in bodies])
        exempt = (driven[:, None] & driven) | np.diag([not body.self_contact for body in bodies])
        for a, b in connected:
            exempt[[a, b], [b, a]] = True
        self._set_bodies(bodies, [_DeformedBody(body, self.device) for body in bodies], exempt)

    def _set_bodies(self, bodies: Sequence[PairBody], states: Sequence[_DeformedBody], exempt: np.ndarray) -> None:
        self.bodies, self._states, self._exempt = tuple(bodies), tuple(states), exempt
        nodes = [len(body.geometry.mesh.nodes) for body in bodies]
        self.point_counts = points = [len(body.geometry.tet_from_point) for body in bodies]
        """Number of contact points of each body."""
        self.node_starts = np.concatenate([[0], np.cumsum(nodes)]).astype(int)
        """(nbody + 1,) first node of each body, and the number of all nodes."""
        self.point_starts = np.concatenate([[0], np.cumsum(points)]).astype(int)
        """(nbody + 1,) first contact point of each body, and the number P of all points."""
        self._box_weights = [_box_weights(body) for body in bodies]

    def indices(self, body: int | np.ndarray, points: np.ndarray, other: int | np.ndarray) -> np.ndarray:
        """Return the indices (n,) of the contacts of ``points`` (n,) of ``body`` with the body ``other``, or with the
        ground if ``other`` is -1, among all possible contacts. ``body`` and ``other`` may also be arrays (n,)."""
        return (other + 1) * self.point_starts[-1] + self.point_starts[body] + points

    def keys(self, indices: np.ndarray) -> np.ndarray:
        """Return the keys (n, 3) of the contacts with the ``indices`` (n,): body a, body b (-1 for the ground), and the
        point of body a."""
        others, points = np.divmod(indices, self.point_starts[-1])
        bodies = np.searchsorted(self.point_starts, points, side="right") - 1
        return np.column_stack([bodies, others - 1, points - self.point_starts[bodies]])

    def body_pairs(self, positions: np.ndarray) -> list[tuple[int, int]]:
        """Return the ordered pairs (a, b) of bodies whose inflated boxes overlap at ``positions`` (N, 3) m, both (a, b)
        and (b, a), in ascending order. A body with self contact forms a pair (a, a). Two driven bodies do not form a
        pair, and bodies with a common joint neither."""
        boxes = []
        for body, weights, part in zip(self.bodies, self._box_weights, self.split(positions), strict=True):
            # A cage encloses its body; the single tetrahedron of a prop need not enclose it.
            corners = part if weights is None else weights @ part
            margin = BODY_INFLATION * body.selector.activation_distance
            boxes.append((corners.min(axis=0) - margin, corners.max(axis=0) + margin))
        lows, highs = (np.array(each).reshape(-1, 3) for each in zip(*boxes, strict=True))
        overlaps = np.all((lows[:, None] <= highs) & (lows <= highs[:, None]), axis=2)
        overlaps &= ~self._exempt
        return [(int(a), int(b)) for a, b in np.argwhere(overlaps)]

    def select(self, end_positions: np.ndarray, previous: np.ndarray, loaded: np.ndarray) -> np.ndarray:
        """Select the contacts of a step: in each cell of body a at most one point against each body b, by the rules of
        ``ContactSelector``.

        Args:
            end_positions: (N, 3) m, at the end of a ballistic step (for a driven body, its prescribed end).
            previous: (m,) indices of the contacts of the previous step.
            loaded: (m,) bool, True for those that carried load.

        Returns:
            (n,) indices, sorted by body a, body b and point.
        """
        keys, selected = self.keys(previous), [np.zeros(0, int)]
        pairs = self.body_pairs(end_positions)
        self._compute_gaps(pairs, end_positions)
        for a, b in pairs:
            same = (keys[:, 0] == a) & (keys[:, 1] == b)
            points = self.bodies[a].selector.select(keys[same, 2], loaded[same], self._gaps(a, b))
            selected.append(self.indices(a, points, b))
        return np.concatenate(selected)

    def find_penetrating(
        self, contacts: np.ndarray, start: np.ndarray, end: np.ndarray, tolerance: float
    ) -> np.ndarray:
        """Find the points that would be too deep in another body at the end of a step and are not contacts; see
        ``ContactSelector``.

        Args:
            contacts: (n,) indices of the contacts of the step.
            start: (N, 3) m, at the start of the step.
            end: (N, 3) m, at the end of the step.
            tolerance: penetration tolerance, m.

        Returns:
            (k,) indices.
        """
        keys, found = self.keys(contacts), [np.zeros(0, int)]
        pairs = self.body_pairs(end)
        self._compute_gaps(pairs, end)
        end_gaps = {(a, b): self._gaps(a, b) for a, b in pairs}
        deep = [pair for pair in pairs if end_gaps[pair].min() < -ACTIVATION_DEPTH * tolerance]
        self._compute_gaps(deep, start)
        start_gaps = {(a, b): self._gaps(a, b) for a, b in deep}
        # The end comes last, because ``contact_set`` uses the tetrahedra found by the last evaluation.
        self._compute_gaps(deep, end)
        for a, b in deep:
            own = keys[(keys[:, 0] == a) & (keys[:, 1] == b), 2]
            points = self.bodies[a].selector.find_penetrating(own, end_gaps[a, b], start_gaps[a, b], tolerance)
            found.append(self.indices(a, points, b))
        return np.concatenate(found)

    def subset(self, members: Sequence[int]) -> PairContactDetector:
        """Return a detector for some of the bodies, which shares the buffers of this detector."""
        other = copy(self)
        exempt = self._exempt[np.ix_(members, members)]
        other._set_bodies([self.bodies[i] for i in members], [self._states[i] for i in members], exempt)
        return other

    def gaps(self, a: int, b: int, positions: np.ndarray) -> np.ndarray:
        """Return (P,) m, the gaps of the contact points of body ``a`` to body ``b`` at ``positions`` (N, 3) of all
        bodies; infinite for points outside the inflated tetrahedra of body ``b``. The result is read-only."""
        self._place(positions, {a, b})
        return self._gaps(a, b)

    def may_touch_itself(self, body: int, positions: np.ndarray) -> bool:
        """Return True if a contact point of a ``body`` with self contact is near another part of the body at nodal
        ``positions`` (N, 3) m of this body."""
        if self._exempt[body, body]:
            return False
        self._states[body].place(positions)
        return bool(np.isfinite(self._gaps(body, body)).any())

    def contact_set(self, indices: np.ndarray, positions: np.ndarray) -> ContactSet:
        """Return the contacts with the ``indices`` (n,) from ``select``, for nodal ``positions`` (N, 3) m at the start
        of the step."""
        keys = self.keys(indices)
        self._place(positions, set(keys[:, :2].ravel().tolist()))
        pairs = np.unique(keys[:, :2], axis=0)
        order, records = [], [(np.zeros((0, 8), np.int32), np.zeros((0, 8)), np.zeros((0, 3, 3)), np.zeros(0))]
        for a, b in pairs.tolist():
            chosen = np.flatnonzero((keys[:, 0] == a) & (keys[:, 1] == b))
            order.append(chosen)
            records.append(self._record(a, b, keys[chosen, 2]))
        back = np.argsort(np.concatenate([np.zeros(0, int), *order]))
        nodes, weights, axes, gaps = (np.concatenate(each)[back] for each in zip(*records, strict=True))
        faces = (-1 - keys[:, 1]).astype(np.int32)
        return ContactSet(indices, nodes, weights, axes, gaps, faces, int(self.node_starts[-1]))

    def split(self, positions: np.ndarray) -> list[np.ndarray]:
        """Split nodal ``positions`` (N, 3) m by body."""
        return [positions[a:b] for a, b in pairwise(self.node_starts.tolist())]

    def _place(self, positions: np.ndarray, bodies: Iterable[int]) -> None:
        parts = self.split(positions)
        for body in bodies:
            self._states[body].place(parts[body])

    def _compute_gaps(self, pairs: Sequence[tuple[int, int]], positions: np.ndarray) -> None:
        """Compute the gaps of all ``pairs`` (a, b) at ``positions`` (N, 3) m with two threads. ``_gaps`` returns them
        until a body of the pair moves. The pairs of a body a share its buffers, so one thread computes them."""
        self._place(positions, {body for pair in pairs for body in pair})
        bodies = sorted({a for a, _ in pairs})

        def compute(firsts: Sequence[int]) -> None:
            for a, b in pairs:
                if a in firsts:
                    self._gaps(a, b)

        if len(bodies) > 1:
            run_concurrently(partial(compute, bodies[::2]), partial(compute, bodies[1::2]))
        else:
            compute(bodies)

    def _gaps(self, a: int, b: int) -> np.ndarray:
        """Return the gaps of body ``a`` to body ``b`` at their current positions; see ``gaps``. If neither has moved
        since the last evaluation, its result is returned."""
        first, second = self._states[a], self._states[b]
        versions = first.version, second.version
        last_versions, last_gaps = first.last_gaps.get(second, (None, None))
        if last_gaps is not None and last_versions == versions:
            return last_gaps
        kernel, inputs = kernels.close_tets_kernel, [first.close_tets.shape[1], second.hierarchy.id, *first.boxes]
        if a == b:
            kernel = kernels.self_close_tets_kernel
            inputs = [*first.inputs[:3], first.reach, *first.boxes, first.positions]
        launch_cached(kernel, first.close_tets.shape, inputs=inputs, outputs=[first.close_tets], device=self.device)
        launch_cached(
            kernels.pair_gaps_kernel,
            first.close_tets.shape,
            inputs=[
                *(*first.points, *first.points_by_tet, *second.inputs, first.reach if a == b else 0.0),
                *(first.close_tets, first.positions, second.positions),
            ],
            outputs=[first.gaps, first.tets_of(second)],
            device=self.device,
        )
        gaps = first.gaps.numpy()[0].copy()
        gaps.flags.writeable = False
        first.last_gaps[second] = versions, gaps
        return gaps

    def _record(self, a: int, b: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        first, second, shape = self._states[a], self._states[b], (1, len(points))
        outputs = [zeros(shape, kind, self.device) for kind in (wp.vec4i, Vec4, wp.vec4i, Vec4, Mat33, real)]
        chosen = wp.array(points[None], dtype=int, device=self.device)
        launch_cached(
            kernels.pair_record_kernel,
            shape,
            inputs=[
                *(*first.points, *second.inputs, first.reach if a == b else 0.0, chosen),
                *(first.tets_of(second), first.positions, second.positions),
            ],
            outputs=outputs,
            device=self.device,
        )
        nodes, weights, other_nodes, other_weights, axes, gaps = (each.numpy()[0] for each in outputs)
        both = np.hstack([nodes + self.node_starts[a], other_nodes + self.node_starts[b]]).astype(np.int32)
        return both, np.hstack([weights, -other_weights]), axes, gaps


def _box_weights(body: PairBody) -> np.ndarray | None:
    """Return the barycentric weights (8, 4) of the corners of the box around the contact points of a prop at rest; None
    for a cage of several tetrahedra."""
    mesh, weights = body.geometry.mesh, body.geometry.weights
    if len(mesh.tets) > 1:
        return None
    nodes = mesh.nodes[mesh.tets[0]]
    points = weights @ nodes
    low, high = points.min(axis=0), points.max(axis=0)
    corners = np.where(np.indices((2, 2, 2)).reshape(3, -1).T == 0, low, high)
    matrix = np.vstack([nodes.T, np.ones(4)])
    return np.linalg.solve(matrix, np.vstack([corners.T, np.ones(8)])).T


class _DeformedBody(DeformedShape):
    """Deformed shape of a body, its contact points, and buffers for their gaps."""

    def __init__(self, body: PairBody, device: wp.Device) -> None:
        geometry, mesh = body.geometry, body.geometry.mesh
        self.reach = body.selector.activation_distance
        """Distance in metres outside of the tetrahedra up to which points are tested in self contact."""
        margin = TET_INFLATION * body.selector.activation_distance + protrusion(mesh, geometry.weights)
        super().__init__(mesh, body.rest_positions, body.level_set, margin=margin, device=device)
        self.points = [
            wp.array(mesh.tets[geometry.tet_from_point], dtype=wp.vec4i, device=device),
            wp.array(geometry.weights, dtype=Vec4, device=device),
        ]
        order = np.argsort(geometry.tet_from_point, kind="stable")
        starts = np.searchsorted(geometry.tet_from_point[order], np.arange(len(mesh.tets) + 1))
        self.points_by_tet = [wp.array(each, dtype=int, device=device) for each in (starts, order)]
        """First entry (T + 1,) of each tetrahedron, and the contact points (P,) sorted by their tetrahedra."""
        self.close_tets = zeros((1, len(mesh.tets)), bool, device)
        """(1, T) buffer, True for tetrahedra that are close to another body."""
        self.gaps = zeros((1, len(geometry.weights)), real, device)
        self._tets_of: dict[_DeformedBody, wp.array] = {}
        self.last_gaps: dict[_DeformedBody, tuple[tuple[int, int], np.ndarray]] = {}
        """Versions of this body and of another one, and the gaps (P,) m of this body to it at these versions."""

    def tets_of(self, other: _DeformedBody) -> wp.array:
        """Return the buffer (1, P) for the tetrahedron of ``other`` at each point, initially -1."""
        if other not in self._tets_of:
            self._tets_of[other] = wp.full(self.gaps.shape, -1, dtype=int, device=self.device)
        return self._tets_of[other]
