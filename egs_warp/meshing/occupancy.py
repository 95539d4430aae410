"""The solid of a capture: a lattice of points above the plane, each of them inside or outside the object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy import ndimage

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.meshing.occupancy import OPACITY_UNIT, enclosed_kernel, splat_occupancy_kernel

NEAR_SOLID = 2.0
"""Maximum distance, in lattice spacings, of the mean of a Gaussian of the object from a lattice point inside. The means
of 1.1 % of a plush dog's Gaussians, 0.3 % of a monkey's and none of a robot's are farther away from a lattice with 96
spacings."""
_OPACITY_THRESHOLD = 0.25
"""Sum of opacities above which a lattice point is occupied."""
_MIN_COMPONENT_TO_BRIDGE = 0.02
"""Fraction of the opacity mass above which a detached part belongs to the object, so that its gap is bridged."""
_MAX_BRIDGE = 4
"""Maximum number of lattice spacings by which the parts at a gap are grown, on either side, to bridge it."""


@dataclass(frozen=True)
class LatticeSolid:
    """The object as a set of lattice points in the frame of its body. Layer 0 of the last axis lies in the plane z =
    0."""

    inside: np.ndarray
    """(nx, ny, nz) bool, one connected part."""
    corner: np.ndarray
    """(3,) int, position of lattice point (0, 0, 0) relative to the frame's origin, in lattice spacings; the origin is
    a point of the lattice if that is extended infinitely."""
    spacing: float
    """Distance between lattice points, in the frame's unit of length."""
    longest_side: float
    """Longest side of the object's Gaussians, in the frame's unit of length."""
    belongs: np.ndarray
    """(n,) bool, True for Gaussians of the object; the others are floaters or below the plane."""
    below_plane: np.ndarray
    """(n,) bool, Gaussians whose mean is below the plane."""
    bridged: int
    """Number of lattice spacings by which gaps were bridged on either side; 0 if the object is one part."""

    def points(self, lattice_points: np.ndarray) -> np.ndarray:
        """Return the positions (m, 3), in the frame of the body, of the lattice points with indices ``lattice_points``
        (m, 3)."""
        return self.spacing * (np.asarray(lattice_points, float) + self.corner)

    def is_near(self, points: np.ndarray) -> np.ndarray:
        """Return the mask (n,) bool of the ``points`` (n, 3), in the frame of the body, that are at most ``NEAR_SOLID``
        lattice spacings from a lattice point inside. Gaussians whose means are elsewhere form detached fragments."""
        margin = int(np.ceil(NEAR_SOLID)) + 1
        distances = np.asarray(ndimage.distance_transform_edt(~np.pad(self.inside, margin)))
        nearest = np.rint(points / self.spacing).astype(int) - self.corner + margin
        in_lattice = ((nearest >= 0) & (nearest < distances.shape)).all(axis=1)
        at = tuple(nearest.clip(0, np.array(distances.shape) - 1).T)
        return in_lattice & (distances[at] <= NEAR_SOLID)

    def scaled(self, factor: float) -> LatticeSolid:
        """Return the same solid with all lengths multiplied by ``factor``."""
        return replace(self, spacing=self.spacing * factor, longest_side=self.longest_side * factor)


def solid_from_gaussians(cloud: GaussianCloud, *, resolution: int = 64) -> LatticeSolid:
    """Return the solid above z = 0: the occupied space and what it encloses, of the connected part with the largest
    opacity mass.

    ``cloud`` is in the frame of its body. ``resolution`` lattice spacings span the longest side of the object. The
    bounds of the object determine only the integer corner and size of the lattice, not its spacing, so a small change
    of the body does not move the lattice points. Raises ``UserError`` if nothing opaque stands on the plane.
    """
    means = cloud.means.numpy().astype(np.float64)
    opacities = cloud.opacities()
    low, high = _robust_bounds(means, opacities)
    # Start with a coarse pass, because outliers may have enlarged the bounds.
    coarse = _solid_within(cloud, means, opacities, low, high, float(np.max(high - low)), min(resolution, 40))
    indices = np.argwhere(coarse.inside)
    low, high = coarse.points(indices.min(axis=0)), coarse.points(indices.max(axis=0))
    longest = _longest_side(means[coarse.belongs], opacities[coarse.belongs])
    return _solid_within(cloud, means, opacities, low, high, longest or float(np.max(high - low)), resolution)


