"""Pinhole camera in OpenCV axes: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """World-to-camera pose ``[rotation | translation]`` and intrinsics in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: np.ndarray
    """(3, 3) float64, world to camera."""
    translation: np.ndarray
    """(3,) float64, world units."""
    near: float = 0.01
    far: float = 1e6

    @property
    def centre(self) -> np.ndarray:
        """(3,) camera centre in the world."""
        return -self.rotation.T @ self.translation

    @classmethod
    def look_at(
        cls,
        eye: np.ndarray,
        target: np.ndarray,
        up: np.ndarray,
        *,
        width: int,
        height: int,
        vertical_fov_degrees: float = 40.0,
        near: float = 0.01,
        far: float = 1e6,
    ) -> Camera:
        """Camera at ``eye`` that looks at ``target`` with ``up`` (not parallel to the view) pointing up in the image."""
        forward = np.asarray(target, float) - np.asarray(eye, float)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, float))
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        focal = 0.5 * height / np.tan(np.radians(vertical_fov_degrees) / 2.0)
        return cls(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=width / 2.0,
            cy=height / 2.0,
            rotation=rotation,
            translation=-rotation @ np.asarray(eye, float),
            near=near,
            far=far,
        )
