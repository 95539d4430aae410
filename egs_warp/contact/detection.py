"""Contact geometry of the Gaussians' bidirectional embeddings, their gaps to ground and solids, and the contact
Jacobian (Eq. 8-10).

``contact_geometry`` builds the points once for a body. ``ContactDetector`` evaluates their gaps with the kernels in
``kernels/contact/gaps.py`` and ``kernels/contact/height_field.py``, and builds the ``ContactSet`` of a step with
``contact_record_kernel``.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.flat_top import FlatTop
from egs_warp.contact.terrain import Solid
from egs_warp.deformation.embedding import embed_points
from egs_warp.errors import ArgumentError
from egs_warp.fem.batched import array_module, as_warp, contiguous
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.geometry.unique_rows import distinct_rows
from egs_warp.kernels.contact import gaps as kernels
from egs_warp.kernels.contact.contacts import contact_record_kernel
from egs_warp.kernels.contact.height_field import ground_gaps_kernel
from egs_warp.launching import PinnedMirror, copy_into, grow_capacity, launch_cached, zeros
from egs_warp.precision import Mat33, Vec3, Vec4, real
from egs_warp.short_repr import short_repr

if TYPE_CHECKING:
    import torch

MIN_OUTSIDE_FRACTION = 0.1
"""Minimum fraction of the Gaussians above the ground that must lie outside all solids at rest."""
_BISECTIONS = 40
"""Bisection steps that shorten an arm to uneven ground."""
_HULL_BULGE = 1e-7
"""Relative outward shift of a tetrahedron's points before the hull is computed. The shift is far above the rounding
error of float64, and far below the shift that would turn another point of the grid into a vertex."""
_CACHED_CONFIGURATIONS = 4
"""Number of configurations whose gaps are cached. The gaps at the start and the end of a step are requested several
times, and a step ends where the next one starts."""
_SLACK_FRACTION = 0.25
"""Depth below a plane, as a fraction of the grid spacing, up to which a point is treated as lying on the plane, because
rounding to the grid can shift it by this much."""
_SQUARE_FRACTION = 0.5
"""Side of a square, in spacings of uneven ground. In each square the lowest point of each tetrahedron is retained."""


def mean_frictions(own: Sequence[float]) -> np.ndarray:
    """Return the Coulomb coefficients (k, k) between k bodies: the geometric means of their ``own`` coefficients
    (k,)."""
    return np.sqrt(np.outer(own, own))


@dataclass(frozen=True)
class ContactGeometry:
    """Contact points, which are all points of the body that can be the first of their tetrahedron to touch an obstacle,
    and the obstacles."""

    __repr__ = short_repr

    mesh: TetMesh
    planes: tuple[Plane, ...]
    friction: float
    """Coulomb coefficient mu."""
    tet_from_point: np.ndarray
    """(P,) int32, tetrahedron of each point."""
    weights: np.ndarray
    """(P, 4) float64, barycentric weights in the tetrahedron (Eq. 2)."""
    excluded_count: int
    """Number of excluded Gaussians: those whose mean lies below the ground or another plane, or inside a solid, at
    rest."""
    excluded_opacity: float
    """Fraction of the total opacity that belongs to the excluded Gaussians."""
    solid_from_plane: tuple[int, ...] = ()
    """Index of the solid that each plane belongs to, in ascending order. If empty, each plane is a half space."""
    field: HeightField | None = None
    """Uneven ground, which replaces the first plane."""

    @property
    def solid_of_each_plane(self) -> np.ndarray:
        """(planes,) int32, index of the solid of each plane."""
        return np.array(self.solid_from_plane or range(len(self.planes)), dtype=np.int32)

    def ground_heights(self, points: np.ndarray) -> np.ndarray:
        """Return the heights (...,) in metres of ``points`` (..., 3) above the ground."""
        return (self.field or self.planes[0]).heights(points)


def gaussian_arms(cloud: GaussianCloud, gamma: float = 3.0) -> np.ndarray:
    """Return the vectors (n, 3, 3) from the mean of each Gaussian to its end points T+ (Eq. 3) in columns, ``gamma``
    standard deviations long. Those to T- have the opposite sign."""
    quaternions = cloud.rotations.numpy().astype(np.float64)
    axes = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    return gamma * np.exp(cloud.log_scales.numpy().astype(np.float64))[:, None, :] * axes


def contact_geometry(
    cloud: GaussianCloud,
    mesh: TetMesh,
    planes: tuple[Plane, ...],
    *,
    field: HeightField | None = None,
    solids: tuple[Solid, ...] = (),
    friction: float = 0.8,
    tops: Sequence[FlatTop] = (),
    gamma: float = 3.0,
    grid: float | None = None,
    device: str | None = None,
) -> ContactGeometry:
    """Build the contact points from the end points T+ and T- of all embeddings (Eq. 3, docs/concepts/contact.md).

    End points below an obstacle at rest are shortened to it. Only the vertices of the convex hull of each tetrahedron's
    points are stored: the deformation is affine inside a tetrahedron, so its deepest point is always one of them.
    Uneven ground can have a bump between the vertices. On uneven ground, the lowest point of each tetrahedron over each
    small square is therefore stored too.

    Args:
        cloud: the Gaussians.
        mesh: the cage.
        planes: half spaces, of which the first is the ground.
        field: uneven ground, which replaces the first plane.
        solids: further obstacles.
        friction: Coulomb coefficient.
        tops: flat parts of the surface of the body. The points of the Gaussians that they bound do not reach above
            them.
        gamma: length of the arms in standard deviations.
        grid: spacing in metres of the grid to which points are rounded before they are sorted. The points then hardly
            depend on the rounding of the numbers in the input file. None leaves the points as they are.
        device: device on which the points are embedded.

    Raises:
        ArgumentError: if fewer than ``MIN_OUTSIDE_FRACTION`` of the Gaussians above the ground lie outside all solids.
    """
    means, arms = cloud.means.numpy().astype(np.float64), gaussian_arms(cloud, gamma)
    obstacles = [Solid((plane,)) for plane in planes] + list(solids)
    grounds = planes if field is None else (field, *planes[1:])
    # Many points of a flat base lie in the plane up to rounding and are not treated as below it.
    slack = 0.0 if grid is None else _SLACK_FRACTION * grid
    above = np.all([ground.heights(means) >= -slack for ground in grounds], axis=0)
    least = MIN_OUTSIDE_FRACTION * np.count_nonzero(above)
    for number, solid in enumerate(solids, start=1):
        above &= np.any([face.heights(means) >= -slack for face in solid.faces], axis=0)
        if np.count_nonzero(above) < least:
            raise ArgumentError(
                "solids",
                f"the body is inside solid {number}, where n.x + d < 0 for every face [nx, ny, nz, d];"
                " change the signs of a face, or move the solid",
            )
    opacities = cloud.opacities()
    points = [means[above]]
    for sign in (1.0, -1.0):
        for axis in range(3):
            arm = sign * arms[above, :, axis]
            reach = np.ones(len(arm))
            if field is not None:
                reach = _fraction_above(field, means[above], arm)
            for solid in obstacles if field is None else obstacles[1:]:
                heights = np.stack([face.heights(means[above]) for face in solid.faces])
                facing = np.argmax(heights, axis=0)
                normals = np.stack([face.normal for face in solid.faces])[facing]
                drop, height = -(arm * normals).sum(axis=1), heights.max(axis=0) + slack
                reach = np.minimum(reach, np.where(drop > height, height / np.where(drop > height, drop, 1.0), 1.0))
            points.append(means[above] + reach[:, None] * arm)
    all_points = np.concatenate(points)
    for top in tops:
        all_points = top.flattened(all_points, np.tile(np.flatnonzero(above), len(points)))
    grid_points = all_points
    if grid is not None:
        grid_points = distinct_rows(np.rint(all_points / grid).astype(np.int64))[0].astype(np.float64)
        all_points = grid * grid_points
    embedding = embed_points(mesh, all_points, device=device)
    tet_from_point, weights = embedding.tets.numpy(), embedding.weights.numpy()
    retained = _hull_points(tet_from_point, weights[:, 1:] if grid is None else grid_points, len(mesh.tets))
    if field is not None:
        retained = np.union1d(retained, _lowest_points(tet_from_point, all_points, field))
    return ContactGeometry(
        mesh,
        tuple(face for solid in obstacles for face in solid.faces),
        friction,
        tet_from_point[retained],
        weights[retained],
        int((~above).sum()),
        float(opacities[~above].sum() / opacities.sum()),
        tuple(index for index, solid in enumerate(obstacles) for _ in solid.faces),
        field,
    )


def _fraction_above(field: HeightField, means: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return (n,), the fraction of each of the ``arms`` (n, 3) that stays above the ground. The arms start at the
    ``means`` (n, 3), which are above it."""
    low, high = np.zeros(len(arms)), np.ones(len(arms))
    low = np.where(field.heights(means + arms) >= 0.0, 1.0, low)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        free = field.heights(means + middle[:, None] * arms) >= 0.0
        low, high = np.where(free, np.maximum(middle, low), low), np.where(free, high, middle)
    return low


