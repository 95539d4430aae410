"""Location of the ground plane under the object of a scene, and of the object on this plane."""

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
from egs_warp.io.capture import Capture
from egs_warp.io.planes import PlaneRecord
from egs_warp.notes import Detail, Problem
from egs_warp.pipelines.placed_cage import estimated_up
from egs_warp.pipelines.standing_object import (
    LEVEL_TOLERANCE,
    MAX_HOVER,
    MIN_SURROUNDING_SHARE,
    check_object,
    find_standing_object,
)
from egs_warp.segmentation.clicks import describe_click
from egs_warp.segmentation.ground import ROUGH, measure_ground
from egs_warp.segmentation.object_mask import TOUCHING, segment
from egs_warp.segmentation.object_spec import ObjectSpec, Segmentation
from egs_warp.segmentation.photo_clicks import ClicksInPhotos, object_without_ground, share_below, with_photos
from egs_warp.segmentation.plane_fit import PlaneFit
from egs_warp.segmentation.plane_search import find_planes, refine_plane
from egs_warp.segmentation.resting_plane import remove_foot_remnants, resting_plane
from egs_warp.segmentation.surface_graph import SurfaceGraph
from egs_warp.segmentation.table_top import surface_around

_PLANE_ELEVATIONS = (40.0, 58.0, 75.0)
"""Elevations of the cameras, degrees. At grazing angles, splats in front hide the splats behind them, and the floor
would appear too high."""
_MAX_TILT, _MAX_TILT_OF_CAMERAS = 25.0, 10.0
"""Maximum tilt of a plane that counts as level, degrees: relative to an up direction that was guessed or given, and
relative to one that follows from many cameras. The second is small, because a white desk without features is
reconstructed as haze, to which planes of any tilt can be fitted.
"""
_MAX_SHARE_BELOW = 0.03
"""Share of the visible area of what clicks describe that is below a plane which cuts it. It is at most 0.005 in
procedural rooms, and 0.05 to 0.73 for the mouse and the plush dog after short training, whose ground is haze."""
_MIN_TILT_DIFFERENCE = 1.0
"""Minimum reduction of the tilt by a plane that replaces an uncertain one, degrees."""
_TOP = 0.995
"""Quantile of the heights of the Gaussians that defines the height of the object."""
_BOX_QUANTILE = 0.995
"""Quantile of coordinates that defines the box around the capture."""
_BOX_MARGIN = 0.1
"""Distance from this box, as a fraction of its longest side, within which a point may still be on an object."""
_PLANE_SIDE = 400
"""Longer side of the pictures to which the plane is fitted, pixels."""


@dataclass(frozen=True)
class LocatedPlane:
    """The plane under the object, and the position of the object on it, in scene units."""

    plane: Plane
    fit: PlaneFit | None
    """Fit of the plane to rendered depth; None if the plane was given, or placed under the object."""
    centre: np.ndarray
    """(3,) Centre of the object."""
    size: float
    """Diagonal of the object's bounding box."""
    segmentation: Segmentation
    notes: tuple[str, ...]
    """Notes for the user."""
    ground: HeightField | None = None
    """Measured ground; None if it is flat."""
    in_sight: bool = True
    """False if the plane was placed under the object because the views do not show its support."""
    surface: SurfaceGraph | None = None
    """Capture prepared for clicks in photos; None if there are no such clicks."""

    def known(self) -> PlaneRecord:
        """Return the record of the plane for ``plane.json``."""
        record = PlaneRecord(self.plane, centre=self.centre, size=self.size, ground=self.ground)
        return record if self.fit is None else record.merged_with(known_of_fit(self.fit))


def known_of_fit(fit: PlaneFit) -> PlaneRecord:
    """Return the record of a fitted plane for ``plane.json``."""
    return PlaneRecord(fit.plane, noise=fit.noise, inlier_share=fit.inlier_share, pixels=fit.pixel_count)


