"""The paper's deformation of Gaussians by a cage, and the baselines it is compared with (Table 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from egs_warp.deformation.deformer import CageMaps, DeformedGaussians, Deformer, node_positions
from egs_warp.deformation.embedding import CageLocator, PointEmbedding, embed_gaussians
from egs_warp.deformation.splitting import SPLIT_DEGREES, SplitRule, split_for_motion
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.kernels.deformation import baselines as kernels
from egs_warp.kernels.deformation.spherical_harmonics import rotate_sh_kernel
from egs_warp.launching import empty, launch_rows
from egs_warp.precision import Vec3

LOCAL_REACH = 3.0 / np.sqrt(3.0)
"""Coordinate along each axis, in standard deviations, of the corners of a Gaussian's own tetrahedron: the corners are 3
standard deviations from the mean, and the tetrahedron contains the one-sigma ellipsoid."""


class DeformationMethod(Enum):
    """Source of the deformation gradient F of a Gaussian."""

    SURFACE = "surface"
    """Nearest surface triangle (SuGaR, Guedon and Lepetit 2024)."""
    MEAN_GRADIENT = "mean gradient"
    """Tetrahedron that contains the mean (PhysGaussian, Xie et al. 2024)."""
    LOCAL_TETRAHEDRON = "local tetrahedron"
    """Tetrahedron around each Gaussian, embedded in the cage (VR-GS, Jiang et al. 2024)."""
    BIDIRECTIONAL_NO_SPLIT = "bidirectional, no split"
    """Mean of the gradients of T+ and T- (Eq. 14, 15)."""
    BIDIRECTIONAL = "bidirectional"
    """Mean of the gradients of T+ and T-, with splitting of bent Gaussians (Eq. 14-17)."""


@dataclass(frozen=True)
class BoundSurface:
    """Triangles at rest to which ``DeformationMethod.SURFACE`` binds Gaussians; the cage deforms their vertices."""

    vertices: np.ndarray
    """(V, 3) float64, vertices at rest, m."""
    faces: np.ndarray
    """(F, 3) int32, each triangle with positive area."""

    def __post_init__(self) -> None:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        flat = np.flatnonzero(~(np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0))
        if len(self.faces) == 0 or len(flat):
            bad = f"triangle {flat[0]} has no area" if len(flat) else "it has no triangles"
            raise UserError(f"surface: {bad}; give triangles with an area above zero")


def deform_with_method(
    cloud: GaussianCloud,
    mesh: TetMesh | CageLocator,
    frames: Sequence[wp.array | np.ndarray],
    *,
    method: DeformationMethod = DeformationMethod.BIDIRECTIONAL,
    surface: BoundSurface | None = None,
    rule: SplitRule = SplitRule.MEASURED,
    threshold_degrees: float = SPLIT_DEGREES,
    min_error: float | None = None,
    max_depth: int = 3,
    max_growth: float = 4.0,
) -> list[GaussianCloud]:
    """Deform ``cloud`` with its cage to each of ``frames`` by one of the methods of Table 1.

    Args:
        cloud: Gaussians at rest.
        mesh: cage, or its locator.
        frames: node positions (N, 3) or (N,) vec3d, m, of the cage.
        method: source of the deformation gradient F.
        surface: triangles for ``SURFACE``; default: the cage's own surface.
        rule, threshold_degrees, min_error, max_depth, max_growth: arguments of ``split_for_motion``, for
            ``BIDIRECTIONAL``.
    """
    cage = mesh if isinstance(mesh, CageLocator) else CageLocator(mesh, device=cloud.device)
    if method in (DeformationMethod.BIDIRECTIONAL, DeformationMethod.BIDIRECTIONAL_NO_SPLIT):
        embedding = embed_gaussians(cloud, cage)
        if method is DeformationMethod.BIDIRECTIONAL:
            split = split_for_motion(
                cloud,
                embedding,
                frames,
                rule=rule,
                threshold_degrees=threshold_degrees,
                min_error=min_error,
                max_depth=max_depth,
                max_growth=max_growth,
            )
            cloud, embedding = split.cloud, split.embedding
        # Use one Deformer for each frame, because a Deformer overwrites its earlier results.
        return [Deformer(cloud, embedding).deform(positions).cloud for positions in frames]
    baseline = _BaselineDeformer(cloud, cage, method, surface)
    return [baseline.deform(positions).cloud for positions in frames]


class _BaselineDeformer:
    """Deformer of one baseline method, whose embedding is computed once and used for every frame."""

    def __init__(
        self, cloud: GaussianCloud, cage: CageLocator, method: DeformationMethod, surface: BoundSurface | None
    ) -> None:
        self._cloud, self._cage, self._method = cloud, cage, method
        with wp.ScopedDevice(cloud.device):
            if method is DeformationMethod.SURFACE:
                vertices = cage.mesh.nodes if surface is None else surface.vertices
                faces = cage.mesh.boundary_faces() if surface is None else surface.faces
                self._faces = wp.array(faces, dtype=wp.vec3i)
                self._rest = wp.array(vertices, dtype=Vec3)
                self._vertices = None if surface is None else cage.locate(self._rest)
                searched_surface = None if surface is None else cage.local_surface(vertices, faces)
                self._face_from_gaussian = cage.nearest_faces(cloud.means, searched_surface)
            elif method is DeformationMethod.LOCAL_TETRAHEDRON:
                corners = empty(4 * cloud.count, Vec3, cloud.device)
                self._launch(
                    kernels.local_tetrahedron_kernel,
                    [cloud.means, cloud.rotations, cloud.log_scales, LOCAL_REACH, self._min_length],
                    [corners],
                )
                self._corners: PointEmbedding = cage.locate(corners)
            else:
                self._cage_maps = CageMaps(cage)
                means = wp.array(cloud.means.numpy().astype(np.float64), dtype=Vec3)
                self._means: PointEmbedding = cage.locate(means)

    @property
    def _min_length(self) -> float:
        return 1e-6 * self._cage.extent

    def _launch(self, kernel: Any, inputs: Sequence[object], outputs: Sequence[object]) -> None:
        launch_rows(kernel, self._cloud.count, inputs=inputs, outputs=outputs, device=self._cloud.device)

    def deform(self, positions: wp.array | np.ndarray) -> DeformedGaussians:
        """Return the cloud for node ``positions``, in newly allocated arrays."""
        rest = self._cloud
        uploaded = node_positions(positions, len(self._cage.mesh.nodes), rest.device)
        cloud = GaussianCloud(
            means=wp.empty_like(rest.means),
            rotations=wp.empty_like(rest.rotations),
            log_scales=wp.empty_like(rest.log_scales),
            opacity_logits=rest.opacity_logits,
            sh=wp.clone(rest.sh),
            antialiased=rest.antialiased,
        )
        polar_rotations = empty(rest.count, wp.vec4, rest.device)
        outputs = [cloud.means, cloud.rotations, cloud.log_scales, polar_rotations]
        shape = [rest.rotations, rest.log_scales]
        if self._method is DeformationMethod.SURFACE:
            corners = uploaded if self._vertices is None else self._vertices.interpolate(uploaded)
            bound = [self._rest, corners, self._faces, self._face_from_gaussian]
            self._launch(kernels.deform_with_surface_kernel, [rest.means, *shape, *bound], outputs)
        elif self._method is DeformationMethod.LOCAL_TETRAHEDRON:
            corners = self._corners.interpolate(uploaded)
            inputs = [*shape, corners, LOCAL_REACH, self._min_length]
            self._launch(kernels.deform_with_tetrahedron_kernel, inputs, outputs)
        else:
            means = self._means
            inputs = [*shape, uploaded, means.nodes, means.weights, means.tets, self._cage_maps.update(uploaded)]
            self._launch(kernels.deform_with_gradient_kernel, inputs, outputs)
        if rest.sh_degree:
            self._launch(rotate_sh_kernel, [polar_rotations, rest.sh, rest.sh_degree], [cloud.sh])
        return DeformedGaussians(cloud, polar_rotations)
