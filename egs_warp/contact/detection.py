"""Contact of the Gaussians' bidirectional embeddings with the ground (Eq. 8-10): what touches, and in which frames."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from egs_warp.contact.terrain import Solid
from egs_warp.deformation.embedding import embed_points
from egs_warp.errors import ArgumentError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.geometry.unique_rows import distinct_rows
from egs_warp.kernels.contact import gaps as kernels
from egs_warp.kernels.contact.height_field import ground_gaps_kernel
from egs_warp.launching import PinnedMirror, launch_cached
from egs_warp.precision import Mat33, Vec3, Vec4, real

MIN_OUTSIDE_FRACTION = 0.1
"""Share of the Gaussians above the ground that are outside of all solids at rest."""
_SHORTENINGS = 40
"""Halvings in which an arm finds where it meets uneven ground."""
_BEND = 1e-7
"""Of a tetrahedron's points: far above the rounding of a double, far below what makes a point of a grid a vertex."""
_PLACES = 4
"""Positions whose gaps are kept: a step ends where the next one starts, and asks for either several times."""
_SLACK = 0.25
"""Of the grid: what is not deeper is in the plane once it is moved to the grid."""
_FINE = 0.5
"""Of the spacing of uneven ground: in each such square of it the lowest point of each tetrahedron counts."""


@dataclass(frozen=True)
class ContactGeometry:
    """Every point of the body that can ever be the first of its tetrahedron to touch. Constant."""

    mesh: TetMesh
    planes: tuple[Plane, ...]
    friction: float
    """Coulomb coefficient mu."""
    tet_from_point: np.ndarray
    """(P,) int32, tetrahedron of each point kept."""
    weights: np.ndarray
    """(P, 4) float64, barycentric weights in it (Eq. 2)."""
    excluded_count: int
    """Gaussians whose mean lies below a plane at rest."""
    excluded_opacity: float
    """Their share of the opacity mass."""
    solid_from_plane: tuple[int, ...] = ()
    """Which solid each plane is a face of, in ascending order; empty: each is a half space of its own."""
    field: HeightField | None = None
    """Ground that is not flat, in place of the first plane."""

    @property
    def solid_of_each_plane(self) -> np.ndarray:
        """(planes,) int32."""
        return np.array(self.solid_from_plane or range(len(self.planes)), dtype=np.int32)

    def ground_heights(self, points: np.ndarray) -> np.ndarray:
        """(...,) metres of ``points`` (..., 3) above the ground."""
        return (self.field or self.planes[0]).heights(points)


@dataclass(frozen=True)
class ContactSet:
    """The n points that take part in one step."""

    points: np.ndarray
    """(n,) indices into the geometry's points."""
    nodes: np.ndarray
    """(n, 4) int32."""
    weights: np.ndarray
    """(n, 4) float64, sum 1."""
    axes: np.ndarray
    """(n, 3, 3): rows are the normal and two tangents, unit."""
    gaps: np.ndarray
    """(n,) signed distance at the start of the step, metres."""
    faces: np.ndarray
    """(n,) int32: which of the geometry's planes each is held to; 0 is the ground, flat or not."""
    node_count: int
    """N."""

    @property
    def count(self) -> int:
        """n."""
        return len(self.points)

    @cached_property
    def jacobian(self) -> sparse.csr_matrix:
        """(3n, 3N): rows 3i, 3i+1, 3i+2 give the velocity of contact i along its normal and two tangents."""
        shares = self.weights[:, None, :, None] * self.axes[:, :, None]
        places = 3 * self.nodes[:, None, :, None] + np.arange(3, dtype=np.int32)
        offsets = np.arange(0, shares.size + 1, 12, dtype=np.int32)
        indices = np.broadcast_to(places, shares.shape).reshape(-1)
        return sparse.csr_matrix((shares.reshape(-1), indices, offsets), (3 * self.count, 3 * self.node_count))

    @cached_property
    def _jacobian_columns(self) -> sparse.csc_matrix:
        return self.jacobian.T

    @property
    def dense_jacobian(self) -> np.ndarray:
        """(3n, 3N) ``rows`` with their zeros."""
        return self.jacobian.toarray()

    @property
    def nearest_nodes(self) -> np.ndarray:
        """(n,) the node that each point goes with most."""
        return self.nodes[np.arange(self.count), np.argmax(self.weights, axis=1)]

    def contact_velocities(self, velocities: np.ndarray) -> np.ndarray:
        """``rows`` times nodal velocities (3N,) or (3N, k)."""
        return self.jacobian @ velocities

    def nodal_forces(self, forces: np.ndarray) -> np.ndarray:
        """(3N,) ``rows`` transposed times ``forces`` (n, 3), newtons on each node's axes."""
        return self._jacobian_columns @ forces.ravel()

    def end_gaps(self, dt: float, velocities: np.ndarray) -> np.ndarray:
        """(n,) gap after a step of ``dt`` with nodal end velocities (N, 3), to the tangent plane of the start where the
        ground is not flat.
        """
        return self.gaps + dt * self.contact_velocities(velocities.ravel())[0::3]


