"""The plane seen face-on: a window of square texels on it, and pictures of what lies there."""

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

_SEEN_FROM = 40.0
"""Degrees above the plane, from all around: the directions that a floor is looked at from. Straight down, few captures
have seen it."""

_LOOKS = 8
_FINER = 1.5
"""Pixels a texel, of such a look."""
_SMOOTHING = 1.0
"""Texels: of the heights that looks from all around are laid down at."""
_DETAIL = 4.0
"""Texels, standard deviation of a blur: what is finer is detail."""
_BLUR, _AT_ODDS = 2.0, 0.1
"""Texels; of full brightness: where blurred looks differ by more from their median, they see something else."""
_NOTHING = 1e-3
"""Opacity."""

_CAMERA_DISTANCE = 40.0
"""Of the face-on camera, in window sides: far enough that rays are parallel to 1/80, near enough for float32 depth."""


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
        """(n, 2) float64 column and row of ``points`` (n, 3) dropped onto the plane; texel centres are at +0.5."""
        first, second = self.plane.tangents()
        away = np.asarray(points, float) - self.centre
        return np.stack(
            [away @ first / self.texel + 0.5 * self.columns, -(away @ second) / self.texel + 0.5 * self.rows], axis=1
        )

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """(n, 3) points on the plane of (n, 2) columns and rows; the inverse of ``pixels``."""
        first, second = self.plane.tangents()
        x, y = (np.asarray(pixels, float) - [0.5 * self.columns, 0.5 * self.rows]).T * self.texel
        return self.centre + x[:, None] * first - y[:, None] * second

    def sample(self, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(n,) bool: whether ``mask`` (rows, columns) holds where ``points`` (n, 3) drop onto the plane."""
        column, row = np.floor(self.pixels(points)).astype(int).T
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        found = np.zeros(len(column), bool)
        found[inside] = mask[row[inside], column[inside]]
        return found

    def camera(self) -> Camera:
        """The face-on camera whose pixels are the texels."""
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
        """A camera that sees all of the window from the side, from where floors are looked at; ``azimuth`` (radians)
        from the first tangent to the second."""
        first, second = self.plane.tangents()
        elevation = np.radians(_SEEN_FROM)
        level = np.cos(azimuth) * first + np.sin(azimuth) * second
        distance, to_corner = self.camera_distance, np.sqrt(2.0) * self.reach
        side = int(np.ceil(_FINER * 2.0 * to_corner / self.texel))
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
    """What lies on the plane, seen face-on."""

    colour: np.ndarray
    """(rows, columns, 3) float32, 0 to 1; black where nothing lies."""
    alpha: np.ndarray
    """(rows, columns) float32, 0 to 1."""
    height: np.ndarray
    """(rows, columns) float32: of the surface above the plane, scene units; 0 where nothing lies."""


def mean_colours(cloud: GaussianCloud, plane: Plane) -> np.ndarray:
    """(n, 3) float32 colour of each Gaussian, mean over directions from all around the plane, not clipped."""
    first, second = plane.tangents()
    angle = 2.0 * np.pi * np.arange(8)[:, None] / 8
    level = np.cos(angle) * first + np.sin(angle) * second
    elevation = np.radians(_SEEN_FROM)
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
    """The same Gaussians in their mean colours from all directions: SH degree 0."""
    sh = wp.array((mean_colours(cloud, plane)[:, None] - 0.5) / SH_BAND_0, dtype=wp.vec3, device=cloud.device)
    return replace(cloud, sh=sh)


def rectify(cloud: GaussianCloud, window: PlaneWindow, *, thickness: float) -> RectifiedImage:
    """Picture of the Gaussians of ``cloud`` within ``thickness`` (scene units) of the window's plane, face-on.

    How high and how dense the floor is tells a look straight down. Its colours are the mean of looks from all around,
    each laid down at that height, and the detail of one of them, that of middling contrast: from above, where no photo
    was taken, a capture's threads and gaps lie in disorder.
    """
    shape = (window.rows, window.columns)
    chosen = near_plane(cloud, window.plane, thickness)
    if not chosen.any():
        nothing = np.zeros(shape, np.float32)
        return RectifiedImage(np.zeros((*shape, 3), np.float32), nothing, nothing)
    floor = cloud.subset(chosen)
    above = render_gaussians(diffuse_only(floor, window.plane), window.camera(), background=(0.0, 0.0, 0.0))
    alpha = above.alpha.numpy()
    seen = alpha > _NOTHING
    height = np.where(seen, window.camera_distance - above.depth.numpy(), 0.0)
    straight = above.colour.numpy() / np.maximum(alpha, _NOTHING)[..., None]
    colour = np.where(seen[..., None], _from_all_around(floor, window, alpha > 0.5, height, straight), 0.0)
    return RectifiedImage(np.clip(colour, 0.0, 1.0).astype(np.float32), alpha, height.astype(np.float32))


def _from_all_around(
    floor: GaussianCloud, window: PlaneWindow, solid: np.ndarray, height: np.ndarray, otherwise: np.ndarray
) -> np.ndarray:
    """(rows, columns, 3) colour of the ``floor`` at its ``height`` (rows, columns), where it is ``solid`` (rows,
    columns); ``otherwise`` (rows, columns, 3) where no look meets it."""
    share = np.maximum(ndimage.gaussian_filter(solid.astype(float), _SMOOTHING), _NOTHING)
    level = ndimage.gaussian_filter(np.where(solid, height, 0.0), _SMOOTHING) / share
    rows, columns = np.indices(solid.shape)
    places = window.points(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5)
    places += level.reshape(-1, 1) * window.plane.normal
    looks = [_look(floor, window, places, 2.0 * np.pi * number / _LOOKS) for number in range(_LOOKS)]
    colours = [colour / np.maximum(alpha, _NOTHING)[..., None] for colour, alpha in looks]
    # Past an edge some see what lies behind it.
    broad = np.array([ndimage.gaussian_filter(colour, (_BLUR, _BLUR, 0.0)) for colour in colours])
    odds = np.abs(broad - np.median(broad, axis=0)).mean(axis=-1)
    agree = np.exp(-np.square(odds / _AT_ODDS))
    weights = agree * np.array([alpha for _, alpha in looks])
    opacity = weights.sum(axis=0)
    mean = np.einsum("khw,khwc->hwc", weights, np.array(colours)) / np.maximum(opacity, _NOTHING)[..., None]
    # Their mean is blurred, for what lies higher or lower is elsewhere in each.
    details = [_detail(one, alpha * solid) for one, (_, alpha) in zip(colours, looks, strict=True)]
    middling = int(np.argsort([np.square(one).sum() for one in details])[_LOOKS // 2])
    mean += agree[middling][..., None] * (details[middling] - _detail(mean, np.minimum(opacity, 1.0) * solid))
    return np.where((opacity > _NOTHING)[..., None], mean, otherwise)


def _detail(colour: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """(rows, columns, 3): what is finer than ``_DETAIL`` in ``colour`` (rows, columns, 3), where its ``opacity`` (rows,
    columns) is more than a half."""
    dense = opacity > 0.5
    share = np.maximum(ndimage.gaussian_filter(dense.astype(float), _DETAIL), _NOTHING)
    broad = ndimage.gaussian_filter(colour * dense[..., None], (_DETAIL, _DETAIL, 0.0)) / share[..., None]
    return np.where(dense[..., None], colour - broad, 0.0)


def _look(
    floor: GaussianCloud, window: PlaneWindow, places: np.ndarray, azimuth: float
) -> tuple[np.ndarray, np.ndarray]:
    """Colour times opacity (rows, columns, 3) and opacity (rows, columns) of the ``floor`` at ``places`` (rows *
    columns, 3), looked at from ``azimuth``."""
    camera = window.camera_from(azimuth)
    image = render_gaussians(floor, camera, background=(0.0, 0.0, 0.0))
    x, y, z = camera.rotation @ places.T + camera.translation[:, None]
    shape = (window.rows, window.columns)
    u = (camera.fx * x / z + camera.cx - 0.5).reshape(shape).astype(np.float32)
    v = (camera.fy * y / z + camera.cy - 0.5).reshape(shape).astype(np.float32)
    colour: np.ndarray = image.colour.numpy()
    alpha: np.ndarray = image.alpha.numpy()
    return cv2.remap(colour, u, v, cv2.INTER_CUBIC), cv2.remap(alpha, u, v, cv2.INTER_CUBIC)
