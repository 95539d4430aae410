"""The solid a capture shows: a lattice of points over its plane, each inside or outside the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import ndimage

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.meshing.occupancy import OPACITY_UNIT, enclosed_kernel, splat_occupancy_kernel

_OPACITY_THRESHOLD = 0.25
"""Summed opacity from which a lattice point counts as occupied."""
_MIN_COMPONENT_TO_BRIDGE = 0.02
"""A detached part with more than this share of the opacity mass belongs to the object: its gap is bridged."""
_MAX_BRIDGE = 4
"""Widest gap bridged, in lattice spacings on either side."""


@dataclass(frozen=True)
class LatticeSolid:
    """The object as a set of lattice points; layer 0 of the last axis lies in the plane."""

    inside: np.ndarray
    """(nx, ny, nz) bool, one connected piece."""
    frame: np.ndarray
    """(3, 3) float64: rows are the lattice axes in the world; the last is the plane's normal."""
    origin: np.ndarray
    """(3,) float64: lattice point (0, 0, 0) in lattice axes, scene units."""
    spacing: float
    """Scene units."""
    belongs: np.ndarray
    """(n,) bool: Gaussians of the object; the others are floaters or lie below the plane."""
    below_plane: np.ndarray
    """(n,) bool: Gaussians whose mean is below the plane by more than the lattice's blur can tell from it."""
    bridged: int
    """Lattice spacings by which gaps were bridged on either side; 0 if the object is in one piece by itself."""

    @property
    def longest_side(self) -> float:
        """Of the solid's box, scene units."""
        return self.spacing * float(np.ptp(np.argwhere(self.inside), axis=0).max())

    def world(self, lattice_points: np.ndarray) -> np.ndarray:
        """World positions (m, 3) of points (m, 3) in lattice indices."""
        return (self.origin + self.spacing * np.asarray(lattice_points, float)) @ self.frame

    def lattice(self, world_points: np.ndarray) -> np.ndarray:
        """Lattice indices (m, 3), float, of world points (m, 3)."""
        return (np.asarray(world_points, float) @ self.frame.T - self.origin) / self.spacing


def solid_from_gaussians(cloud: GaussianCloud, plane: Plane, *, resolution: int = 64) -> LatticeSolid:
    """Occupied and enclosed space above ``plane``: the connected piece that holds most of the opacity mass.

    ``resolution`` lattice spacings span the object's longest side. Raises ``UserError`` if nothing opaque stands on
    the plane.
    """
    frame = np.stack([*plane.tangents(), plane.normal])
    means = cloud.means.numpy().astype(np.float64) @ frame.T
    means[:, 2] += plane.offset
    opacities = cloud.opacities()
    low, high = _robust_bounds(means, opacities)
    # A coarse look first: strays may have stretched the bounds.
    coarse = _one_look(cloud, plane, frame, means, opacities, low, high, min(resolution, 40))
    indices = np.argwhere(coarse.inside)
    corner = coarse.origin + [0.0, 0.0, plane.offset]
    low, high = corner + coarse.spacing * indices.min(axis=0), corner + coarse.spacing * indices.max(axis=0)
    return _one_look(cloud, plane, frame, means, opacities, low, high, resolution)


