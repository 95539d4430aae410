"""The plane under the object of a scene, and the object on it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.io.planes import PlaneRecord
from egs_warp.segmentation.base_plane import guess_up
from egs_warp.segmentation.ground import ROUGH, measure_ground
from egs_warp.segmentation.object_mask import TOUCHING, segment
from egs_warp.segmentation.object_spec import ObjectSpec, Segmentation
from egs_warp.segmentation.plane_fit import PlaneFit
from egs_warp.segmentation.plane_search import FoundPlane, find_planes, plane_under, refine_plane
from egs_warp.segmentation.resting_plane import remove_foot_remnants, resting_plane
from egs_warp.segmentation.table_top import planes_below, surface_around
from egs_warp.segmentation.votes import votes_of_masks

_PLANE_ELEVATIONS = (40.0, 58.0, 75.0)
"""Degrees: seen at a grazing angle, splats in front hide those behind, and the floor seems to lie higher."""
_CLEAR_SUPPORT = 0.1
"""Share of the visible surface: a plane as wide as this is no accident."""
_TILT_DEGREES, _HELD_DEGREES = 25.0, 10.0
"""What is level may be so far off an up that was guessed, or told by an axis; and off one that many cameras tell: a
white desk that no photo could be matched on is a haze through which planes of any tilt can be laid.
"""
_LEVEL_DEGREES, _CLEARLY_DEGREES = 5.0, 1.0
"""What leans by more is doubted, and what leans by so much less is taken instead."""
_TOP = 0.995
"""Quantile of the Gaussians' heights that is the object's."""
_HIGHER = 0.7
"""Of the way from a point down to the wide plane: a table top is higher than that."""
_GOES_ON = 0.25
"""Share of an object's surroundings in which what it stands on must go on: slabs and laps of real objects do in none or
next to none, the cloth on the bonsai's narrow table in 0.4."""
_HOVERING = 0.25
"""Of an object's size: so high above the only plane below it, it may hang."""
_PLANE_SIDE = 400
"""Pixels of the pictures that the plane is fitted to."""


@dataclass(frozen=True)
class LocatedPlane:
    """The plane under the object, and where on it the object is."""

    plane: Plane
    fit: PlaneFit | None
    """None where the plane was given, or laid under the object."""
    centre: np.ndarray
    """(3,) middle of the object."""
    size: float
    """Scene units: diagonal of the object's bounding box."""
    segmentation: Segmentation
    notes: tuple[str, ...]
    ground: HeightField | None = None
    """What is there, scene units, where it is not flat."""
    in_sight: bool = True
    """Whether views tell what the object stands on; else the plane was laid under it."""

    def known(self) -> PlaneRecord:
        """What ``plane.json`` says of it."""
        found = PlaneRecord(self.plane, centre=self.centre, size=self.size, ground=self.ground)
        return found if self.fit is None else found.merged_with(known_of_fit(self.fit))


def known_of_fit(fit: PlaneFit) -> PlaneRecord:
    """What ``plane.json`` says of a fitted plane."""
    return PlaneRecord(fit.plane, noise=fit.noise, inlier_share=fit.inlier_share, pixels=fit.pixel_count)


def locate_plane(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    up: np.ndarray | None = None,
    plane: Plane | None = None,
) -> LocatedPlane:
    """The plane under the object, and the object on it.

    A coarse plane is sampled from the Gaussians (a table top goes before a wider floor), the object found on it, and
    the plane then fitted to the depth rendered beside the object, through ``cameras`` or else a ring of steep ones;
    then the object is found again. Where the cameras tell up, and what is rendered is not level (the haze over a white
    desk), the plane is laid under the object instead. With ``plane`` given, only the object is sought.
    """
    notes: list[str] = []
    if plane is not None:
        found = segment(cloud, plane, spec)
        return LocatedPlane(plane, None, _middle(cloud, found), found.size, found, ())
    tilt = _TILT_DEGREES
    if up is None:
        up, reason, tilt = _up_of(cloud, cameras)
        notes.append(f"up is taken to be {','.join(f'{x:.2f}' for x in up)} ({reason}); if not, say which way is up")
    coarse, found = _standing(cloud, spec, up, tilt)
    centre = _middle(cloud, found)
    radius = 0.75 * found.size
    if cameras:
        views = [downscale(camera, _PLANE_SIDE) for camera in cameras]
    else:
        level = centre - coarse.heights(centre) * coarse.normal
        views = ring_cameras(coarse, level, radius, count=9, elevations=_PLANE_ELEVATIONS, size=_PLANE_SIDE)
    beside = ~found.background_mask
    fit, failure = None, None
    try:
        fit = refine_plane(cloud, coarse, views, centre=centre, radius=radius, object_mask=beside)
    except UserError as error:
        failure = error
    seen = coarse if fit is None else fit.plane
    if tilt == _HELD_DEGREES and (fit is None or _lean(seen, up) > _LEVEL_DEGREES):
        with contextlib.suppress(UserError):
            laid = resting_plane(cloud, beside, seen, up, degrees=tilt, size=found.size)
            if fit is None or _lean(laid, up) < _lean(seen, up) - _CLEARLY_DEGREES:
                return _fallback_plane(cloud, spec, laid, tuple(notes))
        leaning = (
            f"the plane leans by {_lean(seen, up):.0f} degrees if the cameras were held upright; look at plane.png"
        )
        notes.append(leaning)
    if fit is None:
        assert failure is not None
        raise failure
    found = segment(cloud, fit.plane, spec, hover=_HOVERING)
    notes += _hovering(cloud, fit.plane, found)
    notes.append(
        f"{_describe_plane(fit.plane)}: fits {fit.pixel_count} pixels "
        f"to {100 * fit.noise:.2f} % of depth, {100 * fit.inlier_share:.0f} % of them inliers"
    )
    return LocatedPlane(fit.plane, fit, _middle(cloud, found), found.size, found, tuple(notes))


