"""The object described by a point or by clicks, in a capture whose photos are known. See
docs/concepts/segmentation.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.above_plane import MIN_OPACITY, SceneAbovePlane
from egs_warp.segmentation.click_energy import ClickScene, consistent, minimise, picture_scale, shared_colours
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.framing import MIN_PHOTOS, is_in_frame
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.surface_graph import SurfaceGraph

_SEED_COUNT = 8
"""Number of Gaussians next to a point that represent a click there."""
_MAX_WIDTH = 0.05
"""Maximum standard deviation, in picture radii, of a hit Gaussian that is a hard constraint."""
_FAR = 100.0
"""Distance of a ground that is no evidence, in extents of the capture."""
_UNEVEN = 0.03
"""Depth below a plane within which an object may touch uneven ground, as a fraction of the object's size."""


@dataclass(frozen=True)
class ClicksInPhotos(ObjectSpec):
    """An object that is described by a point or clicks, with the capture prepared from photos that show it."""

    surface: SurfaceGraph | None = None
    """Capture prepared for the clicks."""
    shared_colours: float = 0.0
    """``Segmentation.shared_colours`` of the Gaussians in ``picked``."""


def with_photos(
    cloud: GaussianCloud, spec: ObjectSpec, cameras: Sequence[Camera], *, surface: SurfaceGraph | None = None
) -> ObjectSpec:
    """Return ``spec`` with ``cloud`` prepared for its point or clicks, if at least eight photos show the point. A
    ``spec`` with masks or a box is returned unchanged, because these are more precise.

    Args:
        cloud: the capture.
        spec: the user's description of the object.
        cameras: cameras of the photos.
        surface: the prepared capture, if it exists already; None prepares it.
    """
    if spec.point is None or spec.masks:
        return spec
    showing = [camera for camera in cameras if is_in_frame(spec.point[None], camera)[0]]
    if len(showing) < MIN_PHOTOS:
        return spec
    surface = surface or SurfaceGraph.of(cloud, showing)
    return ClicksInPhotos(spec.masks, spec.box, spec.point, spec.clicks, spec.picked, surface)


def picked_in_photos(spec: ClicksInPhotos, scene: SceneAbovePlane) -> ClicksInPhotos:
    """Return ``spec`` with the Gaussians that its point and clicks describe as ``picked``, and with its clicks reduced
    to their certain hits. Raises ``UserError`` if nothing of the object is above the plane."""
    surface = spec.surface
    assert surface is not None
    solid = scene.is_opaque & (scene.heights > 0.0)
    spec = replace(spec, clicks=tuple(_certain(surface, click) for click in spec.clicks))
    found, shared = _minimum(surface, _seeds(spec, scene.means, solid), scene.plane)
    if not (found & solid).any():
        raise UserError(
            "object: nothing of it lies above the plane around the clicks; click on more of it, mark it with masks, or"
            " give its plane",
            check=("plane",),
        )
    return replace(spec, picked=found, shared_colours=shared)


def object_without_ground(spec: ClicksInPhotos, up: np.ndarray) -> np.ndarray:
    """Return the mask (n,) bool of the Gaussians that the point and the clicks of ``spec`` describe if no ground is
    known: the ground of the energy is far below the capture along ``up`` (3,), so it is no evidence."""
    surface = spec.surface
    assert surface is not None
    spec = replace(spec, clicks=tuple(_certain(surface, click) for click in spec.clicks))
    along = surface.means @ up
    far_below = Plane(up, _FAR * float(np.ptp(along)) - float(along.min()))
    return _minimum(surface, _seeds(spec, surface.means, surface.cloud.visible(MIN_OPACITY)), far_below)[0]


def share_below(spec: ClicksInPhotos, object_mask: np.ndarray, plane: Plane) -> float:
    """Return the share, 0 to 1, of the visible area of the Gaussians ``object_mask`` (n,) bool that is below ``plane``
    by more than a small fraction of their extent. It is nearly 0 on the ground of an object, and larger if the plane
    cuts the object."""
    surface = spec.surface
    assert surface is not None
    heights, area = plane.heights(surface.means[object_mask]), surface.visible_area[object_mask]
    low, high = np.quantile(surface.means[object_mask], [0.01, 0.99], axis=0)
    depth = _UNEVEN * float(np.linalg.norm(high - low))
    return float(area[heights < -depth].sum() / max(area.sum(), 1e-30))


def _seeds(spec: ClicksInPhotos, means: np.ndarray, solid: np.ndarray) -> tuple[Click, ...]:
    """Return the clicks of ``spec``. Without a click on the object, the ``solid`` (n,) bool Gaussians nearest to its
    point represent one."""
    assert spec.point is not None
    if any(click.inside for click in spec.clicks) or not solid.any():
        return spec.clicks
    standing = np.flatnonzero(solid)
    nearest = KDTree(means[standing]).query(spec.point, k=min(_SEED_COUNT, len(standing)))[1]
    return (Click(spec.point, standing[np.ravel(nearest)]), *spec.clicks)


def _certain(surface: SurfaceGraph, click: Click) -> Click:
    """Return a ``click`` on the object without the hits that are much wider than a click, unless all hits are so wide:
    the edge of a Gaussian of the wall behind the object may paint the clicked pixel. A click beside the object is
    unchanged."""
    if not click.inside or not len(click.hits):
        return click
    lengths = np.exp(surface.cloud.log_scales.numpy()[click.hits].max(axis=1))
    widths = lengths / picture_scale(click.point, surface.cameras)
    return replace(click, hits=click.hits[widths <= max(_MAX_WIDTH, float(widths.min()))])


def object_of_clicks(surface: SurfaceGraph, clicks: Sequence[Click], ground: Plane | HeightField) -> np.ndarray:
    """Find the Gaussians of the object that the clicks describe, which are the minimum of the energy of
    ``click_energy``.

    Args:
        surface: the prepared capture.
        clicks: clicks on the object and beside it. The first one on the object defines where the photos show it; later
            ones correct the result. A supervoxel that both kinds hit belongs to the later click.
        ground: the ground, in the frame of the capture.

    Returns:
        (n,) bool, True for the object's Gaussians; all False without a click on the object.
    """
    return _minimum(surface, clicks, ground)[0]


def _minimum(surface: SurfaceGraph, clicks: Sequence[Click], ground: Plane | HeightField) -> tuple[np.ndarray, float]:
    """Return the result of ``object_of_clicks``, and the result of ``shared_colours``."""
    observations = [(np.unique(surface.cluster[click.hits]), click.inside) for click in clicks]
    observations = consistent(observations, surface.count)
    if not observations:
        return np.zeros(len(surface.means), bool), 0.0
    point = next(click.point for click in clicks if click.inside)
    scene = ClickScene.of(surface, ground, picture_scale(point, surface.cameras))
    evidence = scene.evidence(observations)
    inside = minimise(scene, evidence)
    chosen = inside[surface.cluster]
    for click in clicks:
        chosen[click.hits] = evidence.included[surface.cluster[click.hits]]
    return chosen, shared_colours(scene, evidence, inside)
