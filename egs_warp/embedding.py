"""Embed points, and Gaussians with their axis end points, in a rest cage (Eq. 2, 3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from egs_warp.errors import UserError
from egs_warp.kernels import embedding as kernels
from egs_warp.launching import launch_rows
from egs_warp.precision import Mat33, Vec3, Vec4
from egs_warp.tetmesh import TetMesh


@dataclass(frozen=True)
class PointEmbedding:
    """Points as fixed combinations of the corners of one tetrahedron each (Eq. 2)."""

    tets: wp.array
    """(P,) int32, the containing tetrahedron, or the nearest one of a point outside all."""
    nodes: wp.array
    """(P,) vec4i, its corners, node indices."""
    weights: wp.array
    """(P,) vec4d, barycentric weights of sum 1; negative ones extrapolate."""
    inside: wp.array
    """(P,) bool, whether a tetrahedron contains the point."""

    @property
    def count(self) -> int:
        """Number of points P."""
        return self.tets.shape[0]

    def interpolate(self, positions: wp.array) -> wp.array:
        """(P,) vec3d: the points for node positions (N,) vec3d (Eq. 2)."""
        points = wp.empty(self.count, dtype=Vec3, device=self.tets.device)
        launch_rows(
            kernels.interpolate_points_kernel,
            self.count,
            inputs=[self.nodes, self.weights, positions],
            outputs=[points],
            device=self.tets.device,
        )
        return points


class CageLocator:
    """Finds tetrahedra of one rest mesh by position: a bounding-volume hierarchy over them and one over the surface."""

    def __init__(self, mesh: TetMesh, *, device: str | wp.Device | None = None) -> None:
        self.mesh = mesh
        self.device = wp.get_device(device)
        lower, upper = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        # The hierarchies are float32: measure from the middle so that a far-off origin costs no digits.
        self._origin = 0.5 * (lower + upper)
        self._extent = float(np.linalg.norm(upper - lower))
        local = mesh.nodes - self._origin
        corners = local[mesh.tets]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        margin = 1e-6 * self._extent
        with wp.ScopedDevice(self.device):
            self._nodes = wp.array(local, dtype=Vec3)
            self._tets = wp.array(mesh.tets, dtype=wp.vec4i)
            self._inverse_edges = wp.array(np.linalg.inv(edges), dtype=Mat33)
            self._box_lowers = wp.array((corners.min(axis=1) - margin).astype(np.float32), dtype=wp.vec3)
            self._box_uppers = wp.array((corners.max(axis=1) + margin).astype(np.float32), dtype=wp.vec3)
            self._boxes = wp.Bvh(self._box_lowers, self._box_uppers)
            self._surface = wp.Mesh(
                points=wp.array(local.astype(np.float32), dtype=wp.vec3),
                indices=wp.array(mesh.boundary_faces().ravel(), dtype=wp.int32),
            )

    @cached_property
    def node_positions(self) -> wp.array:
        """(N,) vec3d, the rest positions on the device."""
        return wp.array(self.mesh.nodes, dtype=Vec3, device=self.device)

    def locate(self, points: wp.array) -> PointEmbedding:
        """Embed finite ``points`` (P,) vec3d of this device; see ``embed_points``."""
        count = points.shape[0]
        with wp.ScopedDevice(self.device):
            embedding = PointEmbedding(
                tets=wp.empty(count, dtype=wp.int32),
                nodes=wp.empty(count, dtype=wp.vec4i),
                weights=wp.empty(count, dtype=Vec4),
                inside=wp.empty(count, dtype=wp.bool),
            )
        launch_rows(
            kernels.locate_points_kernel,
            count,
            inputs=[
                points,
                Vec3(*self._origin),
                self._extent,
                self._tets,
                self._nodes,
                self._inverse_edges,
                self._box_lowers,
                self._box_uppers,
                self._boxes.id,
                self._surface.id,
            ],
            outputs=[embedding.tets, embedding.nodes, embedding.weights, embedding.inside],
            device=self.device,
        )
        return embedding


def embed_points(mesh: TetMesh, points: np.ndarray, *, device: str | wp.Device | None = None) -> PointEmbedding:
    """Barycentric weights of ``points`` (P, 3), metres, in the tetrahedra of the rest ``mesh`` (Eq. 2).

    A point on a shared face belongs to the tetrahedron of lowest index. A point outside every tetrahedron is extrapolated
    from the nearest one by true distance; where several are equally near, from the one whose least weight is largest.

    Raises ``UserError`` for a point that is not finite.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise UserError(f"embedding: {len(bad)} of {len(points)} points are not finite (first: number {bad[0]})")
    locator = CageLocator(mesh, device=device)
    return locator.locate(wp.array(points, dtype=Vec3, device=locator.device))