def contact_geometry(
    cloud: GaussianCloud,
    mesh: TetMesh,
    planes: tuple[Plane, ...],
    *,
    field: HeightField | None = None,
    solids: tuple[Solid, ...] = (),
    friction: float = 0.8,
    gamma: float = 3.0,
    grid: float | None = None,
    device: str | None = None,
) -> ContactGeometry:
    """Points of all T+ and T- (Eq. 3); endpoints below a plane at rest are shortened to it (docs/concepts/contact.md).

    ``planes`` bound half spaces, the first of them the ground, whose place ``field`` takes where it is not flat;
    ``solids`` stand on it. Only vertices of the convex hull of each tetrahedron's points are kept: a deformation is
    affine inside a tetrahedron, so the deepest point of it is always one of those. A bump can be deepest between them:
    over uneven ground the lowest point of each small square stays as well. With a ``grid`` (metres) all are moved to
    the nearest of its points and put in the order of their places: of the same body in another file, whose numbers
    are rounded otherwise, nearly all are the same then.

    Raises ``UserError`` for a solid that holds the body.
    """
    means = cloud.means.numpy().astype(np.float64)
    quaternions = cloud.rotations.numpy().astype(np.float64)
    axes = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    arms = gamma * np.exp(cloud.log_scales.numpy().astype(np.float64))[:, None, :] * axes
    obstacles = [Solid((plane,)) for plane in planes] + list(solids)
    grounds = planes if field is None else (field, *planes[1:])
    # Of a base that is flat many means and arms lie in the plane, to rounding: none of them is below it.
    slack = 0.0 if grid is None else _SLACK * grid
    above = np.all([ground.heights(means) >= -slack for ground in grounds], axis=0)
    least = MIN_OUTSIDE_FRACTION * np.count_nonzero(above)
    for number, solid in enumerate(solids, start=1):
        above &= np.any([face.heights(means) >= -slack for face in solid.faces], axis=0)
        if np.count_nonzero(above) < least:
            raise ArgumentError(
                "solids",
                f"the body is inside number {number}; inside is where n.x + d < 0 for every face [nx, ny, nz, d]:"
                " turn the signs of a face, or move the solid",
            )
    opacities = cloud.opacities()
    points = [means[above]]
    for sign in (1.0, -1.0):
        for axis in range(3):
            arm = sign * arms[above, :, axis]
            reach = np.ones(len(arm))
            if field is not None:
                reach = _reach_over(field, means[above], arm)
            for solid in obstacles if field is None else obstacles[1:]:
                rooms = np.stack([face.heights(means[above]) for face in solid.faces])
                facing = np.argmax(rooms, axis=0)
                normals = np.stack([face.normal for face in solid.faces])[facing]
                drop, room = -(arm * normals).sum(axis=1), rooms.max(axis=0) + slack
                reach = np.minimum(reach, np.where(drop > room, room / np.where(drop > room, drop, 1.0), 1.0))
            points.append(means[above] + reach[:, None] * arm)
    everything = np.concatenate(points)
    places = everything
    if grid is not None:
        places = distinct_rows(np.rint(everything / grid).astype(np.int64))[0].astype(np.float64)
        everything = grid * places
    embedding = embed_points(mesh, everything, device=device)
    tet_from_point, weights = embedding.tets.numpy(), embedding.weights.numpy()
    kept = _hull_points(tet_from_point, weights[:, 1:] if grid is None else places, len(mesh.tets))
    if field is not None:
        kept = np.union1d(kept, _lowest_points(tet_from_point, everything, field))
    return ContactGeometry(
        mesh,
        tuple(face for solid in obstacles for face in solid.faces),
        friction,
        tet_from_point[kept],
        weights[kept],
        int((~above).sum()),
        float(opacities[~above].sum() / opacities.sum()),
        tuple(index for index, solid in enumerate(obstacles) for _ in solid.faces),
        field,
    )


