"""Holes in the floor: under the object's foot, where no view sees the floor, or where the user marks a hole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import depth_inside, distance_to
from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.rectified import PlaneWindow
from egs_warp.io.planes import HoleOutline
from egs_warp.render import render_gaussians
from egs_warp.segmentation.above_plane import CELLS
from egs_warp.segmentation.connectivity import enclosed
from egs_warp.segmentation.object_spec import Segmentation
from egs_warp.segmentation.votes import MaskedView, marked_views

_TEXELS = 256
"""Number of texels along a side of the window on which a hole is drawn."""
_CONTACT = 0.05
"""Height, as a fraction of the object's height, below which a part of the object hides the floor from every side."""
_LOW = 0.08
"""Height, as a fraction of the object's size, below which parts of the object hide the floor under them, or leave it
visible only at grazing angles and smeared."""
_LOW_TEXELS = 200
"""Number of texels along a side of the window of the hole under an object."""
_BRIDGED = 0.1
"""Half of the maximum width of gaps in the footprint that are bridged, as a fraction of the footprint's span."""


@dataclass(frozen=True)
class Hole:
    """A region of a plane, as a mask on a window of the plane."""

    window: PlaneWindow
    mask: np.ndarray
    """(rows, columns) bool, False at the window's edge."""

    def __post_init__(self) -> None:
        if not self.mask.any():
            raise UserError("inpaint: the hole is empty; give the object, a mask, or a point on the plane")

    @property
    def plane(self) -> Plane:
        """The plane with the hole."""
        return self.window.plane

    @property
    def area(self) -> float:
        """Area in scene units squared."""
        return float(self.mask.sum()) * self.window.texel**2

    def bounds(self) -> tuple[np.ndarray, float]:
        """Return the centre (3,) of the bounding square on the plane and the square's side, scene units."""
        rows, columns = np.nonzero(self.mask)
        middle = np.array([[columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]]) / 2.0
        side = max(np.ptp(rows), np.ptp(columns)) + 1
        return self.window.points(middle)[0], float(side) * self.window.texel

    def outline(self) -> HoleOutline:
        """Return the outline for ``plane.json``."""
        outlines, _ = cv2.findContours(self.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        rows, columns = self.mask.shape
        corners = tuple(outline[:, 0] for outline in outlines)
        return HoleOutline(self.window.centre, self.window.texel, (rows, columns), corners)

    @classmethod
    def of_outline(cls, plane: Plane, outline: HoleOutline) -> Hole:
        """Create the hole in ``plane`` from its ``outline``. Raises ``UserError`` if the outline is not valid."""
        rows, columns = outline.texels
        try:
            mask = np.zeros((rows, columns), np.uint8)
            for corners in outline.outlines:
                cv2.fillPoly(mask, [corners], (1,))
        except (ValueError, cv2.error) as error:
            raise UserError("plane.json: its hole is not valid; write the file again with egs-warp segment") from error
        return cls(PlaneWindow(plane, outline.centre, outline.texel, rows, columns), mask > 0)

    def drawn_on(self, window: PlaneWindow) -> np.ndarray:
        """Return the hole, resampled as a mask (rows, columns) bool on another window of the same plane."""
        columns, rows = np.meshgrid(np.arange(window.columns) + 0.5, np.arange(window.rows) + 0.5)
        places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1))
        at = self.window.pixels(places) - 0.5
        values = ndimage.map_coordinates(self.mask.astype(np.float32), at[:, ::-1].T, order=1, mode="constant")
        return (values > 0.5).reshape(window.rows, window.columns)


def disc(plane: Plane, centre: np.ndarray, radius: float) -> Hole:
    """Return a round hole around ``centre`` (3,), projected onto the plane.

    Raises ``UserError`` unless the radius is positive.
    """
    if not (np.isfinite(radius) and radius > 0.0 and np.isfinite(centre).all()):
        raise UserError(
            f"inpaint: the hole has the radius {radius:g} and the centre {','.join(f'{x:g}' for x in centre)}; give a"
            " positive radius and a finite centre"
        )
    window = _window(plane, np.asarray(centre, float), 2.0 * radius)
    columns, rows = np.meshgrid(np.arange(_TEXELS) + 0.5, np.arange(_TEXELS) + 0.5)
    return Hole(window, np.hypot(columns - 0.5 * _TEXELS, rows - 0.5 * _TEXELS) * window.texel < radius)