def _lowest_points(tet_from_point: np.ndarray, points: np.ndarray, field: HeightField) -> np.ndarray:
    """Return (k,), indices into ``points`` (P, 3): the lowest point of each tetrahedron over each small square of the
    ground."""
    square = np.floor((points - field.origin) @ field.axes[:2].T / (_SQUARE_FRACTION * field.spacing)).astype(np.int64)
    place = np.column_stack([tet_from_point, square])
    order = np.argsort(field.heights(points), kind="stable")
    _, first = np.unique(place[order], axis=0, return_index=True)
    return np.sort(order[first])


def _hull_points(tet_from_point: np.ndarray, places: np.ndarray, tet_count: int) -> np.ndarray:
    """Return (k,), the indices of the hull vertices of each tetrahedron's points. The points are given as ``places``
    (P, 3) in any affine coordinates."""
    order = np.argsort(tet_from_point, kind="stable")
    bounds = np.searchsorted(tet_from_point[order], np.arange(tet_count + 1))
    vertices = []
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        members = order[start:stop]
        if len(members) > 8:
            try:
                members = members[ConvexHull(_bulge(places[members])).vertices]
            except QhullError:  # All points lie in one plane, so all are retained.
                pass
        vertices.append(members)
    return np.sort(np.concatenate(vertices))