def _fallback_plane(cloud: GaussianCloud, spec: ObjectSpec, plane: Plane, notes: tuple[str, ...]) -> LocatedPlane:
    """The object on the ``plane`` that was laid under it."""
    found = remove_foot_remnants(cloud, plane, segment(cloud, plane, spec, hover=_HOVERING))
    where = _describe_plane(plane)
    note = f"{where}: laid under the object's lowest parts, as no view tells where the ground is; see plane.png"
    return LocatedPlane(plane, None, _middle(cloud, found), found.size, found, (*notes, note), in_sight=False)


def _describe_plane(plane: Plane) -> str:
    return f"plane {','.join(f'{x:.4f}' for x in (*plane.normal, plane.offset))}"


def _lean(plane: Plane, up: np.ndarray) -> float:
    """Degrees."""
    return float(np.degrees(np.arccos(np.clip(plane.normal @ up / np.linalg.norm(up), -1.0, 1.0))))


def with_measured_ground(
    cloud: GaussianCloud, located: LocatedPlane, spec: ObjectSpec, cameras: Sequence[Camera] = ()
) -> LocatedPlane:
    """``located``, and where the ground is not flat, what is there, and the object down to it; or why not."""
    if not located.in_sight:
        return located
    found = located.segmentation
    means = cloud.means.numpy()[found.object_mask]
    height = float(np.quantile(located.plane.heights(means), _TOP))
    measured = measure_ground(
        cloud, ~found.background_mask, located.plane, cameras=cameras, centre=located.centre, size=located.size
    )
    rough, noise = (f"{100.0 * value / height:.1f} %" for value in (measured.roughness, measured.noise))
    if measured.is_flat(height):
        if measured.roughness < ROUGH * height:
            return located
        note = f"the ground seems rough by {rough} of the object's height, but views differ by {noise}: taken as flat"
        return replace(located, notes=(*located.notes, note))
    try:
        found = segment(cloud, measured.field, spec, size=located.size)
    except UserError as error:
        note = f"the ground is rough by {rough} of the object's height, but taken for flat ({error})"
        return replace(located, notes=(*located.notes, note))
    note = (
        f"the ground is not flat: it differs from its plane by {rough} of the object's height (views of it by {noise});"
        " the object stands on it as captured"
    )
    return replace(
        located,
        centre=_middle(cloud, found),
        size=found.size,
        segmentation=found,
        notes=(*located.notes, note),
        ground=measured.touched_by(cloud.subset(found.object_mask), found.size),
    )


def _hovering(cloud: GaussianCloud, plane: Plane, found: Segmentation) -> tuple[str, ...]:
    """What there is to say of an object that hangs in the air."""
    lowest = float(np.quantile(plane.heights(cloud.means.numpy()[found.object_mask]), 0.002))
    if lowest <= TOUCHING * found.size:
        return ()
    return (
        f"its lowest part hangs {lowest / found.size:.2f} of its size above the plane; if parts are missing, say so",
    )


def _middle(cloud: GaussianCloud, found: Segmentation) -> np.ndarray:
    means = cloud.means.numpy()[found.object_mask].astype(np.float64)
    return 0.5 * (np.quantile(means, 0.01, axis=0) + np.quantile(means, 0.99, axis=0))