def locate_plane(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    *,
    cameras: Sequence[Camera] = (),
    up: np.ndarray | None = None,
    plane: Plane | None = None,
) -> LocatedPlane:
    """Find the plane under the object, and segment the object on it.

    A coarse plane is estimated from the Gaussians (a table top has priority over a wider floor), and the object is
    segmented on it. The plane is then fitted to the depth rendered around the object, through ``cameras`` or a ring of
    steep views, and the object is segmented again. If many cameras define up and the fitted plane is not level, as can
    happen with a white desk without features, the plane is placed under the object's lowest parts instead.

    Args:
        cloud: The capture.
        spec: Specification of the object.
        cameras: Cameras of the capture, if known.
        up: (3,) Approximate up direction; None uses that of ``up_of_scene``.
        plane: The plane, if known; then only the object is segmented, and a note replaces the error for an object that
            seems to be a piece of the ground.

    Raises:
        UserError: There is no plane under the object, or no object.
    """
    notes: list[str] = []
    if spec.point is not None:
        _check_inside(cloud, spec, spec.point)
    spec = with_photos(cloud, spec, cameras)
    surface = spec.surface if isinstance(spec, ClicksInPhotos) else None
    if plane is not None:
        segmentation = segment(cloud, plane, spec)
        notes += _lost_clicks(spec, segmentation)
        try:
            check_object(cloud, plane, segmentation, spec)
        except UserError as error:
            notes.append(Problem(f"the object may be wrong: {error.message.removeprefix('object: ')}"))
        return LocatedPlane(
            plane, None, _middle(cloud, segmentation), segmentation.size, segmentation, tuple(notes), surface=surface
        )
    tilt = _MAX_TILT
    if up is None:
        up, up_notes, tilt = up_of_scene(cloud, cameras)
        notes += up_notes
    try:
        found = find_standing_object(cloud, spec, up, tilt)
    except UserError as error:
        widest = find_planes(cloud, up, count=1, tilt_degrees=tilt)
        resting = _on_unseen_ground(cloud, spec, widest[0].plane, up, tuple(notes)) if widest else None
        if resting is not None:
            return resting
        misplaced = _misplaced_click(cloud, spec, up, tilt, error)
        if misplaced is None:
            raise
        raise misplaced from error
    coarse, segmentation = found.plane, found.segmentation
    if surface_around(cloud, coarse, segmentation) < MIN_SURROUNDING_SHARE:
        resting = _on_unseen_ground(cloud, spec, coarse, up, tuple(notes))
        if resting is not None:
            return resting
    notes += found.notes
    centre = _middle(cloud, segmentation)
    radius = 0.75 * segmentation.size
    if cameras:
        views = [downscale(camera, _PLANE_SIDE) for camera in cameras]
    else:
        level = centre - coarse.heights(centre) * coarse.normal
        views = ring_cameras(coarse, level, radius, count=9, elevations=_PLANE_ELEVATIONS, size=_PLANE_SIDE)
    beside = ~segmentation.background_mask
    fit, failure = None, None
    try:
        fit = refine_plane(cloud, coarse, views, centre=centre, radius=radius, object_mask=beside)
    except UserError as error:
        failure = error
    visible = coarse if fit is None else fit.plane
    if tilt == _MAX_TILT_OF_CAMERAS and (fit is None or _lean(visible, up) > LEVEL_TOLERANCE):
        with contextlib.suppress(UserError):
            placed = resting_plane(cloud, beside, visible, up, degrees=tilt, size=segmentation.size)
            if fit is None or _lean(placed, up) < _lean(visible, up) - _MIN_TILT_DIFFERENCE:
                return _fallback_plane(cloud, spec, placed, tuple(notes))
        leaning = (
            f"the plane leans by {_lean(visible, up):.0f} degrees if the cameras were held upright; look at plane.png"
        )
        notes.append(Problem(leaning))
    if fit is None:
        assert failure is not None
        raise failure
    segmentation = segment(cloud, fit.plane, spec, hover=MAX_HOVER)
    notes += (*_hovering(cloud, fit.plane, segmentation), *_lost_clicks(spec, segmentation))
    notes.append(
        Detail(
            f"{_describe_plane(fit.plane)}: fits {fit.pixel_count} pixels "
            f"to {100 * fit.noise:.2f} % of depth, {100 * fit.inlier_share:.0f} % of them inliers"
        )
    )
    return LocatedPlane(
        fit.plane,
        fit,
        _middle(cloud, segmentation),
        segmentation.size,
        segmentation,
        tuple(notes),
        surface=surface,
    )


