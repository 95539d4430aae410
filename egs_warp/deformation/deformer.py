"""Deform Gaussians with their cage (Eq. 14, 15) and measure how much the motion bends each (Eq. 16)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from egs_warp.deformation.embedding import CageLocator, GaussianEmbedding
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.bundle_file import Carrier
from egs_warp.kernels.deformation import cage_maps
from egs_warp.kernels.deformation import deformer as kernels
from egs_warp.kernels.deformation import deformer_cuda as kernels_cuda
from egs_warp.kernels.deformation.spherical_harmonics import rotate_sh_kernel
from egs_warp.launching import empty, launch_rows, zeros
from egs_warp.precision import Vec3
from egs_warp.short_repr import short_repr

MAX_STRETCH = 1.5
"""Maximum stretch of an arm relative to the stretch of the material at its two ends; an arm that is stretched more
would appear as a spike."""

MIN_BRIDGE = 1e-3
"""Minimum length of an arm that is deformed by a difference of positions, relative to the cage's diagonal. For shorter
arms, the rounding errors of float32 are too large."""


@dataclass(frozen=True)
class DeformedGaussians:
    """Gaussians deformed by the cage."""

    __repr__ = short_repr

    cloud: GaussianCloud
    """(n,) deformed Gaussians. ``opacity_logits`` is the rest cloud's own array."""
    rotations: wp.array
    """(n,) vec4, unit quaternions w, x, y, z: the rotation R_polar of F, which rotates each Gaussian and its colour."""


@dataclass(frozen=True)
class BendMeasure:
    """Deviation of a motion from an affine map across each Gaussian: the maximum of each measure over all frames."""

    bend_degrees: np.ndarray
    """(n,) deg, theta of Eq. (16)."""
    curl_degrees: np.ndarray
    """(n, 3) deg, angle by which the two ends of each axis are rotated relative to each other: bending or twisting
    along the axis."""
    fit_error: np.ndarray
    """(n, 3) m, displacement, at one standard deviation from the mean along each axis, that the affine map F does not
    represent."""


class CageMaps:
    """Affine map of every tetrahedron of a cage; each update overwrites the same arrays."""

    def __init__(self, cage: CageLocator) -> None:
        self._cage = cage
        tet_count = len(cage.mesh.tets)
        with wp.ScopedDevice(cage.device):
            self._rest = wp.array(cage.mesh.nodes, dtype=Vec3)
            self._maps = cage_maps.CageMaps()
            self._maps.maps = empty(3 * tet_count, wp.vec4, cage.device)
            self._maps.frames = empty(2 * tet_count, wp.vec4, cage.device)

    def update(self, positions: wp.array | np.ndarray) -> Any:
        """Return the kernels' ``CageMaps`` for node ``positions``, in the format of ``Deformer.deform``."""
        cage, device = self._cage, self._cage.device
        launch_rows(
            cage_maps.update_maps_kernel,
            len(cage.mesh.tets),
            inputs=[
                node_positions(positions, len(cage.mesh.nodes), device),
                self._rest,
                cage.tets,
                cage.inverse_edges,
            ],
            outputs=[self._maps],
            device=device,
        )
        return self._maps