def _robust_bounds(means: np.ndarray, opacities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner (3,) of a box without distant outliers: the central 98 % of the mass,
    enlarged by 60 % of its size."""
    low, high = mass_quantiles(means, opacities, 0.01, 0.99)
    grow = 0.6 * (high - low)
    return np.maximum(low - grow, means.min(axis=0)), np.minimum(high + grow, means.max(axis=0))


def _longest_side(means: np.ndarray, opacities: np.ndarray) -> float:
    """Return the longest side of a box that starts at the plane and excludes the outermost thousandths of the mass."""
    if len(means) == 0:
        return 0.0
    low, high = mass_quantiles(means, opacities, 0.001, 0.999)
    return float(np.max(high - np.append(low[:2], 0.0)))


def mass_quantiles(means: np.ndarray, opacities: np.ndarray, *shares: float) -> list[np.ndarray]:
    """Return, for each of ``shares``, the point (3,) below which this share of the mass lies along each axis."""
    quantiles = np.empty((len(shares), 3))
    for axis in range(3):
        order = np.argsort(means[:, axis], kind="stable")
        mass = np.cumsum(opacities[order])
        quantiles[:, axis] = means[order, axis][
            np.searchsorted(mass, np.array(shares) * mass[-1]).clip(0, len(order) - 1)
        ]
    return list(quantiles)


def _solid_within(
    cloud: GaussianCloud,
    means: np.ndarray,
    opacities: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    longest: float,
    resolution: int,
) -> LatticeSolid:
    if not longest > 0.0:
        raise UserError(
            f"object: all of its {cloud.count} Gaussians are at one point, so it has no volume; choose another object"
        )
    spacing = longest / resolution
    margin = _MAX_BRIDGE + 3
    corner = np.append(np.floor(low[:2] / spacing) - margin, 0.0).astype(int)
    counts = np.ceil(np.maximum(high, 0.0) / spacing).astype(int) + 1 + margin - corner
    opacity_sum = wp.zeros(tuple(counts), dtype=wp.int32, device=cloud.device)
    wp.launch(
        splat_occupancy_kernel,
        dim=cloud.count,
        inputs=[
            cloud.means,
            cloud.rotations,
            cloud.log_scales,
            cloud.opacity_logits,
            wp.vec3(*(spacing * corner)),
            spacing,
            0.08 * longest,
        ],
        outputs=[opacity_sum],
        device=cloud.device,
    )
    occupied = opacity_sum.numpy() >= int(_OPACITY_THRESHOLD * int(OPACITY_UNIT))
    if not occupied.any():
        raise UserError(
            f"object: nothing opaque stands on the plane (of {cloud.count} Gaussians, {int(np.sum(means[:, 2] > 0))} "
            f"are above it; the largest opacity is {opacities.max():.2g})",
            check=("plane", "up", "object"),
        )
    node = np.rint(means / spacing).astype(int) - corner
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
    inside = fill_enclosed(piece, cloud.device)
    belongs = in_lattice & ndimage.binary_dilation(piece)[at] & (means[:, 2] >= 0.0)
    return LatticeSolid(inside, corner, spacing, longest, belongs, means[:, 2] < 0.0, bridged)


def _bridge(occupied: np.ndarray, radius: int) -> np.ndarray:
    """Return the morphological closing of ``occupied`` by ``radius`` lattice spacings."""
    if radius == 0:
        return occupied
    grown = np.asarray(ndimage.distance_transform_edt(~occupied)) <= radius
    return occupied | (np.asarray(ndimage.distance_transform_edt(grown)) > radius)


def fill_enclosed(piece: np.ndarray, device: wp.Device) -> np.ndarray:
    """Return ``piece`` (nx, ny, nz) bool with enclosed space filled. A second pass fills points that are enclosed only
    by newly filled points."""
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