def _up_of(cloud: GaussianCloud, cameras: Sequence[Camera]) -> tuple[np.ndarray, str, float]:
    """(3,) up, why, and by how many degrees what is level may be off it."""
    if len(cameras) >= 3:
        # Photographers hold cameras upright: the directions to the right span the level plane.
        rights = np.stack([camera.rotation[0] for camera in cameras])
        values, vectors = np.linalg.eigh(rights.T @ rights)
        ups = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
        if values[0] < 0.1 * values[1]:
            axis = vectors[:, 0]
            return axis * (1.0 if axis @ ups > 0 else -1.0), "the cameras are held upright", _HELD_DEGREES
    return *guess_up(cloud), _TILT_DEGREES


def _standing(cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray, tilt: float) -> tuple[Plane, Segmentation]:
    """A coarse plane, and the object on it: that of the capture's wide planes that is under the object, or a higher one
    that only its surroundings show (a table top).
    """
    everywhere = find_planes(cloud, up, tilt_degrees=tilt)
    found, wide, failure = None, None, None
    try:
        wide = _coarse_plane(cloud, spec, up, everywhere)
        found = segment(cloud, wide, spec)
    except UserError as error:
        failure = error
    if spec.point is not None or (failure is not None and spec.masks):
        point = _lowest_point(spec, up)
        point = point if point is not None else _low_point(cloud, spec, cloud.means.numpy(), up)
        for plane in planes_below(cloud, _level(up, everywhere), point):
            if wide is not None and plane.heights(point) > _HIGHER * wide.heights(point):
                break
            with contextlib.suppress(UserError):
                standing = segment(cloud, plane, spec)
                if surface_around(cloud, plane, standing) > _GOES_ON:
                    return plane, standing
    if wide is not None and found is None:
        # Where nothing higher is below it, it may hover: it comes down before it moves.
        with contextlib.suppress(UserError):
            found = segment(cloud, wide, spec, hover=_HOVERING)
    if wide is None or found is None:
        assert failure is not None
        raise failure
    return wide, found


def _level(up: np.ndarray, everywhere: Sequence[FoundPlane]) -> np.ndarray:
    """(3,) the widest plane tells up better than a guess does, and what objects stand on is level."""
    return everywhere[0].plane.normal if everywhere and everywhere[0].support > _CLEAR_SUPPORT else up


def _coarse_plane(cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray, everywhere: Sequence[FoundPlane]) -> Plane:
    means = cloud.means.numpy().astype(np.float64)
    up = _level(up, everywhere)
    searched, least_share = cloud, 0.3
    if spec.box is not None:
        if not spec.box.holds(means).any():
            raise UserError("object: the box holds nothing of the capture; give it in the capture's units")
        middle, half = 0.5 * (spec.box.low + spec.box.high), 0.5 * (spec.box.high - spec.box.low)
        around = np.all(np.abs(means - middle) < 1.5 * half, axis=1)
        if not around.any():
            raise UserError("object: the box has no volume; give two opposite corners that differ along every axis")
        searched = cloud.subset(around)
        reach = float(np.abs(up) @ half)
        lowest = middle - 0.5 * reach * up
        least_share = 0.5
    elif spec.masks:
        lowest = _low_point(cloud, spec, means, up)
    else:
        lowest = _lowest_point(spec, up)
        assert lowest is not None
    planes = find_planes(searched, up, tilt_degrees=_LEVEL_DEGREES)
    plane = plane_under(planes, lowest, tolerance=0.0, least_share=least_share)
    if plane is None and spec.masks and planes:
        raise UserError(
            "object: most of the mask lies on the floor, not on an object that stands on it; mark the object",
            check=("view", "up"),
        )
    if plane is None:
        raise UserError(
            "plane: none in sight under the object: nothing flat and level lies below it; give the plane",
            check=("plane", "up"),
        )
    return plane


def _lowest_point(spec: ObjectSpec, up: np.ndarray) -> np.ndarray | None:
    """(3,) the point, or the lowest of the clicks on the object: its plane lies below all of them."""
    if spec.point is None:
        return None
    points = [spec.point, *(click.point for click in spec.clicks if click.inside)]
    return min(points, key=lambda point: float(point @ up))


def _low_point(cloud: GaussianCloud, spec: ObjectSpec, means: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) a place in the lower third of what the masks show; never below the object's foot."""
    votes = votes_of_masks(cloud, spec.masks)
    inside = votes.inside * (votes.share_inside() > 0.5) * (votes.share_seen() > 0.02)
    if inside.sum() <= 0.0:
        raise UserError("object: nothing of the capture shows inside the masks; check masks and cameras")
    order = np.argsort(means @ up)
    share = np.cumsum(inside[order]) / inside.sum()
    return means[order[int(np.searchsorted(share, 0.3))]]
