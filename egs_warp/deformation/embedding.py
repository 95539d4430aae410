"""Embedding of points, and of Gaussians with their axis end points, in a rest cage (Eq. 2, 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from egs_warp.checked_calls import Positive
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.kernels.deformation import embedding as kernels
from egs_warp.launching import device_of, empty, launch_rows
from egs_warp.precision import Mat33, Vec3, Vec4
from egs_warp.short_repr import short_repr

UNSCENTED_GAMMA = 3.0**0.5
"""Arm length in standard deviations for which the seven points integrate cubics over the Gaussian exactly."""

MIN_ARM_LENGTH = 1e-6
"""Minimum length of an arm, relative to the cage's diagonal. For an arm of a Gaussian with a scale of e^-16,
differences of positions would be mostly rounding errors even in float64."""


@dataclass(frozen=True)
class PointEmbedding:
    """Points as fixed combinations of the corners of one tetrahedron each (Eq. 2)."""

    __repr__ = short_repr

    tets: wp.array
    """(P,) int32, index of the tetrahedron that contains the point, or of the nearest one if no tetrahedron contains
    it."""
    nodes: wp.array
    """(P,) vec4i, node indices of the corners of this tetrahedron."""
    weights: wp.array
    """(P,) vec4d, barycentric weights with sum 1; negative weights extrapolate."""
    inside: wp.array
    """(P,) bool, True if a tetrahedron contains the point."""

    @property
    def count(self) -> int:
        """Number of points P."""
        return self.tets.shape[0]

    def interpolate(self, positions: wp.array) -> wp.array:
        """Return the points (P,) vec3d for node positions (N,) vec3d (Eq. 2)."""
        device = device_of(self.tets)
        points = empty(self.count, Vec3, device)
        launch_rows(
            kernels.interpolate_points_kernel,
            self.count,
            inputs=[self.nodes, self.weights, positions],
            outputs=[points],
            device=device,
        )
        return points


class CageLocator:
    """Locator of points in the tetrahedra of a rest mesh, with bounding volume hierarchies of the tetrahedra and of the
    surface."""

    def __init__(self, mesh: TetMesh, *, device: str | wp.Device | None = None) -> None:
        self.mesh = mesh
        self.device = wp.get_device(device)
        lower, upper = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        # The hierarchies are float32: coordinates relative to the centre keep precision far from the origin.
        self._origin = 0.5 * (lower + upper)
        self.extent = float(np.linalg.norm(upper - lower))
        """Diagonal of the bounding box, m."""
        local = mesh.nodes - self._origin
        corners = local[mesh.tets]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        margin = 1e-6 * self.extent
        with wp.ScopedDevice(self.device):
            self._nodes = wp.array(local, dtype=Vec3)
            self.tets = wp.array(mesh.tets, dtype=wp.vec4i)
            """(T,) vec4i, node indices of each tetrahedron."""
            self.inverse_edges = wp.array(np.linalg.inv(edges), dtype=Mat33)
            """(T,) mat33d, D_m^-1 of each rest tetrahedron, 1/m."""
            self._box_lowers = wp.array((corners.min(axis=1) - margin).astype(np.float32), dtype=wp.vec3)
            self._box_uppers = wp.array((corners.max(axis=1) + margin).astype(np.float32), dtype=wp.vec3)
            self._boxes = wp.Bvh(self._box_lowers, self._box_uppers)
        self._surface = self.local_surface(mesh.nodes, mesh.boundary_faces())

    def locate(self, points: wp.array) -> PointEmbedding:
        """Embed finite ``points`` (P,) vec3d on this device, like ``embed_points``."""
        embedding = self._empty_embedding(points.shape[0])
        launch_rows(
            kernels.locate_points_kernel,
            embedding.count,
            inputs=[points, *self._search_inputs()],
            outputs=[embedding.tets, embedding.nodes, embedding.weights, embedding.inside],
            device=self.device,
        )
        return embedding

    def locate_gaussians(self, cloud: GaussianCloud, gamma: float) -> tuple[PointEmbedding, wp.array]:
        """Embed the seven points of each Gaussian, like ``embed_gaussians``. Return the embedding (7n rows) and the arm
        lengths (n, 6), m."""
        embedding = self._empty_embedding(7 * cloud.count)
        arms = empty((cloud.count, 6), wp.float32, self.device)
        launch_rows(
            kernels.embed_gaussians_kernel,
            embedding.count,
            inputs=[
                cloud.means,
                cloud.rotations,
                cloud.log_scales,
                gamma,
                MIN_ARM_LENGTH * self.extent,
                *self._search_inputs(),
            ],
            outputs=[embedding.tets, embedding.nodes, embedding.weights, embedding.inside, arms],
            device=self.device,
        )
        return embedding, arms

    def nearest_faces(self, points: wp.array, surface: wp.Mesh | None = None) -> wp.array:
        """Find the triangle nearest to each of ``points`` (P,) vec3, in float32.

        Returns:
            (P,) int32, rows of ``mesh.boundary_faces()``, or of ``surface`` from ``local_surface`` if given.
        """
        faces = empty(points.shape[0], wp.int32, self.device)
        launch_rows(
            kernels.nearest_face_kernel,
            points.shape[0],
            inputs=[points, Vec3(*self._origin), self.extent, (surface or self._surface).id],
            outputs=[faces],
            device=self.device,
        )
        return faces

    def local_surface(self, vertices: np.ndarray, faces: np.ndarray) -> wp.Mesh:
        """Return triangles ``faces`` (F, 3) of ``vertices`` (V, 3), m, as a Warp mesh relative to the centre of the
        cage."""
        with wp.ScopedDevice(self.device):
            return wp.Mesh(
                points=wp.array((vertices - self._origin).astype(np.float32), dtype=wp.vec3),
                indices=wp.array(np.ascontiguousarray(faces).ravel(), dtype=wp.int32),
            )

    def _empty_embedding(self, count: int) -> PointEmbedding:
        return PointEmbedding(
            tets=empty(count, wp.int32, self.device),
            nodes=empty(count, wp.vec4i, self.device),
            weights=empty(count, Vec4, self.device),
            inside=empty(count, wp.bool, self.device),
        )

    def _search_inputs(self) -> list[object]:
        return [
            Vec3(*self._origin),
            self.extent,
            self.tets,
            self._nodes,
            self.inverse_edges,
            self._box_lowers,
            self._box_uppers,
            self._boxes.id,
            self._surface.id,
        ]


def embed_points(mesh: TetMesh, points: np.ndarray, *, device: str | wp.Device | None = None) -> PointEmbedding:
    """Embed ``points`` (P, 3), m, in the tetrahedra of the rest ``mesh`` (Eq. 2).

    A point on a shared face belongs to the tetrahedron of lowest index. A point outside every tetrahedron is
    extrapolated from the nearest one, by Euclidean distance; if several are equally near, from the one whose smallest
    weight is largest.

    Raises:
        UserError: a point is not finite.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise UserError(
            f"embedding: {len(bad)} of {len(points)} points are not finite (first: number {bad[0]}); give finite points"
        )
    locator = CageLocator(mesh, device=device)
    return locator.locate(wp.array(points, dtype=Vec3, device=locator.device))


