"""The plane under the object of a scene, and the object on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, shrunk
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.base_plane import guess_up
from egs_warp.segmentation.object_mask import ObjectSpec, Segmentation, segment, votes_of_masks
from egs_warp.segmentation.plane_fit import PlaneFit
from egs_warp.segmentation.plane_search import find_planes, plane_under, refine_plane

_PLANE_ELEVATIONS = (40.0, 58.0, 75.0)
"""Degrees: seen at a grazing angle, splats in front hide those behind, and the floor seems to lie higher."""
_CLEAR_SUPPORT = 0.1
"""Share of the visible surface: a plane as wide as this is no accident."""
_LEVEL_DEGREES = 5.0
_PLANE_SIDE = 400
"""Pixels of the pictures that the plane is fitted to."""


@dataclass(frozen=True)
class LocatedPlane:
    """The plane under the object, and where on it the object is."""

    plane: Plane
    fit: PlaneFit | None
    """None where the plane was given."""
    centre: np.ndarray
    """(3,) middle of the object."""
    size: float
    """Scene units: diagonal of the object's bounding box."""
    segmentation: Segmentation
    notes: tuple[str, ...]

    def facts(self) -> dict[str, object]:
        """What ``plane.json`` says beside the plane itself."""
        fit = self.fit
        return {"centre": self.centre.tolist(), "size": self.size} | (
            {} if fit is None else {"noise": fit.noise, "inlier_share": fit.inlier_share, "pixels": fit.pixel_count}
        )


def locate_plane(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    up: np.ndarray | None = None,
    plane: Plane | None = None,
) -> LocatedPlane:
    """The plane under the object, and the object on it.

    A coarse plane is sampled from the Gaussians, the object found on it, and the plane then fitted to the depth
    rendered beside the object, through ``cameras`` or else a ring of steep ones; then the object is found again. With
    ``plane`` given, only the object is sought.
    """
    notes: list[str] = []
    if plane is not None:
        found = segment(cloud, plane, spec)
        return LocatedPlane(plane, None, _middle(cloud, found), found.size, found, ())
    if up is None:
        up, reason = _up_of(cloud, cameras)
        notes.append(f"up is taken to be {','.join(f'{x:.2f}' for x in up)} ({reason}); if not, give --up")
    coarse = _coarse_plane(cloud, spec, up)
    found = segment(cloud, coarse, spec)
    centre = _middle(cloud, found)
    radius = 0.75 * found.size
    if cameras:
        views = [shrunk(camera, _PLANE_SIDE) for camera in cameras]
    else:
        level = centre - coarse.heights(centre) * coarse.normal
        views = ring_cameras(coarse, level, radius, count=9, elevations=_PLANE_ELEVATIONS, size=_PLANE_SIDE)
    fit = refine_plane(cloud, coarse, views, centre=centre, radius=radius, object_mask=~found.background_mask)
    found = segment(cloud, fit.plane, spec)
    notes.append(
        f"plane {','.join(f'{x:.4f}' for x in (*fit.plane.normal, fit.plane.offset))}: fits {fit.pixel_count} pixels "
        f"to {100 * fit.noise:.2f} % of depth, {100 * fit.inlier_share:.0f} % of them inliers"
    )
    return LocatedPlane(fit.plane, fit, _middle(cloud, found), found.size, found, tuple(notes))


def _middle(cloud: GaussianCloud, found: Segmentation) -> np.ndarray:
    means = cloud.means.numpy()[found.object_mask].astype(np.float64)
    return 0.5 * (np.quantile(means, 0.01, axis=0) + np.quantile(means, 0.99, axis=0))


def _up_of(cloud: GaussianCloud, cameras: Sequence[Camera]) -> tuple[np.ndarray, str]:
    if len(cameras) >= 3:
        # Photographers hold cameras upright: the directions to the right span the level plane.
        rights = np.stack([camera.rotation[0] for camera in cameras])
        values, vectors = np.linalg.eigh(rights.T @ rights)
        ups = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
        if values[0] < 0.1 * values[1]:
            axis = vectors[:, 0]
            return axis * (1.0 if axis @ ups > 0 else -1.0), "the cameras are held upright"
    return guess_up(cloud)


def _coarse_plane(cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray) -> Plane:
    means = cloud.means.numpy().astype(np.float64)
    everywhere = find_planes(cloud, up)
    # The widest plane tells up better than a guess does, and what objects stand on is level.
    if everywhere and everywhere[0].support > _CLEAR_SUPPORT:
        up = everywhere[0].plane.normal
    searched, least_share = cloud, 0.3
    if spec.box is not None:
        if not spec.box.holds(means).any():
            raise UserError("object: the box holds nothing of the capture; give it in the capture's units")
        middle, half = 0.5 * (spec.box.low + spec.box.high), 0.5 * (spec.box.high - spec.box.low)
        searched = cloud.subset(np.all(np.abs(means - middle) < 1.5 * half, axis=1))
        reach = float(np.abs(up) @ half)
        lowest = middle - 0.5 * reach * up
        least_share = 0.5
    elif spec.masks:
        lowest = _low_point(cloud, spec, means, up)
    else:
        assert spec.point is not None
        lowest = spec.point
    planes = find_planes(searched, up, tilt_degrees=_LEVEL_DEGREES)
    plane = plane_under(planes, lowest, tolerance=0.0, least_share=least_share)
    if plane is None and spec.masks and planes:
        raise UserError(
            "object: most of the mask lies on the floor, not on an object that stands on it; mark the object, or check "
            "--view and --up"
        )
    if plane is None:
        raise UserError(
            "plane: none in sight under the object: nothing flat and level lies below it; check --up, or give --plane"
        )
    return plane


def _low_point(cloud: GaussianCloud, spec: ObjectSpec, means: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) a place in the lower third of what the masks show; never below the object's foot."""
    votes = votes_of_masks(cloud, spec.masks)
    inside = votes.inside * (votes.share_inside() > 0.5) * (votes.share_seen() > 0.02)
    if inside.sum() <= 0.0:
        raise UserError("object: nothing of the capture shows inside the masks; check masks and cameras")
    order = np.argsort(means @ up)
    share = np.cumsum(inside[order]) / inside.sum()
    return means[order[int(np.searchsorted(share, 0.3))]]