def footprint(object_cloud: GaussianCloud, plane: Plane) -> Hole:
    """Return the part of the plane that an object standing on it hides from every side.

    It is the outline of the object's lowest part, seen from above, with the regions that this part encloses. Raises
    ``UserError`` if the object does not reach down to the plane.
    """
    means, opacity = object_cloud.means.numpy(), object_cloud.opacities()
    heights = plane.heights(means)
    solid = opacity > 0.3
    if not solid.any():
        raise UserError("inpaint: the object has no opaque Gaussian; give another object, a mask, or a point")
    top = float(np.quantile(heights[solid], 0.99))
    low = solid & (heights < _CONTACT * top) & (heights > -0.5 * top)
    if top <= 0.0 or not low.any():
        raise UserError(
            f"inpaint: the object does not touch the plane (lowest part at {heights[solid].min():.3g}, highest at"
            f" {top:.3g} scene units above it); check the plane"
        )
    middle = 0.5 * (means[low].min(axis=0) + means[low].max(axis=0))
    # Splats extend beyond their means.
    margin = 3.0 * float(np.exp(np.quantile(np.max(object_cloud.log_scales.numpy()[low], axis=1), 0.9)))
    first, second = plane.tangents()
    span = max(np.ptp(means[low] @ first), np.ptp(means[low] @ second)) + 2.0 * margin
    window = _window(plane, middle, float(span))
    above = render_gaussians(object_cloud.subset(low), window.camera())
    covered = np.pad(above.alpha.numpy() > 0.5, _TEXELS // 2)
    # Separate feet stay separate holes, but the hole of a sole is closed: no view shows its Gaussians, so they are
    # sparse.
    reach = _BRIDGED * _TEXELS
    wide = distance_to(covered) <= reach
    closed = (depth_inside(wide) > reach) | covered
    inner = (slice(_TEXELS // 2, -(_TEXELS // 2)),) * 2
    return Hole(window, np.asarray(ndimage.binary_fill_holes(closed))[inner])


def hole_under(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> Hole | None:
    """Return the hole under an object: the outline of its low part and of the buried Gaussians. None for an object that
    hangs above the floor."""
    means = cloud.means.numpy().astype(np.float64)
    low = segmentation.buried_mask | (segmentation.object_mask & (plane.heights(means) < _LOW * segmentation.size))
    if not low.any():
        return None
    middle = 0.5 * (means[low].min(axis=0) + means[low].max(axis=0))
    tangents = np.stack(plane.tangents(), axis=1)
    flat = means[low] @ tangents
    texel = 1.2 * float(np.ptp(flat, axis=0).max()) / _LOW_TEXELS
    window = PlaneWindow(plane, middle - plane.heights(middle) * plane.normal, texel, _LOW_TEXELS, _LOW_TEXELS)
    columns, rows = np.meshgrid(np.arange(_LOW_TEXELS) + 0.5, np.arange(_LOW_TEXELS) + 0.5)
    places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1))
    inside = enclosed(places @ tangents, flat, segmentation.size / CELLS)
    return Hole(window, inside.reshape(_LOW_TEXELS, _LOW_TEXELS))


def unseen(plane: Plane, views: Sequence[MaskedView]) -> Hole:
    """Return the part of the floor that the object hides in every view that would otherwise show it. A point is part of
    the hole only if more than half of the views contain it.

    Raises ``UserError`` if masks do not fit their cameras, all are empty, or they hide no common floor.
    """
    views = marked_views(views)
    shadows = [_on_plane(plane, view.camera, view.mask) for view in views]
    if any(len(shadow) == 0 for shadow in shadows):
        raise UserError("inpaint: no pixel of a mask shows the plane, so the hole is not on it; check the plane")
    # The common floor lies within the bounds of every view's hidden region; the smallest region gives the finest
    # window.
    smallest = min(shadows, key=lambda shadow: float(np.ptp(shadow, axis=0).max()))
    middle = 0.5 * (smallest.min(axis=0) + smallest.max(axis=0))
    first, second = plane.tangents()
    window = _window(plane, middle, float(max(np.ptp(smallest @ first), np.ptp(smallest @ second))))
    columns, rows = np.meshgrid(np.arange(_TEXELS) + 0.5, np.arange(_TEXELS) + 0.5)
    places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1))
    hidden, looks = np.ones(len(places), bool), np.zeros(len(places), int)
    for view in views:
        camera, mask = view.camera, view.mask
        seen = places @ camera.rotation.T + camera.translation
        ahead = seen[:, 2] > camera.near
        depth = np.where(ahead, seen[:, 2], 1.0)
        column = np.floor(camera.fx * seen[:, 0] / depth + camera.cx).astype(int)
        row = np.floor(camera.fy * seen[:, 1] / depth + camera.cy).astype(int)
        inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        hidden[inside] &= mask[row[inside], column[inside]]
        looks += inside
    common = (hidden & (2 * looks > len(views))).reshape(_TEXELS, _TEXELS)
    if not common.any():
        raise UserError(
            "inpaint: the masks hide no floor in common; check the plane, and that all masks show the same object"
        )
    return Hole(window, common)


def _on_plane(plane: Plane, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Return (n, 3) points where the rays through the pixels of ``mask`` meet the plane; rays that miss the plane are
    left out."""
    rays = camera_rays(camera)[mask]
    slope = rays @ plane.normal
    height = float(plane.heights(camera.centre))
    meets = slope * height < 0.0
    return camera.centre - (height / slope[meets])[:, None] * rays[meets]


def _window(plane: Plane, middle: np.ndarray, span: float) -> PlaneWindow:
    centre = middle - float(plane.heights(middle)) * plane.normal
    # Leave a margin of a few texels on every side.
    return PlaneWindow(plane, centre, span / (_TEXELS - 16), _TEXELS, _TEXELS)
