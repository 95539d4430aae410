"""Search for the object that a selection describes and for the surface on which it stands: the ground, a table top or a
pedestal."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.above_plane import MIN_OPACITY
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import Box, ObjectSpec, Segmentation
from egs_warp.segmentation.outline import ledge_around, stands_out
from egs_warp.segmentation.photo_clicks import ClicksInPhotos
from egs_warp.segmentation.plane_search import FoundPlane, find_planes, plane_under
from egs_warp.segmentation.table_top import is_own_ledge, planes_below, surface_around
from egs_warp.segmentation.votes import votes_of_masks

_MIN_SUPPORT = 0.1
"""Minimum fraction of the visible surface on the widest plane for its normal to define up."""
LEVEL_TOLERANCE = 5.0
"""Tilt above which a plane is uncertain, degrees."""
_MAX_TABLE_DISTANCE = 0.7
"""Maximum height of a point above a table top, as a fraction of its height above the wide plane."""
MIN_SURROUNDING_SHARE = 0.25
"""Minimum fraction of an object's surroundings that its support must cover. Horizontal parts of the object itself cover
about 0 of its surroundings; the cloth on the narrow table of the bonsai scene covers 0.4."""
_MIN_NARROW_SHARE = 0.1
"""The same fraction for an object that would hang in the air above every other plane: it has to rest on something."""
MIN_LEDGE = 0.7
"""Minimum fraction of the rim of an object's foot on which a narrow support must be visible. It is 0.9 for the fox on
its pedestal, and 0.4 for its feet on their slab, which does not extend beyond them on all sides."""
_MAX_VOLUME_SHARE = 0.5
"""Maximum ratio of the volume of the box around an object to that of the box around object and base, for the object to
end at the base. A smaller base, such as the pot of a plant, belongs to the object."""
_MIN_BASE = 0.015
"""Minimum height of a base on which the object in a box stands, as a fraction of the object's size."""
MAX_HOVER = 0.25
"""Maximum height of an object above the only plane below it, as a fraction of the object's size."""
_LOW = 0.15
"""Height, as a fraction of an object's size, below which a point may lie on the surface that supports the object."""
_NEIGHBOURS, _MIN_OWN = 16, 0.25
"""Number of Gaussians nearest to a point, and minimum fraction of them that belongs to an object on which it lies."""
_ON_GROUND, _STANDING = 0.02, 0.04
"""Maximum distance from a plane of a point that lies on it, and minimum height of Gaussians above it that belong to
objects, as fractions of the diagonal of the capture."""

_MIN_THICKNESS = 0.002
"""Height above a plane, as a fraction of the diagonal of the capture, below which a point lies on the plane, even if
the plane does not scatter."""


@dataclass(frozen=True)
class StandingObject:
    """An object, and the plane on which it stands."""

    plane: Plane
    """Coarse plane, scene units."""
    segmentation: Segmentation
    notes: tuple[str, ...] = ()
    """Notes for the user about the base of the object."""