def _bulge(places: np.ndarray) -> np.ndarray:
    """Return the scaled offsets of ``places`` (n, 3) from their mean, of which longer ones are lengthened by a slightly
    larger factor. Points on an edge or face of the hull then lie strictly inside it, because |p|^2 is convex, and
    vertices remain vertices. Without this, rounding would decide which points are vertices."""
    arms = places - places.mean(axis=0)
    arms /= max(float(np.abs(arms).max()), 1e-300)
    return arms * (1.0 + _HULL_BULGE * (arms**2).sum(axis=1, keepdims=True))


class ContactDetector:
    """Detector that evaluates the gaps of all points and builds contact sets, in one world or in many."""

    def __init__(self, geometry: ContactGeometry, *, device: str | None = None) -> None:
        self.geometry = geometry
        self.device = wp.get_device(device)
        self.point_count = len(geometry.tet_from_point)
        corners = geometry.mesh.tets[geometry.tet_from_point]
        # Uneven ground replaces the first plane.
        flat = slice(0 if geometry.field is None else 1, None)
        rows = np.array([[*plane.normal, plane.offset] for plane in geometry.planes])[flat]
        frames = np.array([[plane.normal, *plane.tangents()] for plane in geometry.planes]).reshape(-1, 3, 3)
        self._points = [
            wp.array(corners, dtype=wp.vec4i, device=device),
            wp.array(geometry.weights, dtype=Vec4, device=device),
        ]
        self._planes = [
            wp.array(rows.reshape(-1, 4), dtype=Vec4, device=device),
            wp.array(geometry.solid_of_each_plane[flat], dtype=int, device=device),
        ]
        self._frames = wp.array(frames, dtype=Mat33, device=device)
        axes, origin, spacing, coefficients = np.eye(3), np.zeros(3), 1.0, np.zeros((0, 0))
        if geometry.field is not None:
            field = geometry.field
            axes, origin, spacing, coefficients = field.axes, field.origin, field.spacing, field.coefficients
        self._field: list[Any] = [Mat33(*axes.ravel().tolist()), Vec3(*origin.tolist()), real(spacing)]
        self._field.append(wp.array(coefficients, dtype=real, ndim=2, device=device))
        self._heights = wp.zeros(len(rows) * len(geometry.mesh.nodes), dtype=real, device=device)
        self._positions = wp.zeros((1, len(geometry.mesh.nodes)), dtype=Vec3, device=device)
        self._cached_gaps: OrderedDict[bytes, _PointGaps] = OrderedDict()
        self._last_gaps: _PointGaps | None = None
        self._record: _RecordBuffers | None = None

    def gaps(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the gaps of all points. The result is cached and read-only.

        The distance to a solid is the largest of the signed distances to its faces. The distance to uneven ground is
        defined by ``HeightField.gaps``.

        Args:
            positions: (N, 3) m.

        Returns:
            (P,) m, signed distance to the nearest solid, and (P,) the index of its face.
        """
        key = positions.tobytes()
        if key not in self._cached_gaps:
            if len(self._cached_gaps) < _CACHED_CONFIGURATIONS:
                has_one_face = len(self.geometry.planes) == 1
                found = _PointGaps(self.point_count, self.device, has_one_face=has_one_face)
            else:
                _, found = self._cached_gaps.popitem(last=False)
            copy_into(self._positions, positions[None])
            self.enqueue_gaps(self._positions, found.gaps, found.faces)
            found.download()
            self._cached_gaps[key] = found
        self._last_gaps = self._cached_gaps[key]
        return self._last_gaps.on_host

    def enqueue_gaps(self, positions: wp.array, gaps: wp.array, faces: wp.array) -> None:
        """Evaluate the gaps at ``positions`` (B, N) on the device into ``gaps`` (B, P) and ``faces`` (B, P),
        asynchronously. All arrays are contiguous."""
        inputs, outputs = [*self._points, *self._planes, positions], [gaps, faces]
        if self.device.is_cpu:
            outputs.insert(0, self._heights)
        kernel, dim = (
            (kernels.all_gaps_kernel, len(gaps)) if self.device.is_cpu else (kernels.point_gaps_kernel, gaps.shape)
        )
        launch_cached(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)
        if self.geometry.field is not None:
            inputs = [*self._points, *self._field, positions]
            launch_cached(ground_gaps_kernel, gaps.shape, inputs=inputs, outputs=[gaps, faces], device=self.device)

    def points_within(self, positions: np.ndarray, distance: float) -> np.ndarray:
        """Return (k, 3) m, the positions of the contact points that are closer than ``distance`` metres to an obstacle
        when the nodes are at ``positions`` (N, 3) m."""
        near = np.flatnonzero(self.gaps(positions)[0] < distance)
        nodes = self.geometry.mesh.tets[self.geometry.tet_from_point[near]]
        return np.einsum("kw,kwi->ki", self.geometry.weights[near], positions[nodes])

    def enqueue_record(self, inputs: Sequence[wp.array], outputs: Sequence[wp.array]) -> None:
        """Write the record of contacts on the device, asynchronously.

        Args:
            inputs: ``points`` (B, K) and ``counts`` (B,); ``positions`` (B, N) m of the nodes at the start of the step;
                ``gaps`` (B, P) m and ``faces`` (B, P) of all points at ``positions``.
            outputs: ``nodes``, ``weights``, ``axes``, ``gaps`` and ``faces`` (B, K), as in ``ContactSet``.
        """
        launch_cached(
            contact_record_kernel,
            inputs[0].shape,
            inputs=[*self._points, self._frames, *self._field, *inputs],
            outputs=outputs,
            device=self.device,
        )

    def gaps_of_worlds(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Evaluate the gaps of all points in c worlds, whose ``positions`` (c, N, 3) m are a tensor on the device.

        Returns:
            (c, P) m, the gaps, and (c, P) int32, the faces, tensors on the device.
        """
        gaps = positions.new_empty((len(positions), self.point_count))
        faces = gaps.new_empty(gaps.shape, dtype=array_module(gaps).int32)
        if len(positions) > 0:
            self.enqueue_gaps(as_warp(positions.contiguous(), Vec3), as_warp(gaps, real), as_warp(faces, wp.int32))
        return gaps, faces

    def contact_sets(
        self, points: torch.Tensor, counts: torch.Tensor, positions: torch.Tensor, start: Sequence[torch.Tensor]
    ) -> ContactSet:
        """Return the contacts of c worlds as tensors on the device. Blocks until ``counts`` is known on the host.

        Args:
            points: (c, L) int32, contact points; each world uses the first ``counts`` entries.
            counts: (c,) int32, number of contacts of each world.
            positions: (c, N, 3) m, at the start of the step.
            start: gaps (c, P) m and faces (c, P) int32 of all points at ``positions``.
        """
        capacity = int(counts.max()) if len(counts) else 0
        points = points[:, :capacity].contiguous()
        nodes, faces = (points.new_empty((*points.shape, *size)) for size in ((4,), ()))
        weights, axes, gaps = (positions.new_empty((*points.shape, *size)) for size in ((4,), (3, 3), ()))
        if 0 not in points.shape:
            inputs = (points, wp.int32), (counts, wp.int32), (positions, Vec3), (start[0], real), (start[1], wp.int32)
            outputs = (nodes, wp.vec4i), (weights, Vec4), (axes, Mat33), (gaps, real), (faces, wp.int32)
            self.enqueue_record(*([as_warp(contiguous(v), kind) for v, kind in each] for each in (inputs, outputs)))
        return ContactSet(points, nodes, weights, axes, gaps, faces, positions.shape[1], counts)

    def contact_set(self, points: np.ndarray, positions: np.ndarray) -> ContactSet:
        """Return the contact set of ``points`` (n,) for nodal ``positions`` (N, 3) m at the start of the step."""
        self.gaps(positions)
        found, count = self._last_gaps, len(points)
        assert found is not None
        if self._record is None or self._record.capacity < count:
            self._record = _RecordBuffers(grow_capacity(count), self.device)
        record = self._record
        record.write(points)
        if self.geometry.field is not None:
            copy_into(self._positions, positions[None])
        self.enqueue_record([record.points, record.counts, self._positions, found.gaps, found.faces], record.arrays)
        return ContactSet(points, *record.read(count), node_count=len(positions))


class _PointGaps:
    """Gaps of all points of one world in one configuration, on the device and, read-only, on the host."""

    def __init__(self, count: int, device: wp.Device, *, has_one_face: bool) -> None:
        self.gaps, self.faces = zeros((1, count), real, device), zeros((1, count), int, device)
        self._mirrors = [PinnedMirror(self.gaps), PinnedMirror(self.faces)][: 1 if has_one_face else 2]
        faces = np.zeros(count, np.int32)
        faces.flags.writeable = False
        self.on_host: tuple[np.ndarray, np.ndarray] = np.zeros(count), faces

    def download(self) -> None:
        """Copy the gaps and faces to new arrays on the host. If there is only one face, all face indices are 0."""
        values = [values[0] for values in PinnedMirror.get_all(*self._mirrors)]
        for each in values:
            each.flags.writeable = False
        self.on_host = values[0], values[-1] if len(values) == 2 else self.on_host[1]


class _RecordBuffers:
    """Buffers for the record of up to ``capacity`` contacts of one world."""

    def __init__(self, capacity: int, device: wp.Device) -> None:
        self.capacity = capacity
        kinds = int, wp.vec4i, Vec4, Mat33, real, int
        self.points, *self.arrays = [zeros((1, capacity), kind, device) for kind in kinds]
        self.counts = zeros(1, int, device)
        self._host_points, self._host_counts, *self._host_arrays = (
            PinnedMirror(each) for each in (self.points, self.counts, *self.arrays)
        )
        self._padded = np.zeros((1, capacity), np.int32)

    def write(self, points: np.ndarray) -> None:
        """Upload ``points`` (n,)."""
        self._padded[0, : len(points)] = points
        self._host_points.put(self._padded)
        self._host_counts.put(np.array([len(points)]))

    def read(self, count: int) -> list[np.ndarray]:
        """Return copies of nodes, weights, axes, gaps and faces of the first ``count`` contacts."""
        return [values[0, :count] for values in PinnedMirror.get_all(*self._host_arrays)]


def tangent_directions(count: int) -> np.ndarray:
    """Return (count, 2) unit directions D of the friction pyramid, evenly spaced in the tangent plane."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)
