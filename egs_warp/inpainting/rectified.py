"""The plane seen face-on: a window of square texels on it, and pictures of what lies there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.inpainting.rectified import mean_colour_kernel
from egs_warp.launching import empty
from egs_warp.render import render
from egs_warp.segmentation.plane_search import near_plane

_SEEN_FROM = 40.0
"""Degrees above the plane, from all around: the directions that a floor is looked at from. Straight down, few captures
have seen it."""

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


def matte(cloud: GaussianCloud, plane: Plane) -> GaussianCloud:
    """The same Gaussians in their mean colours from all directions: SH degree 0."""
    sh = wp.array((mean_colours(cloud, plane)[:, None] - 0.5) / SH_BAND_0, dtype=wp.vec3, device=cloud.device)
    return replace(cloud, sh=sh)


def rectify(cloud: GaussianCloud, window: PlaneWindow, *, thickness: float) -> RectifiedImage:
    """Picture of the Gaussians of ``cloud`` within ``thickness`` (scene units) of the window's plane, face-on, in their
    mean colours from all around."""
    shape = (window.rows, window.columns)
    chosen = near_plane(cloud, window.plane, thickness)
    if not chosen.any():
        nothing = np.zeros(shape, np.float32)
        return RectifiedImage(np.zeros((*shape, 3), np.float32), nothing, nothing)
    image = render(matte(cloud.subset(chosen), window.plane), window.camera(), background=(0.0, 0.0, 0.0))
    alpha = image.alpha.numpy()
    seen = alpha > 1e-3
    colour = np.where(seen[..., None], image.colour.numpy() / np.maximum(alpha, 1e-3)[..., None], 0.0)
    height = np.where(seen, window.camera_distance - image.depth.numpy(), 0.0)
    return RectifiedImage(np.clip(colour, 0.0, 1.0).astype(np.float32), alpha, height.astype(np.float32))