def _reach_over(field: HeightField, means: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """(n,) share of the ``arms`` (n, 3) of ``means`` (n, 3), which are above the ground, that stays above it."""
    low, high = np.zeros(len(arms)), np.ones(len(arms))
    low = np.where(field.heights(means + arms) >= 0.0, 1.0, low)
    for _ in range(_SHORTENINGS):
        middle = 0.5 * (low + high)
        free = field.heights(means + middle[:, None] * arms) >= 0.0
        low, high = np.where(free, np.maximum(middle, low), low), np.where(free, high, middle)
    return low


def _lowest_points(tet_from_point: np.ndarray, points: np.ndarray, field: HeightField) -> np.ndarray:
    """(k,) of ``points`` (P, 3) the lowest of each tetrahedron over each small square of the ground."""
    square = np.floor((points - field.origin) @ field.axes[:2].T / (_FINE * field.spacing)).astype(np.int64)
    place = np.column_stack([tet_from_point, square])
    order = np.argsort(field.heights(points), kind="stable")
    _, first = np.unique(place[order], axis=0, return_index=True)
    return np.sort(order[first])


def _hull_points(tet_from_point: np.ndarray, places: np.ndarray, tet_count: int) -> np.ndarray:
    """(k,) of the points the vertices of the hull of those of each tetrahedron; ``places`` (P, 3) in any axes, even
    oblique ones.
    """
    order = np.argsort(tet_from_point, kind="stable")
    bounds = np.searchsorted(tet_from_point[order], np.arange(tet_count + 1))
    kept = []
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        members = order[start:stop]
        if len(members) > 8:
            try:
                members = members[ConvexHull(_bent_in(places[members])).vertices]
            except QhullError:  # all in one plane: each may matter
                pass
        kept.append(members)
    return np.sort(np.concatenate(kept))


def _bent_in(places: np.ndarray) -> np.ndarray:
    """``places`` (n, 3), each a little nearer to the middle the nearer it is: what lies in an edge or a face of the
    hull lies inside then (|p|^2 is convex), and what does not stays a vertex. Else such points are vertices or none by
    luck.
    """
    arms = places - places.mean(axis=0)
    arms /= max(float(np.abs(arms).max()), 1e-300)
    return arms * (1.0 + _BEND * (arms**2).sum(axis=1, keepdims=True))


class ContactDetector:
    """Gaps of all points, and the frames of those that take part."""

    def __init__(self, geometry: ContactGeometry, *, device: str | None = None) -> None:
        self.geometry = geometry
        self.device = wp.get_device(device)
        self._tet_from_point = wp.array(geometry.tet_from_point, dtype=int, device=device)
        self._weights = wp.array(geometry.weights, dtype=Vec4, device=device)
        self._tets = wp.array(geometry.mesh.tets, dtype=wp.vec4i, device=device)
        # Uneven ground takes the first plane's place.
        flat = slice(0 if geometry.field is None else 1, None)
        rows = np.array([[*plane.normal, plane.offset] for plane in geometry.planes])[flat]
        self._planes = wp.array(rows.reshape(-1, 4), dtype=Vec4, device=device)
        self._solids = wp.array(geometry.solid_of_each_plane[flat], dtype=int, device=device)
        self._field: list[Any] = []
        if geometry.field is not None:
            coefficients = wp.array(geometry.field.coefficients, dtype=real, device=device)
            axes, origin = Mat33(*geometry.field.axes.ravel().tolist()), Vec3(*geometry.field.origin.tolist())
            self._field = [axes, origin, real(geometry.field.spacing), coefficients]
        self._corners = wp.array(geometry.mesh.tets[geometry.tet_from_point], dtype=wp.vec4i, device=device)
        self._heights = wp.zeros(len(rows) * len(geometry.mesh.nodes), dtype=real, device=device)
        self._positions = wp.zeros(len(geometry.mesh.nodes), dtype=Vec3, device=device)
        self._positions_here = PinnedMirror(self._positions)
        count = len(geometry.tet_from_point)
        self._gaps = wp.zeros(count, dtype=real, device=device)
        self._nearest = wp.zeros(count, dtype=int, device=device)
        self._gaps_here, self._nearest_here = PinnedMirror(self._gaps), PinnedMirror(self._nearest)
        self._frames = np.array([[plane.normal, *plane.tangents()] for plane in geometry.planes]).reshape(-1, 3, 3)
        self._only_face: np.ndarray | None = None
        if len(geometry.planes) == 1:
            self._only_face = np.zeros(count, np.int32)
            self._only_face.flags.writeable = False
        self._found: OrderedDict[bytes, tuple[np.ndarray, np.ndarray]] = OrderedDict()

    def gaps(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(P,) signed distance of every point at ``positions`` (N, 3) to the nearest solid, and (P,) its face's index;
        both are kept, and not to be written to.

        Of a solid's faces the one counts that the point is furthest in front of, or least far behind; to ground that is
        not flat the distance is ``HeightField.gaps``.
        """
        place = positions.tobytes()
        if place not in self._found:
            self._found[place] = self._find(positions)
            while len(self._found) > _PLACES:
                self._found.popitem(last=False)
        return self._found[place]

    def _find(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self._positions_here.put(positions)
        self.enqueue_gaps(self._positions, self._gaps, self._nearest)
        nearest = self._only_face
        if nearest is None:
            gaps, nearest = PinnedMirror.get_all(self._gaps_here, self._nearest_here)
            nearest.flags.writeable = False
        else:
            gaps = self._gaps_here.get()
        gaps.flags.writeable = False
        return gaps, nearest

    def enqueue_gaps(self, positions: wp.array, gaps: wp.array, nearest: wp.array) -> None:
        """The same of what lies on the device, into ``gaps`` (P,) and ``nearest`` (P,), with nothing that waits."""
        solids, outputs = [self._planes, self._solids, positions], [gaps, nearest]
        if self.device.is_cpu:
            inputs = [self._corners, self._weights, *solids]
            launch_cached(
                kernels.all_gaps_kernel, 1, inputs=inputs, outputs=[self._heights, *outputs], device=self.device
            )
        else:
            inputs = [self._tets, self._tet_from_point, self._weights, *solids]
            launch_cached(
                kernels.point_gaps_kernel, len(self._gaps), inputs=inputs, outputs=outputs, device=self.device
            )
        if self._field:
            wp.launch(
                ground_gaps_kernel,
                dim=len(self.geometry.tet_from_point),
                inputs=[self._tets, self._tet_from_point, self._weights, *self._field, positions],
                outputs=outputs,
                device=self.device,
            )

    def points_within(self, positions: np.ndarray, distance: float) -> np.ndarray:
        """(k, 3) contact points that are nearer than ``distance`` metres to a plane at ``positions`` (N, 3)."""
        near = np.flatnonzero(self.gaps(positions)[0] < distance)
        nodes = self.geometry.mesh.tets[self.geometry.tet_from_point[near]]
        return np.einsum("kw,kwi->ki", self.geometry.weights[near], positions[nodes])

    def contact_set(self, points: np.ndarray, positions: np.ndarray) -> ContactSet:
        """The given points with their frames; ``positions`` (N, 3) at the start of the step."""
        gaps, nearest = self.gaps(positions)
        return self.contact_set_at(points, positions, gaps[points], nearest[points])

    def contact_set_at(
        self, points: np.ndarray, positions: np.ndarray, gaps: np.ndarray, faces: np.ndarray
    ) -> ContactSet:
        """The same with ``gaps`` (n,) metres and ``faces`` (n,) of the ``points`` (n,) that are known."""
        nodes = self.geometry.mesh.tets[self.geometry.tet_from_point[points]]
        weights = self.geometry.weights[points]
        axes = self._frames[faces]
        if self.geometry.field is not None:
            uneven = faces == 0
            places = np.einsum("nw,nwi->ni", weights[uneven], positions[nodes[uneven]])
            axes[uneven] = self.geometry.field.frames(places)
        return ContactSet(points, nodes, weights, axes, gaps, faces, len(positions))


def push_out_speeds(gaps: np.ndarray, dt: float, cap: float, factor: float, slop: float) -> np.ndarray:
    """(n,) constant of the normal measure c = N^T u' + max(phi, 0) / dt + min(phi + slop, 0) b / dt, the push-out
    capped (docs/concepts/contact.md); b is ``factor``.
    """
    return np.maximum(gaps, 0.0) / dt + np.maximum(np.minimum(gaps + slop, 0.0) * factor / dt, -cap)


def tangent_directions(count: int) -> np.ndarray:
    """(count, 2) unit directions D of the friction pyramid, evenly spaced in the two tangents."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)
