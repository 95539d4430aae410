"""Search for the plane under an object, if only a click or a box is given and the plane is not marked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import connected_parts
from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.plane_fit import PlaneFit, PlaneView, fit_plane
from egs_warp.segmentation.seen_surface import SeenSurface

_TRIALS = 1500
_SAMPLE = 4000
_MIN_OPACITY = 0.3
_BAND = 0.03
"""Maximum distance of points that belong to a plane, as a fraction of the search radius. With 0.06, planes fitted to
single views of a real table differ by 0.8 degrees; with 0.03, by 0.3 degrees."""
_VIEWS = 8
"""Maximum number of pictures to which a plane is fitted."""
_MIN_SUPPORT = 0.005
"""Minimum support of a plane, as a fraction of the visible level surface. A plane with less support is accidental."""
_CELL = 0.1
"""Side of the cells on which a plane must form a single patch, as a fraction of the object's size."""
_COVERED = 0.3
"""Fraction of a cell's area that must be covered for the cell to belong to the patch."""


@dataclass(frozen=True)
class FoundPlane:
    """A plane, and the share of the visible surface that lies in it."""

    plane: Plane
    support: float
    """Share of the visible surface that lies in the plane, 0 to 1."""


def find_planes(
    cloud: GaussianCloud,
    up: np.ndarray,
    *,
    count: int = 4,
    tilt_degrees: float = 25.0,
    thickness: float | None = None,
    seed: int = 0,
) -> list[FoundPlane]:
    """Find up to ``count`` planes within ``tilt_degrees`` of level by random sampling over opaque Gaussians, the one
    with the largest support first.

    A Gaussian is weighted by its opacity and the area of its broad side. The Gaussians of each plane are removed before
    the next search. The list is empty if nothing is flat.

    Args:
        cloud: the capture.
        up: (3,) up direction.
        count: maximum number of planes.
        tilt_degrees: maximum angle between the normal of a plane and ``up``.
        thickness: maximum distance of Gaussians from their plane, scene units; 1 % of the extent by default.
        seed: seed of the random numbers.
    """
    random = np.random.default_rng(seed)
    means, opacity = cloud.means.numpy().astype(np.float64), cloud.opacities()
    scales = np.sort(np.exp(cloud.log_scales.numpy().astype(np.float64)), axis=1)
    area = opacity * scales[:, 1] * scales[:, 2]
    # Without this limit, a few blurred Gaussians in the background would outweigh all others.
    area = np.minimum(area, np.quantile(area, 0.95))
    rest = np.flatnonzero(cloud.visible(_MIN_OPACITY) & (area > 0.0))
    if len(rest) < 10:
        return []
    low, high = np.quantile(means[rest], [0.02, 0.98], axis=0)
    band = thickness or 0.01 * float(np.linalg.norm(high - low))
    up = np.asarray(up, float) / np.linalg.norm(up)
    total = float(area[rest].sum())
    found: list[FoundPlane] = []
    for _ in range(count):
        if len(rest) < 10:
            break
        few = random.choice(rest, min(_SAMPLE, len(rest)), replace=False, p=area[rest] / area[rest].sum())
        plane = _best_plane(means[few], up, np.cos(np.radians(tilt_degrees)), band, random)
        if plane is None:
            break
        near = np.abs(plane.heights(means[rest])) < band
        plane = _levelled(means[rest[near]], area[rest[near]], up, plane)
        near = np.abs(plane.heights(means[rest])) < 2.0 * band
        support = float(area[rest[np.abs(plane.heights(means[rest])) < band]].sum()) / total
        found.append(FoundPlane(plane, support))
        rest = rest[~near]
    return sorted(found, key=lambda one: -one.support)


