"""Audit of a world: residuals of the equations that couple its bodies (docs/concepts/bodies.md).

The residuals are computed from the trajectories of the bodies and, for gaps and penetration, from their contact points
and level sets, without any code of the solver.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.interpolate import NdBSpline
from scipy.optimize import linear_sum_assignment

from egs_warp.contact.detection import ContactGeometry, mean_frictions
from egs_warp.errors import UserError
from egs_warp.fem.joints import PointJoint
from egs_warp.io.arrays import READ_ERRORS
from egs_warp.locomotion.audit import contact_displacements, momentum_residuals, start_points
from egs_warp.locomotion.joint_audit import JointAudit, audit_joint
from egs_warp.locomotion.penetration import depth_in_body, depth_in_itself
from egs_warp.locomotion.trajectory import CONTACTS, JOINTS, Trajectory, read_arrays, write_arrays
from egs_warp.meshing.level_set import LevelSet
from egs_warp.short_repr import short_repr

_SAME_TIME = 1e-6
"""Maximum difference of two equal times, divided by the smallest step. The steps of bodies that are apart may be halved
differently, so their times differ by rounding."""
_MIN_SLOPE = 0.5
"""Lower bound of the slope of a level set in gaps (docs/concepts/bodies.md)."""
_MIN_SELF_SHIFT = 0.025
"""Minimum distance, in body heights, between the rest positions of a point and of the place at which it is inside its
own body (docs/concepts/bodies.md)."""


@dataclass(frozen=True)
class ContactShape:
    """Contact points and level set of a body."""

    __repr__ = short_repr

    point_tets: np.ndarray
    """(P,) int, tetrahedron of each contact point."""
    point_weights: np.ndarray
    """(P, 4) barycentric weights of each contact point."""
    rest_positions: np.ndarray
    """(N, 3) m, nodes of the cage at rest in the frame of the level set."""
    origin: np.ndarray
    """(3,) m, position of node (0, 0, 0) of the level set's lattice."""
    spacing: float
    """Distance between lattice nodes, m."""
    coefficients: np.ndarray
    """(nx, ny, nz) m, coefficients of the triquadratic B-spline."""

    @classmethod
    def of(cls, geometry: ContactGeometry, level_set: LevelSet, rest_positions: np.ndarray) -> Self:
        """Return the shape of a body with the contact points of ``geometry`` and the ``level_set``, in whose frame the
        nodes of the cage are at ``rest_positions`` (N, 3) m."""
        return cls(
            geometry.tet_from_point,
            geometry.weights,
            rest_positions,
            level_set.origin,
            level_set.spacing,
            level_set.coefficients,
        )

    @property
    def level_set(self) -> LevelSet:
        """The level set."""
        return LevelSet(self.origin, self.spacing, self.coefficients)

    def save(self, path: Path) -> None:
        """Write ``contact_shape.npz``; equal shapes give equal bytes."""
        write_arrays(path, {each.name: np.asarray(getattr(self, each.name)) for each in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file that ``save`` wrote. Raises ``UserError`` if it is missing or invalid."""
        try:
            arrays = read_arrays(path)
            values: dict[str, Any] = {each.name: arrays[each.name] for each in fields(cls)}
            values["spacing"] = float(values["spacing"])
            shape = cls(**values)
            shape._check()
        except FileNotFoundError as error:
            raise UserError(f"{path}: is missing; run egs-warp animate again to write it") from error
        except READ_ERRORS as error:
            raise UserError(f"{path}: cannot be read ({error}); run egs-warp animate again to write it") from error
        return shape

    def _check(self) -> None:
        """Raise ``ValueError`` for arrays that are not those of a shape."""
        count = len(self.point_tets)
        if self.point_weights.shape != (count, 4) or self.point_tets.shape != (count,):
            shapes = f"{self.point_tets.shape} and {self.point_weights.shape}"
            raise ValueError(f"its contact points and their weights have shapes {shapes}, expected (P,) and (P, 4)")
        if self.rest_positions.shape[1:] != (3,) or self.origin.shape != (3,) or self.coefficients.ndim != 3:
            shapes = f"{self.rest_positions.shape}, {self.origin.shape} and {self.coefficients.shape}"
            raise ValueError(f"its rest positions, origin and coefficients have the wrong shapes {shapes}")
        if min(self.coefficients.shape) < 3 or not (np.isfinite(self.coefficients).all() and self.spacing > 0.0):
            raise ValueError("its level set is invalid")

    def points(self, tets: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Return the contact points (P, 3) m for ``tets`` (T, 4) and nodal ``positions`` (N, 3) m."""
        return np.einsum("pw,pwi->pi", self.point_weights, positions[tets[self.point_tets]])

    def are_points(self, tets: np.ndarray, nodes: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return (n,) bool, True where ``nodes`` (n, 4) and ``weights`` (n, 4) are exactly those of a contact point."""
        return np.isin(_rows(nodes, weights), _rows(tets[self.point_tets], self.point_weights))

    @cached_property
    def _spline(self) -> NdBSpline:
        # A quadratic B-spline is centred at its lattice node and extends by 1.5 cells.
        knots = tuple(np.arange(count + 3) - 1.5 for count in self.coefficients.shape)
        return NdBSpline(knots, np.asarray(self.coefficients, np.float64), 2)

    def signed_distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (n,) m and gradients (n, 3) of the level set at ``points`` (n, 3) m of the rest shape.

        Outside the lattice without its outermost half cells, the value is that at the nearest point inside plus the
        distance to this point.
        """
        cells = (points - self.origin) / self.spacing
        inner = np.clip(cells, 0.5, np.array(self.coefficients.shape) - 1.5)
        gradients = np.stack([self._spline(inner, nu=order) for order in np.eye(3, dtype=int)], axis=1) / self.spacing
        distances = np.linalg.norm(cells - inner, axis=1)
        gradients = np.where(cells == inner, gradients, 0.0)
        gradients += (cells - inner) / np.maximum(distances, 1e-300)[:, None]
        return self._spline(inner) + self.spacing * distances, gradients

    def gaps(self, nodes: np.ndarray, weights: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gaps (n,) m and outward unit normals (n, 3) of points in deformed tetrahedra of this body.

        Args:
            nodes: (n, 4) nodes of the tetrahedra.
            weights: (n, 4) barycentric weights of the points.
            positions: (n, 4, 3) m, positions of ``nodes``.
        """
        rest = self.rest_positions[nodes]
        values, gradients = self.signed_distance(np.einsum("nw,nwi->ni", weights, rest))
        rest_edges, edges = rest[:, 1:] - rest[:, :1], positions[:, 1:] - positions[:, :1]
        # The edges e and their rest vectors E satisfy e . F^-T grad = E . grad.
        g = np.linalg.solve(edges, rest_edges @ gradients[:, :, None])[:, :, 0]
        lengths, slopes = np.linalg.norm(g, axis=1), np.linalg.norm(gradients, axis=1)
        return values / (lengths * np.maximum(1.0, _MIN_SLOPE / slopes)), g / lengths[:, None]


@dataclass(frozen=True)
class PairAudit:
    """Largest errors of the contacts between two bodies, or of a body with itself, over all steps, and the work of
    these contacts. m g is the weight of the lighter body, and H the height of the shorter one."""

    bodies: tuple[int, int]
    """Indices a < b of the bodies in the world; a = b for a body with itself."""
    contacts: int
    """Number of contacts, summed over the steps."""
    unmatched_contacts: int
    """Number of contact records without a record of exactly the opposite force in the other body."""
    force_residual: float
    """Sum of the forces on both bodies in a step, divided by m g."""
    torque_residual: float
    """Sum of the torques on both bodies about the origin in a step, divided by m g H."""
    cone_violation: float
    """Force outside the friction cone of the pair, divided by m g."""
    friction_gap: float
    """Difference between the actual work of friction and the work of a friction force at its bound that opposes the
    relative slip, divided by m g H."""
    complementarity_gap: float
    """Normal force times recomputed gap at the end of the step, divided by m g H."""
    gap_error: float
    """Difference between the stored and the recomputed gap at the end of a step, divided by H."""
    normal_error: float
    """Difference between the stored and the recomputed unit normal."""
    penetration: float
    """Depth of the deepest contact point of one body in the other, divided by H."""
    friction_work: float
    """J, work of the tangential forces on the relative motion; at most 0 up to rounding."""
    contact_work: float
    """J, work of the normal forces on points that approach the other body."""
    push_out_work: float
    """J, work of the normal forces on points that move away from the other body."""


@dataclass(frozen=True)
class WorldAudit:
    """Largest errors of a world over all steps, of each pair of bodies that touched or whose boxes overlapped, of each
    body with self contact, and of each joint. M is the mass of all bodies, and H the height of the tallest one."""

    momentum_residual: float
    """Change of the linear momentum minus the impulses of gravity, ground, pushes, drag and joints with the world, in M
    sqrt(g H)."""
    angular_momentum_residual: float
    """Change of the angular momentum about the origin minus the same impulses, in M H sqrt(g H)."""
    pairs: tuple[PairAudit, ...]
    """Audit of each pair, in ascending order."""
    joints: tuple[JointAudit, ...] = ()
    """Audit of each joint."""

    def worst(self, name: str) -> float:
        """Return the largest value of the error ``name`` of ``PairAudit``; 0 without pairs."""
        return max((getattr(pair, name) for pair in self.pairs), default=0.0)


def audit_world(
    trajectories: Sequence[Trajectory],
    shapes: Sequence[ContactShape],
    *,
    frictions: np.ndarray | None = None,
    joints: Sequence[PointJoint] = (),
    self_contact: Collection[int] = (),
) -> WorldAudit:
    """Compute the errors of the contacts between the bodies of a world, and of its momentum balances.

    Args:
        trajectories: trajectory of each of the k bodies, in the order of the world.
        shapes: shape of each body.
        frictions: (k, k) Coulomb coefficients between the bodies; None uses the geometric mean of their coefficients
            with the ground.
        joints: joints of the world. Bodies with a common joint are not a pair, because they do not touch each other.
        self_contact: indices of the bodies whose parts touch each other.
    """
    if frictions is None:
        frictions = mean_frictions([t.friction for t in trajectories])
    linear, angular = _world_impulses(trajectories, joints)
    mass, height = sum(float(t.node_mass.sum()) for t in trajectories), max(t.height for t in trajectories)
    unit = mass * np.sqrt(np.linalg.norm(trajectories[0].gravity) * height)
    boxes = [_boxes(t, shape) for t, shape in zip(trajectories, shapes, strict=True)]
    pairs, joined = [], {tuple(sorted(joint.bodies)) for joint in joints}
    for a, b in combinations_with_replacement(range(len(trajectories)), 2):
        if (a, b) in joined or (a == b and a not in self_contact):
            continue
        pair = _Pair((a, b), (trajectories[a], trajectories[b]), (shapes[a], shapes[b]), (boxes[a], boxes[b]))
        if pair.meets:
            pairs.append(pair.audit(float(frictions[a, b])))
    return WorldAudit(
        float(np.linalg.norm(linear, axis=1).max(initial=0.0) / unit),
        float(np.linalg.norm(angular, axis=1).max(initial=0.0) / (unit * height)),
        tuple(pairs),
        tuple(audit_joint(joint, number, trajectories) for number, joint in enumerate(joints)),
    )


@dataclass(frozen=True)
class _Pair:
    """Two bodies of a world, a and b. Tuples contain one value for each. If b is a, the first value is that of the
    contact points and the second that of the touched parts."""

    bodies: tuple[int, int]
    trajectories: tuple[Trajectory, ...]
    shapes: tuple[ContactShape, ...]
    boxes: tuple[np.ndarray, ...]
    """(F+1, 2, 3) m, box of the contact points in each state."""

    @property
    def is_self(self) -> bool:
        """True for a body with itself."""
        return self.bodies[0] == self.bodies[1]

    @cached_property
    def records(self) -> tuple[np.ndarray, ...]:
        """Indices (n,) of the contacts with the other body."""
        if self.is_self:
            t = self.trajectories[0]
            chosen = np.flatnonzero(t.contact_plane == -1 - self.bodies[0])
            is_point = self.shapes[0].are_points(t.tets, t.contact_nodes[chosen], t.contact_weights[chosen])
            return chosen[is_point], chosen[~is_point]
        others = zip(self.trajectories, self.bodies[::-1], strict=True)
        return tuple(np.flatnonzero(t.contact_plane == -1 - other) for t, other in others)

    @cached_property
    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the states at the times that both trajectories contain."""
        return _common_states(*self.trajectories)

    @cached_property
    def overlapping(self) -> np.ndarray:
        """(n, 2) states at common times in which the boxes of the bodies overlap."""
        i, j = self.states
        first, second = self.boxes[0][i], self.boxes[1][j]
        overlap = (first[:, 0] <= second[:, 1]) & (second[:, 0] <= first[:, 1])
        return np.stack([i, j], axis=1)[overlap.all(axis=1)]

    @property
    def meets(self) -> bool:
        """True if the bodies have contacts or overlapping boxes."""
        return len(self.overlapping) + sum(map(len, self.records)) > 0

    @cached_property
    def second_steps(self) -> np.ndarray:
        """(F,) step of b at the same time as each step of a; -1 if there is none."""
        i, j = self.states
        same = (np.diff(i) == 1) & (np.diff(j) == 1)
        steps = np.full(len(self.trajectories[0].dt), -1)
        steps[i[:-1][same]] = j[:-1][same]
        return steps

    @property
    def weight(self) -> float:
        """Weight of the lighter body, N."""
        return min(float(t.node_mass.sum() * np.linalg.norm(t.gravity)) for t in self.trajectories)

    @property
    def height(self) -> float:
        """Height of the shorter body, m."""
        return min(t.height for t in self.trajectories)

    @cached_property
    def matches(self) -> np.ndarray:
        """(n, 2) indices of the two records of each contact in the trajectories."""
        (t, u), (own, other) = self.trajectories, self.records
        features = [
            np.hstack(
                [
                    sign * each.contact_force[chosen] / self.weight,
                    sign * each.contact_normal[chosen],
                    start_points(each)[chosen] / self.height,
                    each.contact_gap[chosen, None] / self.height,
                ]
            )
            for each, chosen, sign in ((t, own, 1.0), (u, other, -1.0))
        ]
        found = [np.zeros((0, 2), int)]
        for step in np.unique(t.contact_step[own]):
            first = np.flatnonzero(t.contact_step[own] == step)
            second = np.flatnonzero(u.contact_step[other] == self.second_steps[step])
            cost = np.linalg.norm(features[0][first, None] - features[1][second], axis=2)
            rows, columns = linear_sum_assignment(cost)
            found.append(np.stack([own[first[rows]], other[second[columns]]], axis=1))
        return np.concatenate(found)

    def audit(self, friction: float) -> PairAudit:
        """Compute the errors, with the Coulomb coefficient ``friction`` of the pair."""
        (t, u), (i, j) = self.trajectories, self.matches.T
        energy = self.weight * self.height
        forces, normals = t.contact_force[i], t.contact_normal[i]
        pressed = np.einsum("ci,ci->c", forces, normals)
        tangential = forces - pressed[:, None] * normals
        moved = contact_displacements(t)[1][i] - contact_displacements(u)[1][j]
        along = np.einsum("ci,ci->c", moved, normals)
        slip = moved - along[:, None] * normals
        friction_work = np.einsum("ci,ci->c", tangential, slip)
        # See ``audit.audit``.
        friction_gap = np.abs(friction * pressed * np.linalg.norm(slip, axis=1) + friction_work)
        outside = np.maximum(np.linalg.norm(tangential, axis=1) - friction * pressed, -pressed)
        start_gaps, outward = self._geometry()
        end_gaps = start_gaps + along
        stored_gaps = np.stack([t.contact_gap[i], u.contact_gap[j]])
        stored_normals = np.stack([normals, -u.contact_normal[j]])
        exact = int((forces == -u.contact_force[j]).all(axis=1).sum())
        force, torque = self._action_and_reaction()
        work = pressed * along
        return PairAudit(
            bodies=self.bodies,
            contacts=len(i),
            unmatched_contacts=sum(map(len, self.records)) - 2 * exact,
            force_residual=force / self.weight,
            torque_residual=torque / energy,
            cone_violation=float(outside.max(initial=0.0)) / self.weight,
            friction_gap=float(friction_gap.max(initial=0.0)) / energy,
            complementarity_gap=float((pressed * np.maximum(end_gaps, 0.0)).max(initial=0.0)) / energy,
            gap_error=float(np.abs(stored_gaps - end_gaps).max(initial=0.0)) / self.height,
            normal_error=float(np.linalg.norm(stored_normals - outward, axis=2).max(initial=0.0)),
            penetration=self._penetration() / self.height,
            friction_work=float(friction_work.sum()),
            contact_work=float(work[along < 0.0].sum()),
            push_out_work=float(work[along >= 0.0].sum()),
        )

    def _action_and_reaction(self) -> tuple[float, float]:
        """Return the largest sum of the forces on both bodies in a step, N, and of their torques about the origin,
        N m."""
        wrenches = []
        for t, chosen in zip(self.trajectories, self.records, strict=True):
            forces, wrench = t.contact_force[chosen], np.zeros((len(t.dt), 6))
            torques = np.cross(start_points(t)[chosen], forces)
            np.add.at(wrench, t.contact_step[chosen], np.hstack([forces, torques]))
            wrenches.append(wrench)
        first, second = wrenches
        same = self.second_steps >= 0
        first[same] += second[self.second_steps[same]]
        second[self.second_steps[same]] = 0.0
        sums = np.concatenate(wrenches).reshape(-1, 2, 3)
        force, torque = np.linalg.norm(sums, axis=2).max(axis=0, initial=0.0).tolist()
        return force, torque

    def _geometry(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the gaps (n,) m of the matched contacts at the starts of their steps, and their unit normals (n, 3) in
        the direction from b to a, recomputed from the level set of the touched body."""
        gaps, normals = np.zeros(len(self.matches)), np.zeros((len(self.matches), 3))
        t, shape = self.trajectories[0], self.shapes[0]
        own = self.matches[:, 0]
        is_point = shape.are_points(t.tets, t.contact_nodes[own], t.contact_weights[own])
        for touched, chosen, sign in ((1, is_point, 1.0), (0, ~is_point, -1.0)):
            u, records = self.trajectories[touched], self.matches[chosen, touched]
            nodes = u.contact_nodes[records]
            corners = u.positions[u.contact_step[records][:, None], nodes]
            gaps[chosen], outward = self.shapes[touched].gaps(nodes, u.contact_weights[records], corners)
            normals[chosen] = sign * outward
        return gaps, normals

    def _penetration(self) -> float:
        """Return the depth, in metres, of the deepest contact point of one body in the other, over all states at common
        times."""
        depth = 0.0
        if self.is_self:
            t, shape = self.trajectories[0], self.shapes[0]
            points = shape.point_tets, shape.point_weights
            for positions in t.positions:
                nodes = shape.rest_positions, positions
                own = depth_in_itself(*points, shape.gaps, t.tets, *nodes, _MIN_SELF_SHIFT * self.height)
                depth = max(depth, own)
            return depth
        for states in self.overlapping:
            placed = [
                (t, shape, t.positions[state], box[state])
                for t, shape, box, state in zip(self.trajectories, self.shapes, self.boxes, states, strict=True)
            ]
            for (t, shape, positions, _), (u, other, other_positions, box) in (placed, placed[::-1]):
                points = shape.points(t.tets, positions)
                points = points[((points >= box[0]) & (points <= box[1])).all(axis=1)]
                depth = max(depth, depth_in_body(points, other.gaps, u.tets, other_positions))
        return depth


def _rows(nodes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return (n,) values that are equal where ``nodes`` (n, 4) and ``weights`` (n, 4) have equal bits."""
    both = np.ascontiguousarray(np.hstack([nodes, weights]), np.float64)
    return both.view(np.dtype((np.void, both.itemsize * both.shape[1])))[:, 0]


def _boxes(t: Trajectory, shape: ContactShape) -> np.ndarray:
    """Return (F+1, 2, 3) m, the box of the contact points in each state: least and largest coordinates."""
    points = (shape.points(t.tets, positions) for positions in t.positions)
    return np.array([(each.min(axis=0), each.max(axis=0)) for each in points])


def _common_states(t: Trajectory, u: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the states of two trajectories at the times that both contain."""
    tolerance = _SAME_TIME * min(t.dt.min(initial=np.inf), u.dt.min(initial=np.inf))
    after = np.clip(np.searchsorted(u.time, t.time), 0, len(u.time) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(t.time - u.time[before] < u.time[after] - t.time, before, after)
    same = np.abs(t.time - u.time[nearest]) <= tolerance
    return np.flatnonzero(same), nearest[same]


def _world_impulses(trajectories: Sequence[Trajectory], joints: Sequence[PointJoint]) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes (n, 3) of the momenta of the world between times that all trajectories contain, minus the
    impulses of gravity, ground, pushes, drag and joints with the world: linear in kg m/s, and angular about the origin
    in kg m^2/s."""
    with_world = [number for number, joint in enumerate(joints) if len(joint.bodies) == 1]
    first = np.arange(len(trajectories[0].time))
    for other in trajectories[1:]:
        first = np.intersect1d(first, _common_states(trajectories[0], other)[0])
    total = np.zeros((len(first) - 1, 6))
    for t in trajectories:
        here, there = _common_states(trajectories[0], t)
        states = there[np.isin(here, first)]
        impulses = _impulses(t, with_world)
        if len(total):
            total += np.add.reduceat(impulses[: states[-1]], states[:-1])
    return total[:, :3], total[:, 3:]


def _impulses(t: Trajectory, joints: Sequence[int]) -> np.ndarray:
    """Return (F, 6), the changes of the momenta of a body in each step minus the impulses of gravity, ground, pushes,
    drag and the ``joints``: linear in kg m/s, and angular about the origin in kg m^2/s."""
    chosen = ((CONTACTS, t.contact_plane >= 0), (JOINTS, np.isin(t.joint_index, joints)))
    arrays = {name: getattr(t, name)[rows] for names, rows in chosen for name in names}
    linear, angular = momentum_residuals(replace(t, **arrays))
    centres = np.einsum("n,fni->fi", t.node_mass, t.positions[:-1]) / t.node_mass.sum()
    return t.dt[:, None] * np.hstack([linear, angular + np.cross(centres, linear)])
