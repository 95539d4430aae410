"""Face-on views of the plane: a window of square texels on the plane, and pictures of the surface in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import warp as wp
from scipy import ndimage

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.inpainting.rectified import mean_colour_kernel
from egs_warp.launching import empty
from egs_warp.render import render_gaussians
from egs_warp.segmentation.plane_search import near_plane

_ELEVATION_DEGREES = 40.0
"""Elevation above the plane, degrees, of the side views. Photos usually show floors from about this elevation, and
hardly ever from straight above."""

_SIDE_VIEWS = 8
_PIXELS_PER_TEXEL = 1.5
"""Pixels per texel of a side view."""
_SMOOTHING = 1.0
"""Standard deviation, in texels, of the blur of the height map onto which the side views are projected."""
_DETAIL = 4.0
"""Standard deviation, in texels, of a blur; structure that it removes is detail."""
_BLUR, _MAX_DISAGREEMENT = 2.0, 0.1
"""Standard deviation of a blur in texels, and a fraction of full brightness. Where a blurred view differs from the
median of all views by more than this fraction, it probably does not show the floor."""
_MIN_ALPHA = 1e-3
"""Opacity below which a pixel is empty."""

_CAMERA_DISTANCE = 40.0
"""Distance of the face-on camera, as a multiple of the window's side: large enough that rays deviate from the normal by
at most about 1/80 rad, small enough for float32 depth."""


@dataclass(frozen=True)
class PlaneWindow:
    """A rectangle of square texels on a plane, seen from the side that the normal points to.

    Columns run along ``plane.tangents()[0]``, rows against ``plane.tangents()[1]``.
    """

    plane: Plane
    centre: np.ndarray
    """(3,) float64, middle of the window, on the plane."""
    texel: float
    """Side of a texel, scene units."""
    rows: int
    columns: int

    @property
    def reach(self) -> float:
        """Half of the longer side, scene units."""
        return 0.5 * self.texel * max(self.rows, self.columns)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return the column and row (n, 2) float64 of ``points`` (n, 3) projected onto the plane; texel centres are at
        +0.5."""
        first, second = self.plane.tangents()
        away = np.asarray(points, float) - self.centre
        return np.stack(
            [away @ first / self.texel + 0.5 * self.columns, -(away @ second) / self.texel + 0.5 * self.rows], axis=1
        )

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """Return the points (n, 3) on the plane at columns and rows (n, 2); this is the inverse of the method
        ``pixels``."""
        first, second = self.plane.tangents()
        x, y = (np.asarray(pixels, float) - [0.5 * self.columns, 0.5 * self.rows]).T * self.texel
        return self.centre + x[:, None] * first - y[:, None] * second

    def sample(self, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the values (n,) bool of ``mask`` (rows, columns) at ``points`` (n, 3) projected onto the plane; False
        outside the window."""
        column, row = np.floor(self.pixels(points)).astype(int).T
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        values = np.zeros(len(column), bool)
        values[inside] = mask[row[inside], column[inside]]
        return values

    def camera(self) -> Camera:
        """Return the face-on camera whose pixels are the texels."""
        first, second = self.plane.tangents()
        rotation = np.stack([first, -second, -self.plane.normal])
        distance = self.camera_distance
        focal = distance / self.texel
        return Camera(
            width=self.columns,
            height=self.rows,
            fx=focal,
            fy=focal,
            cx=0.5 * self.columns,
            cy=0.5 * self.rows,
            rotation=rotation,
            translation=-rotation @ (self.centre + distance * self.plane.normal),
            near=0.5 * distance,
        )

    def camera_from(self, azimuth: float) -> Camera:
        """Return a camera that sees the whole window from the side.

        Args:
            azimuth: rad, from the first tangent to the second.
        """
        first, second = self.plane.tangents()
        elevation = np.radians(_ELEVATION_DEGREES)
        level = np.cos(azimuth) * first + np.sin(azimuth) * second
        distance, to_corner = self.camera_distance, np.sqrt(2.0) * self.reach
        side = int(np.ceil(_PIXELS_PER_TEXEL * 2.0 * to_corner / self.texel))
        return Camera.look_at(
            self.centre + distance * (np.cos(elevation) * level + np.sin(elevation) * self.plane.normal),
            self.centre,
            self.plane.normal,
            width=side,
            height=side,
            vertical_fov_degrees=float(np.degrees(2.0 * np.arctan(to_corner / distance))),
            near=0.5 * distance,
        )

    @property
    def camera_distance(self) -> float:
        """Height of the face-on camera above the plane, scene units."""
        return 2.0 * self.reach * _CAMERA_DISTANCE


@dataclass(frozen=True)
class RectifiedImage:
    """Face-on picture of what lies on the plane."""

    colour: np.ndarray
    """(rows, columns, 3) float32, 0 to 1; black where it is empty."""
    alpha: np.ndarray
    """(rows, columns) float32, opacity, 0 to 1."""
    height: np.ndarray
    """(rows, columns) float32, height of the surface above the plane, scene units; 0 where it is empty."""


def mean_colours(cloud: GaussianCloud, plane: Plane) -> np.ndarray:
    """Return the colour (n, 3) float32 of each Gaussian, averaged over directions from all around the plane and not
    clipped."""
    first, second = plane.tangents()
    angle = 2.0 * np.pi * np.arange(8)[:, None] / 8
    level = np.cos(angle) * first + np.sin(angle) * second
    elevation = np.radians(_ELEVATION_DEGREES)
    directions = -(np.cos(elevation) * level + np.sin(elevation) * plane.normal)
    colours = empty(cloud.count, wp.vec3, cloud.device)
    wp.launch(
        mean_colour_kernel,
        dim=cloud.count,
        inputs=[cloud.sh, wp.array(directions.astype(np.float32), dtype=wp.vec3, device=cloud.device)],
        outputs=[colours],
        device=cloud.device,
    )
    return colours.numpy()


def diffuse_only(cloud: GaussianCloud, plane: Plane) -> GaussianCloud:
    """Return the same Gaussians with their mean colours over all directions: SH degree 0."""
    sh = wp.array((mean_colours(cloud, plane)[:, None] - 0.5) / SH_BAND_0, dtype=wp.vec3, device=cloud.device)
    return replace(cloud, sh=sh)


def rectify(cloud: GaussianCloud, window: PlaneWindow, *, thickness: float) -> RectifiedImage:
    """Render the Gaussians of ``cloud`` within ``thickness`` (scene units) of the window's plane, face-on.

    Height and opacity come from a view straight down. The colour is the mean of side views, each projected onto the
    surface at that height, plus the detail of the side view with median contrast. The view straight down is not used
    for colour, because photos are hardly ever taken from there; in it, a capture shows disordered threads and gaps.
    """
    shape = (window.rows, window.columns)
    chosen = near_plane(cloud, window.plane, thickness)
    if not chosen.any():
        nothing = np.zeros(shape, np.float32)
        return RectifiedImage(np.zeros((*shape, 3), np.float32), nothing, nothing)
    floor = cloud.subset(chosen)
    above = render_gaussians(diffuse_only(floor, window.plane), window.camera(), background=(0.0, 0.0, 0.0))
    alpha = above.alpha.numpy()
    seen = alpha > _MIN_ALPHA
    height = np.where(seen, window.camera_distance - above.depth.numpy(), 0.0)
    straight = above.colour.numpy() / np.maximum(alpha, _MIN_ALPHA)[..., None]
    colour = np.where(seen[..., None], _from_all_around(floor, window, alpha > 0.5, height, straight), 0.0)
    return RectifiedImage(np.clip(colour, 0.0, 1.0).astype(np.float32), alpha, height.astype(np.float32))


def _from_all_around(
    floor: GaussianCloud, window: PlaneWindow, solid: np.ndarray, height: np.ndarray, otherwise: np.ndarray
) -> np.ndarray:
    """Return the colour (rows, columns, 3) of the ``floor`` in side views.

    Args:
        floor: Gaussians of the floor.
        window: the window on the plane.
        solid: (rows, columns) bool, texels at which the floor is opaque.
        height: (rows, columns) height of the floor.
        otherwise: (rows, columns, 3) colour where no view shows the floor.
    """
    share = np.maximum(ndimage.gaussian_filter(solid.astype(float), _SMOOTHING), _MIN_ALPHA)
    level = ndimage.gaussian_filter(np.where(solid, height, 0.0), _SMOOTHING) / share
    rows, columns = np.indices(solid.shape)
    places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5)
    places += level.reshape(-1, 1) * window.plane.normal
    views = [_side_view(floor, window, places, 2.0 * np.pi * number / _SIDE_VIEWS) for number in range(_SIDE_VIEWS)]
    colours = [colour / np.maximum(alpha, _MIN_ALPHA)[..., None] for colour, alpha in views]
    # Outside the floor's edge, some views show what lies behind the floor.
    broad = np.array([ndimage.gaussian_filter(colour, (_BLUR, _BLUR, 0.0)) for colour in colours])
    odds = np.abs(broad - np.median(broad, axis=0)).mean(axis=-1)
    agree = np.exp(-np.square(odds / _MAX_DISAGREEMENT))
    weights = agree * np.array([alpha for _, alpha in views])
    opacity = weights.sum(axis=0)
    mean = np.einsum("khw,khwc->hwc", weights, np.array(colours)) / np.maximum(opacity, _MIN_ALPHA)[..., None]
    # Blur the mean, because points above or below the smoothed surface are displaced differently in each view.
    details = [_detail(one, alpha * solid) for one, (_, alpha) in zip(colours, views, strict=True)]
    middling = int(np.argsort([np.square(one).sum() for one in details])[_SIDE_VIEWS // 2])
    mean += agree[middling][..., None] * (details[middling] - _detail(mean, np.minimum(opacity, 1.0) * solid))
    return np.where((opacity > _MIN_ALPHA)[..., None], mean, otherwise)


def _detail(colour: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Return (rows, columns, 3) structure finer than ``_DETAIL`` in ``colour`` (rows, columns, 3), where its
    ``opacity`` (rows, columns) is above one half."""
    dense = opacity > 0.5
    share = np.maximum(ndimage.gaussian_filter(dense.astype(float), _DETAIL), _MIN_ALPHA)
    broad = ndimage.gaussian_filter(colour * dense[..., None], (_DETAIL, _DETAIL, 0.0)) / share[..., None]
    return np.where(dense[..., None], colour - broad, 0.0)


def _side_view(
    floor: GaussianCloud, window: PlaneWindow, places: np.ndarray, azimuth: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return colour times opacity (rows, columns, 3) and opacity (rows, columns) of the ``floor`` at ``places`` (rows *
    columns, 3), seen from ``azimuth``, rad."""
    camera = window.camera_from(azimuth)
    image = render_gaussians(floor, camera, background=(0.0, 0.0, 0.0))
    x, y, z = camera.rotation @ places.T + camera.translation[:, None]
    shape = (window.rows, window.columns)
    u = (camera.fx * x / z + camera.cx - 0.5).reshape(shape).astype(np.float32)
    v = (camera.fy * y / z + camera.cy - 0.5).reshape(shape).astype(np.float32)
    colour: np.ndarray = image.colour.numpy()
    alpha: np.ndarray = image.alpha.numpy()
    return cv2.remap(colour, u, v, cv2.INTER_CUBIC), cv2.remap(alpha, u, v, cv2.INTER_CUBIC)