def _best_plane(
    points: np.ndarray, up: np.ndarray, least_cosine: float, band: float, random: np.random.Generator
) -> Plane | None:
    triples = random.integers(len(points), size=(_TRIALS, 3))
    a, b, c = (points[triples[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(lengths, 1e-300)[:, None]
    normals *= np.where(normals @ up < 0.0, -1.0, 1.0)[:, None]
    level = (normals @ up > least_cosine) & (lengths > 0.0)
    if not level.any():
        return None
    normals, through = normals[level], a[level]
    offsets = -np.einsum("ij,ij->i", normals, through)
    # Return the smoothly weighted number of points near each plane; the weight is 1 on the plane and 0 at the edge of
    # the band.
    scores = np.array(
        [
            np.clip(1.0 - ((points @ normal + offset) / band) ** 2, 0.0, None).sum()
            for normal, offset in zip(normals, offsets, strict=True)
        ]
    )
    best = int(np.argmax(scores))
    return Plane(normals[best], float(offsets[best]))


def _levelled(points: np.ndarray, weights: np.ndarray, up: np.ndarray, start: Plane) -> Plane:
    """Return the weighted least-squares plane through ``points``."""
    if len(points) < 3:
        return start
    centre = weights @ points / weights.sum()
    values, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, points - centre, points - centre))
    if values[1] <= 1e-12 * values[2]:
        return start
    normal = vectors[:, 0] * (1.0 if vectors[:, 0] @ up > 0 else -1.0)
    return Plane(normal, float(-normal @ centre))


def plane_under(
    planes: Sequence[FoundPlane], lowest: np.ndarray, *, tolerance: float, least_share: float = 0.1
) -> Plane | None:
    """Return the highest of ``planes`` that lies below the point ``lowest`` (3,), or at most ``tolerance`` above it.

    Planes with less than ``least_share`` of the largest support are ignored. Returns None if there is no such plane.
    """
    if not planes:
        return None
    largest = max(one.support for one in planes)
    below = [
        (float(one.plane.heights(lowest)), one.plane)
        for one in planes
        if one.support >= least_share * largest and one.plane.heights(lowest) > -tolerance
    ]
    return min(below, key=lambda entry: entry[0])[1] if below else None


def refine_plane(
    cloud: GaussianCloud,
    plane: Plane,
    cameras: Sequence[Camera],
    *,
    centre: np.ndarray,
    radius: float,
    object_mask: np.ndarray | None = None,
) -> PlaneFit:
    """Refit ``plane`` to the depth of ``cloud`` rendered through ``cameras``, Eq. (18), (19).

    The masks are computed as in ``plane_views``. Raises ``UserError`` if no camera sees the plane.
    """
    surfaces = _surfaces(cloud, plane, cameras, radius, object_mask)
    views = _masked(surfaces, plane, centre, radius, _BAND * radius)
    if not views:
        raise UserError("plane: no camera sees it around the object; give other cameras, or leave them out")
    fit = fit_plane(views)
    # Repeat the fit with heights over the fitted plane, which is already nearly aligned.
    realigned = _masked(surfaces, fit.plane, centre, radius, _BAND * radius)
    return fit_plane(realigned) if realigned else fit


def plane_views(
    cloud: GaussianCloud,
    plane: Plane,
    cameras: Sequence[Camera],
    *,
    centre: np.ndarray,
    radius: float,
    object_mask: np.ndarray | None = None,
    band: float | None = None,
) -> list[PlaneView]:
    """Return pictures of the surroundings of ``centre`` (3,), with masks of the plane.

    The masks are the pixels whose rendered point (``SeenSurface``) lies within ``band`` (default 3 % of ``radius``) of
    the plane and within ``radius`` of ``centre`` along it. The Gaussians of ``object_mask`` (n,) bool are not rendered.
    Cameras below the plane, and cameras that do not see it, are ignored. If there are more than eight cameras, eight of
    them are sampled evenly.
    """
    surfaces = _surfaces(cloud, plane, cameras, radius, object_mask)
    return _masked(surfaces, plane, centre, radius, band or _BAND * radius)


def _surfaces(
    cloud: GaussianCloud, plane: Plane, cameras: Sequence[Camera], radius: float, object_mask: np.ndarray | None
) -> list[SeenSurface]:
    above = [camera for camera in cameras if plane.heights(camera.centre) > 0.1 * radius]
    # Render without the object if it is known, because its foot would bias the fitted plane upwards.
    if object_mask is not None and object_mask.all():
        raise UserError(
            f"segment: all {cloud.count} Gaussians of the capture belong to the object, so no plane is visible; give"
            " the plane, or mark less of the capture"
        )
    bare = cloud if object_mask is None else cloud.subset(~object_mask)
    return [SeenSurface.of(bare, camera) for camera in above[:: max(1, -(-len(above) // _VIEWS))]]


def _masked(
    surfaces: Sequence[SeenSurface], plane: Plane, centre: np.ndarray, radius: float, band: float
) -> list[PlaneView]:
    views = []
    for seen in surfaces:
        depth = seen.depth_over(plane)
        points = seen.camera.centre + depth[..., None] * camera_rays(seen.camera)
        across = points - centre
        across = np.linalg.norm(across - (across @ plane.normal)[..., None] * plane.normal, axis=-1)
        mask = seen.opaque & (depth > 0.0) & (np.abs(plane.heights(points)) < band) & (across < radius)
        if mask.sum() >= 50:
            views.append(PlaneView(seen.camera, depth, mask))
    return views


def near_plane(cloud: GaussianCloud, plane: Plane, thickness: float) -> np.ndarray:
    """Return the mask (n,) bool of Gaussians whose means are within ``thickness`` (scene units) of the plane."""
    return np.abs(plane.heights(cloud.means.numpy())) < thickness


def lies_along(cloud: GaussianCloud, plane: Plane | HeightField) -> np.ndarray:
    """Return the mask (n,) bool of flat Gaussians that are parallel to ``plane``, like those of a floor, at any
    height."""
    scales = cloud.log_scales.numpy()
    turns = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    thin = np.take_along_axis(turns, scales.argmin(axis=1)[:, None, None], axis=2)[:, :, 0]
    ordered = np.sort(scales, axis=1)
    return (np.abs(thin @ plane.normal) > 0.85) & (ordered[:, 1] - ordered[:, 0] > np.log(2.0))


def further_planes(cloud: GaussianCloud, plane: Plane, size: float, count: int) -> list[FoundPlane]:
    """Return at most ``count`` other planes parallel to ``plane``, the one with the largest support first."""
    # Without this condition, slices of walls and of the object would also appear as planes.
    lying = lies_along(cloud, plane)
    if not lying.any():
        return []
    level = cloud.subset(lying)
    return [
        one
        for one in find_planes(level, plane.normal, count=count + 4, tilt_degrees=5.0)
        if one.support > _MIN_SUPPORT
        and _differ(one.plane, plane, size)
        and _is_one_patch(level, one.plane, _CELL * size)
    ][:count]


def _is_one_patch(level: GaussianCloud, plane: Plane, cell: float) -> bool:
    """Return True if a single patch of well covered cells contains most of the surface near ``plane``; ``cell`` is in
    scene units."""
    chosen = near_plane(level, plane, 0.5 * cell)
    if not chosen.any():
        return False
    near = level.subset(chosen)
    flat = near.means.numpy() @ np.stack(plane.tangents(), axis=1)
    area = near.opacities() * np.exp(np.sort(near.log_scales.numpy(), axis=1)[:, 1:].sum(axis=1))
    place = np.floor((flat - flat.min(axis=0)) / cell).astype(int)
    cover = np.zeros(place.max(axis=0) + 1)
    np.add.at(cover, tuple(place.T), area / cell**2)
    parts, _ = connected_parts(cover > _COVERED)
    return bool(np.bincount(parts.ravel(), cover.ravel())[1:].max(initial=0.0) > 0.5 * cover.sum())


def _differ(a: Plane, b: Plane, size: float) -> bool:
    apart = abs(float(a.offset / (a.normal @ b.normal) - b.offset))
    return bool(a.normal @ b.normal < np.cos(np.radians(5.0)) or apart > 0.05 * size)