def find_standing_object(cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray, tilt: float) -> StandingObject:
    """Find the object and a coarse plane under it.

    The plane is the wide plane under the object, or a higher one that surrounds the object, such as a table top. If a
    point selects the object, it may also be the top of a base that is larger than the object, such as a pedestal, and
    on which a level ledge surrounds the foot of the object. If a box selects the object, a surface that does not
    continue around it, such as the top of the slab of a statue, is a part of the object.

    Args:
        cloud: The capture.
        spec: Specification of the object.
        up: (3,) Approximate up direction.
        tilt: Maximum tilt of planes relative to ``up``, degrees.

    Raises:
        UserError: There is no plane under the object, there is no object, or a point or box selects only a piece of
            the ground.
    """
    everywhere = find_planes(cloud, up, tilt_degrees=tilt)
    level = _level(up, everywhere)
    has_photos = isinstance(spec, ClicksInPhotos)
    whole, wide, failure = None, None, None
    narrow, best_share = None, _MIN_NARROW_SHARE
    notes: tuple[str, ...] = ()
    try:
        wide = _coarse_plane(cloud, spec, level)
        whole = segment(cloud, wide, spec)
        if spec.box is not None:
            boxed = _object_in_box(cloud, spec, level, StandingObject(wide, whole))
            wide, whole, notes = boxed.plane, boxed.segmentation, boxed.notes
    except UserError as error:
        failure = error
    if spec.point is not None or (failure is not None and spec.masks):
        point = _lowest_point(spec, up)
        point = point if point is not None else _low_point(cloud, spec, cloud.means.numpy(), up)
        for plane in planes_below(cloud, level, point, has_tolerance=spec.point is not None and not has_photos):
            if wide is not None and plane.heights(point) > _MAX_TABLE_DISTANCE * wide.heights(point):
                break
            try:
                standing = segment(cloud, plane, spec)
            except UserError:
                continue
            if has_photos and whole is not None and is_own_ledge(cloud, plane, standing, whole):
                continue
            surroundings = surface_around(cloud, plane, standing)
            is_table = surroundings > MIN_SURROUNDING_SHARE
            if not is_table and (has_photos or ledge_around(cloud, plane, standing) < MIN_LEDGE):
                if surroundings > best_share and stands_out(cloud, plane, standing):
                    best_share, narrow = surroundings, StandingObject(plane, standing)
                continue
            if spec.point is not None and not stands_out(cloud, plane, standing):
                continue
            if not is_table and wide is not None and whole is not None:
                if _box_volume(cloud, level, standing) > _MAX_VOLUME_SHARE * _box_volume(cloud, level, whole):
                    notes = (_base_note("includes the base on which it stands", "leave it out", plane),)
                    continue
                notes = (_base_note("ends at the base on which it stands", "include it", wide),)
            check_object(cloud, plane, standing, spec, ground=wide)
            return StandingObject(plane, standing, () if is_table else notes)
    if wide is not None and whole is None:
        # If there is no higher plane below the object, it may hover; ``snap_to_plane`` moves it down later.
        with contextlib.suppress(UserError):
            whole = segment(cloud, wide, spec, hover=MAX_HOVER)
    if whole is None and narrow is not None:
        check_object(cloud, narrow.plane, narrow.segmentation, spec, ground=wide)
        return narrow
    if wide is None or whole is None:
        assert failure is not None
        surface = None if spec.point is None else _plane_at(cloud, spec.point, everywhere)
        if surface is not None and spec.point is not None:
            adjacent = _message_about_nearest(cloud, surface, spec.point)
            if adjacent is not None:
                raise UserError(adjacent)
            if surface.heights(spec.point) < _thickness(cloud, surface):
                raise _refusal(cloud, surface, spec)
        raise failure
    check_object(cloud, wide, whole, spec)
    return StandingObject(wide, whole, notes)


def check_object(
    cloud: GaussianCloud, plane: Plane, segmentation: Segmentation, spec: ObjectSpec, *, ground: Plane | None = None
) -> None:
    """Raise ``UserError`` if a point or a box selects a piece of the surface ``plane`` instead of an object, or if the
    point lies on this surface beside the object.

    Args:
        cloud: The capture.
        plane: Plane under the object.
        segmentation: The object.
        spec: Specification of the object.
        ground: The wide plane below ``plane``, if it is another one.
    """
    if spec.masks or (spec.point is None and spec.box is None):
        return
    if not stands_out(cloud, plane, segmentation):
        raise _refusal(cloud, plane, spec)
    if spec.point is None or plane.heights(spec.point) > _LOW * segmentation.size:
        return
    visible = cloud.visible(MIN_OPACITY)
    for click in spec.clicks:
        # The Gaussians that a click hits are in the object wherever they are.
        visible[click.hits] = False
    near = np.flatnonzero(visible)
    means = cloud.means.numpy().astype(np.float64)
    if len(near) == 0:
        return
    nearest = near[np.ravel(KDTree(means[near]).query(spec.point, k=min(_NEIGHBOURS, len(near)))[1])]
    if (~segmentation.background_mask[nearest]).mean() >= _MIN_OWN:
        return
    height = 0.0 if ground is None else float(ground.heights(spec.point))
    if ground is None or height < _LOW * segmentation.size:
        raise UserError(_message_about_adjacent(cloud, spec.point, "the ground", plane, segmentation))
    raise UserError(
        _message_about_adjacent(
            cloud, spec.point, f"a level surface {height:.3g} above the ground", plane, segmentation
        )
        + f", or, to select this surface as well, give also the plane of the ground {_coefficients(ground)}"
    )


def _refusal(cloud: GaussianCloud, plane: Plane, spec: ObjectSpec) -> UserError:
    """Return the error for a point or a box that contains nothing but ground. It names the nearest object on ``plane``,
    if there is one."""
    if spec.point is None:
        return UserError(
            "object: the box contains only ground; give a box around the whole object, or mark it with masks"
        )
    return UserError(
        _message_about_nearest(cloud, plane, spec.point)
        or f"object: the point {_numbers(spec.point)} lies on the ground, and nothing rises above it there; give a"
        " point on the object, above the ground, or mark it with masks"
    )