def _on_unseen_ground(
    cloud: GaussianCloud, spec: ObjectSpec, plane: Plane, up: np.ndarray, notes: tuple[str, ...]
) -> LocatedPlane | None:
    """Return the object on a plane under its lowest parts, if ``plane`` cuts the object that clicks in photos describe.

    In a coarse capture, plain ground is haze without a surface, and the planes that are found are slices of the object.
    The photos show what the clicks describe without any plane. None for another description of the object, if nearly
    nothing of it is below ``plane``, or if a surface surrounds it on one of the two planes, which is ground in sight.
    ``up`` (3,) may have any length.
    """
    if not isinstance(spec, ClicksInPhotos):
        return None
    up = up / np.linalg.norm(up)
    object_mask = object_without_ground(spec, up)
    if not object_mask.any() or share_below(spec, object_mask, plane) <= _MAX_SHARE_BELOW:
        return None
    low, high = np.quantile(cloud.means.numpy()[object_mask].astype(np.float64), [0.01, 0.99], axis=0)
    size = float(np.linalg.norm(high - low))
    nothing = np.zeros(cloud.count, bool)
    if surface_around(cloud, plane, Segmentation(object_mask, nothing, nothing, size)) >= MIN_SURROUNDING_SHARE:
        return None
    lowest = float(np.quantile(cloud.means.numpy()[object_mask] @ up, 0.01))
    with contextlib.suppress(UserError):
        placed = resting_plane(cloud, object_mask, Plane(up, -lowest), up, degrees=_MAX_TILT_OF_CAMERAS, size=size)
        located = _fallback_plane(cloud, spec, placed, notes)
        if surface_around(cloud, placed, located.segmentation) < MIN_SURROUNDING_SHARE:
            return located
    return None


def _fallback_plane(cloud: GaussianCloud, spec: ObjectSpec, plane: Plane, notes: tuple[str, ...]) -> LocatedPlane:
    """Segment the object on ``plane``, which was placed under the lowest parts of the object."""
    segmentation = remove_foot_remnants(cloud, plane, segment(cloud, plane, spec, hover=MAX_HOVER))
    notes = (*notes, *_lost_clicks(spec, segmentation))
    where = _describe_plane(plane)
    note = f"{where}: laid under the object's lowest parts, because no view shows where the ground is; see plane.png"
    return LocatedPlane(
        plane, None, _middle(cloud, segmentation), segmentation.size, segmentation, (*notes, note), in_sight=False
    )


def _misplaced_click(
    cloud: GaussianCloud, spec: ObjectSpec, up: np.ndarray, tilt: float, error: UserError
) -> UserError | None:
    """Return an error that quotes ``error`` and names the click on the object without which an object is found; None if
    there is no such click."""
    on_object = [number for number, click in enumerate(spec.clicks) if click.inside]
    if len(on_object) < 2 or spec.masks or spec.box is not None:
        return None
    for number in reversed(on_object):
        others = spec.clicks[:number] + spec.clicks[number + 1 :]
        first = next(click for click in others if click.inside)
        with contextlib.suppress(UserError):
            rest = find_standing_object(cloud, replace(spec, point=first.point, clicks=others), up, tilt).segmentation
            click = spec.clicks[number]
            away = float(np.linalg.norm(cloud.means.numpy()[rest.object_mask] - click.point, axis=1).min())
            reason = error.message.removeprefix("object: ")
            return UserError(
                f"object: no object with all clicks was found ({reason}); without the click"
                f" {describe_click(click)}, which is {away / rest.size:.2g} of its size away from it, an object of"
                f" {int(rest.object_mask.sum())} Gaussians is found; leave this click out, or move it",
                check=("plane",),
            )
    return None


