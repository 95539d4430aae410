"""What is behind the moving object: a plain floor with a grid, or a captured scene;
and the object's soft shadow on it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.render.rasteriser import render_gaussians

_SKY = np.array([1.0, 1.0, 1.0], np.float32)
_FLOOR = np.array([0.86, 0.86, 0.87], np.float32)
_LINE = np.array([0.74, 0.75, 0.78], np.float32)
_SHADOW_TEXELS = 192
_SHADOW_LAYERS = ((0.0, 0.08, 0.02), (0.08, 0.3, 0.06), (0.3, 2.0, 0.13))
"""From and to this height over the plane, and the width of the blur, all in body heights."""


_BUMP = 0.06
"""Of the shadow's reach: what is this high above the plane still takes its shadow, at half strength; of what lies below
it, twice as deep, for through thin spots of a floor one sees deeper."""
_SOFTENED = 0.25
"""Of the window of the median: blur of the edge of what takes the shadow."""


class Behind(Protocol):
    """What an animation is drawn over."""

    def background(self, body: GaussianCloud, *, height: float) -> np.ndarray:
        """(H, W, 3) float32: what is seen behind ``body``, with its shadow; ``height`` is the body's, world units."""
        ...


class ContactShadow:
    """The soft shadow that Gaussians cast straight down on a plane, as one camera sees it."""

    def __init__(
        self, camera: Camera, plane: Plane, *, centre: np.ndarray, reach: float, depth: np.ndarray | None = None
    ) -> None:
        """``centre`` (3,) and ``reach`` (world units) bound the part of the plane that can be in shadow; ``depth`` (H,
        W) is the z-depth of the uneven ground that it falls on, 0 where that is the plane."""
        self._plane, self._centre, self._reach = plane, centre, reach
        self._tangents = np.stack(plane.tangents())
        rays = camera_rays(camera)
        slope = rays @ plane.normal
        self.depth = -float(plane.heights(camera.centre)) / np.where(np.abs(slope) > 1e-9, slope, np.inf)
        """(H, W) z-depth of the plane; meaningful where ``hit``."""
        self.hit = (self.depth > 0.0) & (slope < 0.0)
        """(H, W) bool: the pixel's ray meets the plane from above."""
        points = camera.centre + np.where(self.hit, self.depth, 0.0)[..., None] * rays
        self.flat = (points - centre) @ self._tangents.T
        """(H, W, 2) place on the plane, world units from the centre."""
        self.fade = np.clip(1.6 - 1.6 * np.linalg.norm(self.flat, axis=-1) / reach, 0.0, 1.0)
        """(H, W) 1 around the centre, 0 from ``reach`` on."""
        seen = np.zeros_like(self.depth) if depth is None else depth
        ground = np.where((seen > 0.0)[..., None], camera.centre + seen[..., None] * rays, points)
        self.lift = plane.heights(ground)
        """(H, W) height of the ground over the plane, world units."""
        sine = np.maximum(-slope / np.linalg.norm(rays, axis=-1), 0.05)
        self.pixel = np.maximum(self.depth / camera.fx / sine, 1e-9)
        """(H, W) size of a pixel on the plane, world units."""
        under = (ground - centre) @ self._tangents.T
        self._uv = ((under / reach + 1.0) * 0.5 * _SHADOW_TEXELS - 0.5).astype(np.float32)

    def darkness(self, body: GaussianCloud, *, height: float) -> np.ndarray:
        """(H, W) float32, 0 to about 0.5: how much light the Gaussians of ``body`` take from the plane.

        Each hides as much of it as its opacity and its broad side say. Shadows of high ones are wider and paler.
        ``height`` is the body's, world units.
        """
        import cv2

        means = body.means.numpy()
        scales = np.sort(np.exp(body.log_scales.numpy()), axis=1)
        texel = 2.0 * self._reach / _SHADOW_TEXELS
        hidden = body.opacities() * 2.0 * np.pi * scales[:, 1] * scales[:, 2] / texel**2
        width = float(np.median(scales[:, 1])) / texel
        flat = ((means - self._centre) @ self._tangents.T / self._reach + 1.0) * 0.5 * _SHADOW_TEXELS
        above = np.maximum(self._plane.heights(means), 0.0)
        shade = np.zeros((_SHADOW_TEXELS, _SHADOW_TEXELS), np.float32)
        for low, high, blur in _SHADOW_LAYERS:
            chosen = (above >= low * height) & (above < high * height)
            if not chosen.any():
                continue
            layer, _, _ = np.histogram2d(
                flat[chosen, 1],
                flat[chosen, 0],
                bins=_SHADOW_TEXELS,
                range=((0, _SHADOW_TEXELS), (0, _SHADOW_TEXELS)),
                weights=hidden[chosen],
            )
            covered = 1.0 - np.exp(-cv2.GaussianBlur(layer.astype(np.float32), (0, 0), max(width, 0.6)))
            sigma = max(blur * height / texel, 0.6)
            # Far layers see more of the sky past the object, so they darken less.
            shade = np.maximum(shade, cv2.GaussianBlur(covered, (0, 0), sigma) * (0.5 - 1.4 * blur))
        return cv2.remap(
            shade, self._uv[..., 0], self._uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )


class Floor:
    """A pale plane with a grid."""

    def __init__(
        self, camera: Camera, plane: Plane, *, centre: np.ndarray, reach: float, cell: float, shadow: bool = True
    ) -> None:
        """``centre`` (3,) and ``reach`` (world units) bound the part that shows; ``cell`` is the grid's spacing."""
        self._shadow = ContactShadow(camera, plane, centre=centre, reach=reach)
        self._strength = 1.0 if shadow else 0.0
        flat = self._shadow.flat
        distance = np.abs((flat / cell + 0.5) % 1.0 - 0.5) * cell
        line = np.clip(1.0 - distance / (1.2 * self._shadow.pixel[..., None]), 0.0, 1.0).max(axis=-1)
        colour = _FLOOR + line[..., None] * (_LINE - _FLOOR)
        self._fade = (self._shadow.fade * self._shadow.hit).astype(np.float32)[..., None]
        self._bare = (_SKY + self._fade * (colour - _SKY)).astype(np.float32)

    def background(self, body: GaussianCloud, *, height: float) -> np.ndarray:
        """See ``Behind``."""
        if self._strength == 0.0:
            return self._bare
        darkness = self._shadow.darkness(body, height=height)
        return self._bare * (1.0 - darkness[..., None] * self._fade)


class PlainColour:
    """One colour, on which only the shadow falls; black with ``cover`` is a shadow to be laid over something else."""

    def __init__(
        self,
        colour: tuple[float, float, float],
        camera: Camera,
        plane: Plane,
        *,
        centre: np.ndarray,
        reach: float,
        shadow: bool = True,
    ) -> None:
        """``centre`` (3,) and ``reach`` (world units) bound the shadow."""
        self._shadow = ContactShadow(camera, plane, centre=centre, reach=reach)
        self._fade = (self._shadow.fade * self._shadow.hit).astype(np.float32) * (1.0 if shadow else 0.0)
        self._colour = np.asarray(colour, np.float32)

    def cover(self, body: GaussianCloud, *, height: float) -> np.ndarray:
        """(H, W) float32, 0 to about 0.5: how much of what is behind the shadow hides."""
        if not self._fade.any():
            return self._fade
        return self._shadow.darkness(body, height=height) * self._fade

    def background(self, body: GaussianCloud, *, height: float) -> np.ndarray:
        """See ``Behind``."""
        return self._colour * (1.0 - self.cover(body, height=height)[..., None])


class CapturedScene:
    """The rest of a capture, rendered once; the shadow falls where the plane is what one sees."""

    def __init__(
        self,
        scene: GaussianCloud,
        camera: Camera,
        plane: Plane,
        *,
        centre: np.ndarray,
        reach: float,
        shadow: bool = True,
    ) -> None:
        """``scene`` in the world's units; ``centre`` (3,) and ``reach`` bound the shadow."""
        import cv2

        image = render_gaussians(scene, camera)
        self._image = np.clip(image.colour.numpy(), 0.0, 1.0)
        depth = np.where(image.alpha.numpy() > 0.5, image.depth.numpy(), 0.0).astype(np.float32)
        depth = cv2.medianBlur(depth, 5)
        self._shadow = ContactShadow(camera, plane, centre=centre, reach=reach, depth=depth)
        lift = self._shadow.lift / (_BUMP * reach)
        on_plane = np.clip(1.5 - np.where(lift > 0.0, lift, -0.5 * lift), 0.0, 1.0) * self._shadow.hit
        # Specks in the air before the floor would shine in the shadow, and hard edges look cut out.
        kernel = 2 * (max(camera.width, camera.height) // 40) + 1
        on_plane = np.asarray(cv2.medianBlur(np.rint(255.0 * on_plane).astype(np.uint8), kernel), np.float64) / 255.0
        on_plane = cv2.GaussianBlur(on_plane, (0, 0), _SOFTENED * kernel)
        strength = on_plane * self._shadow.fade * image.alpha.numpy() if shadow else np.zeros_like(on_plane)
        self._fade = strength.astype(np.float32)[..., None]

    def background(self, body: GaussianCloud, *, height: float) -> np.ndarray:
        """See ``Behind``."""
        if not self._fade.any():
            return self._image
        darkness = self._shadow.darkness(body, height=height)
        return self._image * (1.0 - darkness[..., None] * self._fade)