@dataclass(frozen=True)
class GaussianEmbedding:
    """Bidirectional local embedding T+ and T- of every Gaussian (Eq. 3)."""

    __repr__ = short_repr

    points: PointEmbedding
    """7n rows. Row 7 i is the mean of Gaussian i, rows 7 i + 1 .. 3 the ends m + arm r_j of its axes, rows 7 i + 4 .. 6
    the ends m - arm r_j."""
    arms: wp.array
    """(n, 6) float32, m, arm lengths of the three ends of T+, then of T-; gamma s_j, or less where shortened."""
    cage: CageLocator
    """Locator of the rest cage in which the Gaussians are embedded."""
    gamma: float
    """Arm length in standard deviations, before shortening."""

    @property
    def count(self) -> int:
        """Number of Gaussians n."""
        return self.arms.shape[0]


def embed_gaussians(
    cloud: GaussianCloud, mesh: TetMesh | CageLocator, *, gamma: Positive = UNSCENTED_GAMMA
) -> GaussianEmbedding:
    """Embed the mean and the six axis ends m +- ``gamma`` s_j r_j of every Gaussian in the rest cage (Eq. 3).

    If a barycentric weight of an end would lie outside [-1, 2], the arm is shortened until all weights are within this
    range. Pass a ``CageLocator`` to embed several clouds in one cage. The paper uses gamma = 3. At sqrt 3 the seven
    points are the degree-three cubature of the Gaussian's mass, which represents the gradient jumps of a coarse cage
    better (measured in benchmarks/table1.py).
    """
    cage = mesh if isinstance(mesh, CageLocator) else CageLocator(mesh, device=cloud.device)
    points, arms = cage.locate_gaussians(cloud, gamma)
    return GaussianEmbedding(points, arms, cage, gamma)
