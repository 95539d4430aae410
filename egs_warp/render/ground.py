"""A plain floor behind the object: a pale plane with a grid, and the soft shadow that the Gaussians cast straight down on it."""

from __future__ import annotations

import numpy as np

from egs_warp.camera import Camera
from egs_warp.plane import Plane

_SKY = np.array([1.0, 1.0, 1.0], np.float32)
_FLOOR = np.array([0.86, 0.86, 0.87], np.float32)
_LINE = np.array([0.74, 0.75, 0.78], np.float32)


class Floor:
    """The floor as one camera sees it; ``background`` draws it with the shadow of one frame."""

    def __init__(self, camera: Camera, plane: Plane, *, centre: np.ndarray, reach: float, cell: float) -> None:
        """``centre`` (3,) and ``reach`` (world units) bound the part that shows; ``cell`` is the grid's spacing."""
        self._plane, self._centre, self._reach = plane, centre, reach
        self._tangents = np.stack(plane.tangents())
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        rays = rays @ camera.rotation
        slope = rays @ plane.normal
        depth = -(plane.normal @ camera.centre + plane.offset) / np.where(np.abs(slope) > 1e-9, slope, np.inf)
        hit = (depth > 0.0) & (slope < 0.0)
        points = camera.centre + np.where(hit, depth, 0.0)[..., None] * rays
        flat = (points - centre) @ self._tangents.T
        self._uv = ((flat / reach + 1.0) * 0.5).astype(np.float32)
        fade = np.clip(1.6 - 1.6 * np.linalg.norm(flat, axis=-1) / reach, 0.0, 1.0) * hit
        pixel = np.maximum(depth / camera.fx / np.maximum(-slope / np.linalg.norm(rays, axis=-1), 0.05), 1e-9)
        distance = np.abs((flat / cell + 0.5) % 1.0 - 0.5) * cell
        line = np.clip(1.0 - distance / (1.2 * pixel[..., None]), 0.0, 1.0).max(axis=-1)
        colour = _FLOOR + line[..., None] * (_LINE - _FLOOR)
        self._fade = fade.astype(np.float32)[..., None]
        self._bare = (_SKY + self._fade * (colour - _SKY)).astype(np.float32)

    def background(
        self, means: np.ndarray, opacities: np.ndarray, *, height: float, resolution: int = 192
    ) -> np.ndarray:
        """(H, W, 3) float32: the floor under Gaussians with ``means`` (n, 3); shadows of high ones are wider and paler.

        ``height`` is the body's, world units.
        """
        import cv2

        flat = ((means - self._centre) @ self._tangents.T / self._reach + 1.0) * 0.5 * resolution
        above = np.maximum(self._plane.heights(means), 0.0)
        shade = np.zeros((resolution, resolution), np.float32)
        for low, high, blur in ((0.0, 0.08, 0.02), (0.08, 0.3, 0.06), (0.3, 2.0, 0.13)):
            chosen = (above >= low * height) & (above < high * height)
            if not chosen.any():
                continue
            layer, _, _ = np.histogram2d(
                flat[chosen, 1],
                flat[chosen, 0],
                bins=resolution,
                range=((0, resolution), (0, resolution)),
                weights=opacities[chosen],
            )
            covered = 1.0 - np.exp(-layer.astype(np.float32))
            sigma = max(blur * height / self._reach * 0.5 * resolution, 0.6)
            # Far layers see more of the sky past the object, so they darken less.
            shade = np.maximum(shade, cv2.GaussianBlur(covered, (0, 0), sigma) * (0.5 - 1.4 * blur))
        sampled = cv2.remap(
            shade,
            self._uv[..., 0] * resolution - 0.5,
            self._uv[..., 1] * resolution - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        return self._bare * (1.0 - sampled[..., None] * self._fade)