def _lost_clicks(spec: ObjectSpec, segmentation: Segmentation) -> tuple[str, ...]:
    """Return a note for each click on the object that the object does not contain."""
    notes = []
    for number, click in enumerate(spec.clicks):
        if not click.inside or not len(click.hits) or segmentation.object_mask[click.hits].any():
            continue
        opposite = next(
            (one for one in spec.clicks[number + 1 :] if not one.inside and np.isin(click.hits, one.hits).any()), None
        )
        reason = (
            "it lies on or below the plane, or on haze; check the plane"
            if opposite is None
            else f"the later click {describe_click(opposite)} hits the same Gaussians; leave one of them out"
        )
        notes.append(Problem(f"the click {describe_click(click)} is not in the object: {reason}"))
    return tuple(notes)


def _describe_plane(plane: Plane) -> str:
    return f"plane {','.join(f'{x:.4f}' for x in (*plane.normal, plane.offset))}"


def _lean(plane: Plane, up: np.ndarray) -> float:
    """Return the angle between the plane's normal and ``up`` (3,), degrees."""
    return float(np.degrees(np.arccos(np.clip(plane.normal @ up / np.linalg.norm(up), -1.0, 1.0))))


def with_measured_ground(
    cloud: GaussianCloud, located: LocatedPlane, spec: ObjectSpec, cameras: Sequence[Camera] = ()
) -> LocatedPlane:
    """Measure the ground, and if it is not flat, segment the object again down to the measured ground.

    Args:
        cloud: The capture.
        located: Result of ``locate_plane``.
        spec: Specification of the object.
        cameras: Cameras of the capture, if known.

    Returns:
        ``located``, with ``ground`` if it is not flat, and a note if the ground is rough but treated as flat.
    """
    if not located.in_sight:
        return located
    segmentation = located.segmentation
    means = cloud.means.numpy()[segmentation.object_mask]
    height = float(np.quantile(located.plane.heights(means), _TOP))
    measured = measure_ground(
        cloud, ~segmentation.background_mask, located.plane, cameras=cameras, centre=located.centre, size=located.size
    )
    rough, noise = (f"{100.0 * value / height:.1f} %" for value in (measured.roughness, measured.noise))
    if measured.is_flat(height):
        if measured.roughness < ROUGH * height:
            return located
        note = f"the ground seems rough by {rough} of the object's height, but views differ by {noise}: treated as flat"
        return replace(located, notes=(*located.notes, note))
    spec = with_photos(cloud, spec, cameras, surface=located.surface)
    try:
        segmentation = segment(cloud, measured.field, spec, size=located.size)
    except UserError as error:
        note = f"the ground is rough by {rough} of the object's height, but is treated as flat ({error})"
        return replace(located, notes=(*located.notes, note))
    note = (
        f"the ground is not flat: it differs from its plane by {rough} of the object's height (views of it by {noise});"
        " the object stands on it as captured"
    )
    return replace(
        located,
        centre=_middle(cloud, segmentation),
        size=segmentation.size,
        segmentation=segmentation,
        notes=(*located.notes, note),
        ground=measured.touched_by(cloud.subset(segmentation.object_mask), segmentation.size),
    )