def _robust_bounds(means: np.ndarray, opacities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Box (3,), (3,) around all but far strays: the central 98 % of the mass, grown by 60 % of its size."""
    share = np.cumsum(opacities) / max(float(np.sum(opacities)), 1e-30)
    low, high = np.empty(3), np.empty(3)
    for axis in range(3):
        order = np.argsort(means[:, axis], kind="stable")
        share = np.cumsum(opacities[order])
        low[axis], high[axis] = means[order, axis][
            np.searchsorted(share, [0.01 * share[-1], 0.99 * share[-1]]).clip(0, len(order) - 1)
        ]
    grow = 0.6 * (high - low)
    return np.maximum(low - grow, means.min(axis=0)), np.minimum(high + grow, means.max(axis=0))


def _one_look(
    cloud: GaussianCloud,
    plane: Plane,
    frame: np.ndarray,
    means: np.ndarray,
    opacities: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    resolution: int,
) -> LatticeSolid:
    extent = float(np.max(high - low))
    if not extent > 0.0:
        raise UserError(
            f"object: all of its {cloud.count} Gaussians are at one point, so it has no volume; choose another object"
        )
    spacing = extent / resolution
    margin = _MAX_BRIDGE + 3
    counts = np.ceil((np.maximum(high, 0.0) - np.append(low[:2], 0.0)) / spacing).astype(int) + 1 + margin
    counts[:2] += margin
    low = np.append(low[:2] - margin * spacing, 0.0)
    opacity_sum = wp.zeros(tuple(counts), dtype=wp.int32, device=cloud.device)
    origin = low - [0.0, 0.0, plane.offset]
    wp.launch(
        splat_occupancy_kernel,
        dim=cloud.count,
        inputs=[
            cloud.means,
            cloud.rotations,
            cloud.log_scales,
            cloud.opacity_logits,
            wp.mat33(*frame.ravel()),
            wp.vec3(*origin),
            spacing,
            0.08 * extent,
        ],
        outputs=[opacity_sum],
        device=cloud.device,
    )
    occupied = opacity_sum.numpy() >= int(_OPACITY_THRESHOLD * int(OPACITY_UNIT))
    if not occupied.any():
        raise UserError(
            f"object: nothing opaque stands on the plane (of {cloud.count} Gaussians, {int(np.sum(means[:, 2] > 0))} "
            f"are above it, most opaque {opacities.max():.2g})",
            check=("plane", "up"),
        )
    position = (means - low) / spacing
    node = np.rint(position).astype(int)
    in_lattice = np.all((node >= 0) & (node < counts), axis=1)
    masses = np.where(in_lattice, opacities, 0.0)
    at = tuple(node.clip(0, counts - 1).T)
    whole, labels, main, bridged = occupied, np.zeros(occupied.shape, np.int32), 0, 0
    for bridged in range(_MAX_BRIDGE + 1):
        whole = _bridge(occupied, bridged)
        labels = np.zeros_like(labels)
        ndimage.label(whole, structure=np.ones((3, 3, 3), bool), output=labels)
        piece_mass = np.bincount(labels[at], weights=masses)
        piece_mass[0] = 0.0
        main = int(np.argmax(piece_mass))
        rest = np.delete(piece_mass, [0, main]) if main else piece_mass[1:]
        if main and (rest.size == 0 or rest.max() <= _MIN_COMPONENT_TO_BRIDGE * piece_mass.sum()):
            break
    piece = np.asarray(labels == main if main else whole)
    inside = _fill(piece, cloud.device)
    belongs = in_lattice & ndimage.binary_dilation(piece)[at] & (means[:, 2] >= 0.0)
    return LatticeSolid(inside, frame, origin, spacing, belongs, means[:, 2] < 0.0, bridged)


def _bridge(occupied: np.ndarray, radius: int) -> np.ndarray:
    """Morphological closing by ``radius`` spacings."""
    if radius == 0:
        return occupied
    grown = np.asarray(ndimage.distance_transform_edt(~occupied)) <= radius
    return occupied | (np.asarray(ndimage.distance_transform_edt(grown)) > radius)


def _fill(piece: np.ndarray, device: wp.Device) -> np.ndarray:
    """The piece with its enclosed space; twice, since what the first pass filled shields the rest."""
    solid = piece
    for _ in range(2):
        filled = wp.zeros(solid.shape, dtype=wp.uint8, device=device)
        wp.launch(
            enclosed_kernel,
            dim=solid.shape,
            inputs=[wp.array(solid.astype(np.uint8), dtype=wp.uint8, device=device), 25],
            outputs=[filled],
            device=device,
        )
        solid = filled.numpy().astype(bool)
    return solid