def _message_about_nearest(cloud: GaussianCloud, plane: Plane, point: np.ndarray) -> str | None:
    """Return the error message for a point (3,) on the ground that names the nearest object on ``plane``; None if there
    is no object."""
    means = cloud.means.numpy().astype(np.float64)
    standing = means[cloud.visible(MIN_OPACITY) & (plane.heights(means) > _STANDING * _diagonal(means))]
    if len(standing):
        nearest = standing[np.argmin(np.linalg.norm(standing - point, axis=1))]
        with contextlib.suppress(UserError):
            found = segment(cloud, plane, ObjectSpec(point=nearest))
            if stands_out(cloud, plane, found):
                return _message_about_adjacent(cloud, point, "the ground", plane, found)
    return None


def _message_about_adjacent(
    cloud: GaussianCloud, point: np.ndarray, surface: str, plane: Plane, segmentation: Segmentation
) -> str:
    """Return the error message for a point (3,) on a ``surface`` next to an object that stands on ``plane``."""
    own = cloud.means.numpy()[segmentation.object_mask].astype(np.float64)
    heights = plane.heights(own)
    # If the object includes a base, its upper half does not.
    upper = own[heights >= np.median(heights)]
    middle = upper[np.argmin(np.linalg.norm(upper - np.median(upper, axis=0), axis=1))]
    return (
        f"object: the point {_numbers(point)} lies on {surface}, beside an object of {len(own)} Gaussians and size"
        f" {segmentation.size:.3g}; mark another object with masks, or give a point on this one, such as"
        f" {_numbers(middle)}"
    )


def _plane_at(cloud: GaussianCloud, point: np.ndarray, planes: Sequence[FoundPlane]) -> Plane | None:
    """Return the first of the wide planes on which ``point`` (3,) lies; None if there is none."""
    near = _ON_GROUND * _diagonal(cloud.means.numpy())
    on = (one.plane for one in planes if one.support >= _MIN_SUPPORT and abs(float(one.plane.heights(point))) < near)
    return next(on, None)


def _thickness(cloud: GaussianCloud, plane: Plane) -> float:
    """Return twice the standard deviation, scene units, of the heights of the visible Gaussians that lie on ``plane``,
    and at least a small fraction of the diagonal of the capture."""
    means = cloud.means.numpy().astype(np.float64)
    diagonal = _diagonal(means)
    away = np.abs(plane.heights(means[cloud.visible(MIN_OPACITY)]))
    away = away[away < _ON_GROUND * diagonal]
    return max(2.0 * 1.4826 * float(np.median(away)) if len(away) else 0.0, _MIN_THICKNESS * diagonal)


def _diagonal(means: np.ndarray) -> float:
    """Return the diagonal, scene units, of the box around the means (n, 3) of a capture without outliers."""
    low, high = np.quantile(means, [0.02, 0.98], axis=0)
    return float(np.linalg.norm(high - low))


def _box_volume(cloud: GaussianCloud, up: np.ndarray, segmentation: Segmentation) -> float:
    """Return the volume, cubic scene units, of the object's upright bounding box without outliers."""
    axes = np.stack([*Plane(up, 0.0).tangents(), up])
    extents = np.quantile(cloud.means.numpy()[segmentation.object_mask] @ axes.T, [0.005, 0.995], axis=0)
    return float(np.prod(extents[1] - extents[0]))


def _base_note(what: str, alternative: str, plane: Plane) -> str:
    return f"the object {what}; to {alternative}, give the plane {_coefficients(plane)}"


def _coefficients(plane: Plane) -> str:
    return ",".join(f"{x:.4f}" for x in (*plane.normal, plane.offset))


def _numbers(point: np.ndarray) -> str:
    return ",".join(f"{x:.4g}" for x in point)


def _level(up: np.ndarray, everywhere: Sequence[FoundPlane]) -> np.ndarray:
    """Return the normal (3,) of the widest plane if it is wide enough, otherwise ``up``. Supports are level planes."""
    return everywhere[0].plane.normal if everywhere and everywhere[0].support > _MIN_SUPPORT else up