def _hovering(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> tuple[str, ...]:
    """Return a warning if the object hangs above the plane."""
    lowest = float(np.quantile(plane.heights(cloud.means.numpy()[segmentation.object_mask]), 0.002))
    if lowest <= TOUCHING * segmentation.size:
        return ()
    share = lowest / segmentation.size
    return (Problem(f"its lowest part hangs {share:.2f} of its size above the plane; check if parts are missing"),)


def _middle(cloud: GaussianCloud, segmentation: Segmentation) -> np.ndarray:
    means = cloud.means.numpy()[segmentation.object_mask].astype(np.float64)
    return 0.5 * (np.quantile(means, 0.01, axis=0) + np.quantile(means, 0.99, axis=0))


def up_of_cameras(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the up direction (3,), assuming that the ``cameras`` were held upright; None if they do not define one."""
    if len(cameras) < 3:
        return None
    # The image x axes span the level plane.
    rights = np.stack([camera.rotation[0] for camera in cameras])
    values, vectors = np.linalg.eigh(rights.T @ rights)
    if values[0] >= 0.1 * values[1]:
        return None
    ups = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
    return vectors[:, 0] * (1.0 if vectors[:, 0] @ ups > 0 else -1.0)


def up_of_scene(
    cloud: GaussianCloud, cameras: Sequence[Camera], *, tilted: bool = False
) -> tuple[np.ndarray, tuple[str, ...], float]:
    """Return the up direction of a capture with ``cameras``: that of its file, or else of the cameras, or else one
    estimated from its shape (``estimated_up``). If the first two differ by more than the tilt of a plane that counts as
    level, the file was written without rotating the capture to the axes of its format, and that of the cameras is used.

    Args:
        cloud: The capture.
        cameras: Cameras of the capture, if known.
        tilted: True if the capture may consist of one object; the estimate may then differ from the six axes. In a
            scene, the search for the plane finds the tilt.

    Returns:
        The up direction (3,), notes for the user, and the maximum tilt of a level plane relative to it, degrees.
    """
    from_file = cloud.up if isinstance(cloud, Capture) else None
    from_cameras = up_of_cameras(cameras)
    if from_file is not None:
        if from_cameras is None:
            return from_file, (), _MAX_TILT
        angle = float(np.degrees(np.arccos(np.clip(from_file @ from_cameras / np.linalg.norm(from_file), -1.0, 1.0))))
        if angle <= _MAX_TILT:
            return from_file, (), _MAX_TILT
        reason = f"the cameras are held upright; up in the file differs by {angle:.0f} degrees"
    else:
        reason = "the cameras are held upright"
    advice = "give the up direction"
    if from_cameras is None:
        up, note = estimated_up(cloud, advice=advice, tilted=tilted)
        return up, (note,), _MAX_TILT
    direction = ",".join(f"{x:.2f}" for x in from_cameras)
    note = f"up is taken to be {direction} ({reason}); if that is wrong, {advice}"
    return from_cameras, (note,), _MAX_TILT_OF_CAMERAS


def _check_inside(cloud: GaussianCloud, spec: ObjectSpec, point: np.ndarray) -> None:
    """Raise ``UserError`` if the ``point`` (3,) of ``spec`` lies outside the box around the capture without its
    outermost Gaussians."""
    low, high = np.quantile(cloud.means.numpy(), [1.0 - _BOX_QUANTILE, _BOX_QUANTILE], axis=0)
    margin = _BOX_MARGIN * (high - low).max()
    if np.any(point < low - margin) or np.any(point > high + margin):
        where, first, last = ((",".join(f"{x:.3g}" for x in corner)) for corner in (point, low, high))
        click = next((one for one in spec.clicks if one.inside and one.camera is not None), None)
        if click is not None and click.point is point:
            raise UserError(
                f"object: the click {describe_click(click)} hits a floater at {where}, outside the capture, which"
                f" extends from {first} to {last}; click on the object in another photo"
            )
        raise UserError(
            f"object: the point {where} is outside the capture, which extends from {first} to {last}; give a point on"
            " the object, in the capture's units"
        )