class Deformer:
    """Deformer of one cloud, which writes each frame into the same output arrays."""

    def __init__(self, cloud: GaussianCloud, embedding: GaussianEmbedding, *, max_stretch: float = MAX_STRETCH) -> None:
        # Store rows contiguously, because kernels read a whole row in one load.
        self.rest = cloud = replace(cloud, rotations=cloud.rotations.contiguous(), sh=cloud.sh.contiguous())
        self.embedding = embedding
        self.max_stretch = max_stretch
        self._degree = cloud.sh_degree
        self._cage_maps = CageMaps(embedding.cage)
        with wp.ScopedDevice(cloud.device):
            self.plan = cage_maps.ArmPlan()
            """Plan of the arms of each Gaussian, which does not depend on the frame."""
            self.plan.mean_tets = empty(cloud.count, wp.int32, cloud.device)
            self.plan.end_tets = empty((6, cloud.count), wp.int32, cloud.device)
            self.plan.inside_fractions = empty((6, cloud.count), wp.float32, cloud.device)
            self.plan.smoothing_lengths = empty((3, cloud.count), wp.float32, cloud.device)
            self._deformed = DeformedGaussians(
                GaussianCloud(
                    means=wp.empty_like(cloud.means),
                    rotations=wp.empty_like(cloud.rotations),
                    log_scales=wp.empty_like(cloud.log_scales),
                    opacity_logits=cloud.opacity_logits,
                    # Band 0 never changes, so without higher bands the rest cloud's own colours are used.
                    sh=wp.clone(cloud.sh) if self._degree else cloud.sh,
                    antialiased=cloud.antialiased,
                ),
                rotations=empty(cloud.count, wp.vec4, cloud.device),
            )
        points, cage = embedding.points, embedding.cage
        launch_rows(
            cage_maps.plan_arms_kernel,
            cloud.count,
            inputs=[
                cloud.rotations,
                cloud.log_scales,
                points.tets,
                points.weights,
                embedding.arms,
                cage.tets,
                cage.inverse_edges,
                MIN_BRIDGE * cage.extent,
            ],
            outputs=[self.plan],
            device=cloud.device,
        )

    def __repr__(self) -> str:
        return f"Deformer({self.rest.count:,} Gaussians)"

    def deform(self, positions: wp.array | np.ndarray) -> DeformedGaussians:
        """Deform the cloud to node positions (N, 3) or (N,) vec3d, m (Eq. 14, 15); the next call overwrites the
        result."""
        deformed, cloud, rest = self._deformed, self._deformed.cloud, self.rest
        inputs = self._kernel_inputs(positions)
        outputs = [cloud.means, cloud.rotations, cloud.log_scales, deformed.rotations]
        if rest.device.is_cuda and self._degree == 3:
            kernels_cuda.deform_with_colour(rest.count, [*inputs, rest.sh], [*outputs, cloud.sh], rest.device)
            return deformed
        launch_rows(kernels.deform_kernel, rest.count, inputs=inputs, outputs=outputs, device=rest.device)
        if self._degree:
            launch_rows(
                rotate_sh_kernel,
                rest.count,
                inputs=[deformed.rotations, rest.sh, self._degree],
                outputs=[cloud.sh],
                device=rest.device,
            )
        return deformed

    def measure_bend(self, frames: Iterable[wp.array | np.ndarray]) -> BendMeasure:
        """Return the maximum bend of each Gaussian over ``frames`` (Eq. 16). Each frame is a valid argument of
        ``deform``."""
        count = self.rest.count
        bend = zeros(count, wp.float32, self.rest.device)
        curl, error = (zeros(count, wp.vec3, self.rest.device) for _ in range(2))
        for positions in frames:
            launch_rows(
                kernels.measure_bend_kernel,
                count,
                inputs=[*self._kernel_inputs(positions), self.embedding.arms],
                outputs=[bend, curl, error],
                device=self.rest.device,
            )
        return BendMeasure(bend.numpy(), curl.numpy(), error.numpy())

    def plan_arrays(self) -> dict[str, np.ndarray]:
        """Return the plan as the arrays of a bundle, for readers without this package (docs/concepts/bundle.md)."""
        codes, shares = self.plan.mean_tets.numpy(), self.plan.inside_fractions.numpy()
        rigid = (codes < 0) & (shares[0] == float(cage_maps.RIGID))
        carriers = np.where(rigid, Carrier.RIGID, np.where(codes < 0, Carrier.ARMS, Carrier.TET)).astype(np.uint8)
        rows = np.flatnonzero(carriers == Carrier.ARMS)
        deviations = np.exp(self.rest.log_scales.numpy()[rows].astype(np.float64))
        arms = shares[:, rows].T
        return {
            "tets": np.where(codes < 0, -1 - codes, codes),
            "carriers": carriers,
            "arm_tets": self.plan.end_tets.numpy()[:, rows].T,
            "arm_shares": np.clip(arms, 0.0, 1.0),
            "arm_lengths": (np.maximum(-arms, 0.0) / np.tile(deviations, 2)).astype(np.float32),
            "arm_bulges": (self.plan.smoothing_lengths.numpy()[:, rows].T / deviations).astype(np.float32),
        }

    def _kernel_inputs(self, positions: wp.array | np.ndarray) -> list[object]:
        rest = self.rest
        return [
            rest.means,
            rest.rotations,
            rest.log_scales,
            self.max_stretch,
            self._cage_maps.update(positions),
            self.plan,
        ]


def deform(
    cloud: GaussianCloud,
    embedding: GaussianEmbedding,
    positions: wp.array | np.ndarray,
    *,
    max_stretch: float = MAX_STRETCH,
) -> DeformedGaussians:
    """Deform ``cloud`` with its cage to node ``positions``, (N, 3) or (N,) vec3d, m (Eq. 14, 15).

    For many frames use a ``Deformer``, which reuses its output arrays.

    Raises:
        UserError: the node count differs from the cage's.
    """
    return Deformer(cloud, embedding, max_stretch=max_stretch).deform(positions)


def node_positions(positions: wp.array | np.ndarray, node_count: int, device: wp.Device) -> wp.array:
    """Convert node positions (N, 3) or (N,) vec3d to (N,) vec3d on ``device``.

    Raises:
        UserError: N is not ``node_count``.
    """
    if len(positions) != node_count:
        raise UserError(
            f"deformation: {len(positions)} node positions for a cage of {node_count} nodes; give one for each node"
        )
    if isinstance(positions, wp.array) and positions.dtype == Vec3 and positions.device == device:
        return positions
    values = positions.numpy() if isinstance(positions, wp.array) else np.asarray(positions, dtype=np.float64)
    return wp.array(values, dtype=Vec3, device=device)