def _continues(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> bool:
    """Return True if a level surface in ``plane`` surrounds the foot of the object, however narrow it is."""
    is_table = surface_around(cloud, plane, segmentation) > MIN_SURROUNDING_SHARE
    return is_table or ledge_around(cloud, plane, segmentation) >= MIN_LEDGE


def _object_in_box(cloud: GaussianCloud, spec: ObjectSpec, level: np.ndarray, coarse: StandingObject) -> StandingObject:
    """Return the object in a box. If the surface in the plane of ``coarse`` does not continue around the object, it is
    a part of the object, which then stands on the highest plane below in which a surface continues. If there is none,
    ``coarse`` is returned."""
    assert spec.box is not None
    if _continues(cloud, coarse.plane, coarse.segmentation):
        return coarse
    point, step = _low_in_box(spec.box, level), _MIN_BASE * coarse.segmentation.size
    for plane in planes_below(cloud, level, point):
        drop = float(plane.heights(point) - coarse.plane.heights(point))
        if drop < -step:
            continue
        with contextlib.suppress(UserError):
            standing = segment(cloud, plane, spec)
            if _continues(cloud, plane, standing):
                note = _base_note("includes the base on which it stands", "leave it out", coarse.plane)
                return StandingObject(plane, standing, (note,) if drop > step else ())
    return coarse


def _low_in_box(box: Box, up: np.ndarray) -> np.ndarray:
    """Return the point (3,) in the middle of the lower half of a box."""
    return 0.5 * (box.low + box.high) - 0.25 * float(np.abs(up) @ (box.high - box.low)) * up


def _coarse_plane(cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray) -> Plane:
    """Return the wide plane below the object."""
    means = cloud.means.numpy().astype(np.float64)
    searched, least_share = cloud, 0.3
    if spec.box is not None:
        if not spec.box.holds(means).any():
            raise UserError("object: the box contains no Gaussian of the capture; give it in the capture's units")
        middle, half = 0.5 * (spec.box.low + spec.box.high), 0.5 * (spec.box.high - spec.box.low)
        around = np.all(np.abs(means - middle) < 1.5 * half, axis=1)
        if not around.any():
            raise UserError("object: the box has no volume; give two opposite corners that differ along every axis")
        searched = cloud.subset(around)
        lowest = _low_in_box(spec.box, up)
        least_share = 0.5
    elif spec.masks or spec.picked is not None:
        lowest = _low_point(cloud, spec, means, up)
    else:
        lowest = _lowest_point(spec, up)
        assert lowest is not None
    planes = find_planes(searched, up, tilt_degrees=LEVEL_TOLERANCE)
    plane = plane_under(planes, lowest, tolerance=0.0, least_share=least_share)
    if plane is None and spec.masks and planes:
        raise UserError(
            "object: most of the mask lies on the floor, not on an object that stands on it; mark the object",
            check=("view", "up"),
        )
    if plane is None and planes and spec.point is not None and spec.picked is None:
        surface = planes[0].plane
        raise UserError(
            f"object: the point {_numbers(lowest)} is {-float(surface.heights(lowest)):.3g} below the widest level"
            " surface, and there is none below the point; give a point on the object, above the surface on which it"
            " stands",
            check=("up",),
        )
    if plane is None and spec.box is not None:
        raise UserError(
            "object: no level ground was found around the box; give a box around the whole object, down to its ground,"
            " or give the plane as well",
            check=("plane", "up"),
        )
    if plane is None:
        raise UserError(
            "plane: none found under the object: nothing flat and level lies below it; give the plane",
            check=("plane", "up"),
        )
    return plane


def _lowest_point(spec: ObjectSpec, up: np.ndarray) -> np.ndarray | None:
    """Return the lowest of the points (3,) that select the object: the point and the clicks on the object; None if
    there are none."""
    if spec.point is None:
        return None
    points = [spec.point, *(click.point for click in spec.clicks if click.inside)]
    return min(points, key=lambda point: float(point @ up))


def _low_point(cloud: GaussianCloud, spec: ObjectSpec, means: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return a point (3,) in the lower third of the masked or picked object, above its foot."""
    if spec.picked is not None:
        inside = spec.picked * cloud.opacities()
    else:
        votes = votes_of_masks(cloud, spec.masks)
        inside = votes.inside * (votes.share_inside() > 0.5) * (votes.share_seen() > 0.02)
    if inside.sum() <= 0.0:
        raise UserError("object: no part of the capture is visible inside the masks; check masks and cameras")
    order = np.argsort(means @ up)
    share = np.cumsum(inside[order]) / inside.sum()
    return means[order[int(np.searchsorted(share, 0.3))]]
