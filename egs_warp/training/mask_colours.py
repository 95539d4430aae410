"""Detection of the colour of the object in masks of photos: most tools draw it in white, some in black."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Lens
from egs_warp.io.limits import MAX_PIXELS
from egs_warp.io.photos import MAX_MASK_RATIO, at_size, read_mask_file
from egs_warp.io.posed_images import PosedImage
from egs_warp.training.initial_cloud import middle_of

_MIN_MASKS = 4
_MAX_MASKS = 24
"""Number of evenly spaced masks that are evaluated."""
_SIDE = 64
"""Longer side to which masks are reduced, pixels."""
_MIN_RIM = 0.85
"""Minimum mean fraction of white pixels along the border of the masks for the white region to be the surroundings."""
_AREA = (0.01, 0.6)
"""Range of the mean fraction of black pixels for masks that show the object in black."""
_POINTS = 40_000
_MIN_SEEN, _MIN_BLACK = 0.8, 0.95
"""Two fractions of the cameras: a point of the hull is seen by at least the first fraction of all cameras, and is black
in at least the second fraction of the cameras that see it."""
_MIN_COVERED = 0.7
"""Minimum fraction of the black pixels that the hull must cover."""


def is_object_black(images: Sequence[PosedImage]) -> bool:
    """Return True if there is clear evidence that the masks of ``images`` show the object in black: the surroundings
    along the borders are white, and the black regions are the silhouettes of one body that all cameras see.

    Black regions that move from photo to photo, such as masked-out people, are not silhouettes of one body.
    """
    masked = [one for one in images if one.mask is not None]
    if len(masked) < _MIN_MASKS:
        return False
    chosen = np.unique(np.linspace(0, len(masked) - 1, _MAX_MASKS).round().astype(int))
    views = [view for number in chosen if (view := _MaskView.of(masked[number])) is not None]
    if len(views) < _MIN_MASKS or np.mean([view.white_rim for view in views]) < _MIN_RIM:
        return False
    if not _AREA[0] < np.mean([view.black.mean() for view in views]) < _AREA[1]:
        return False
    cameras = [view.camera for view in views]
    focus = middle_of(cameras)
    distance = float(np.median([np.linalg.norm(camera.centre - focus) for camera in cameras]))
    random = np.random.default_rng(0)
    hull = _hull(views, random.uniform(focus - distance, focus + distance, (_POINTS, 3)))
    if len(hull) == 0:
        return False
    # Sample again around the body, because it may fill only a small part of the cameras' common view.
    margin = 2.0 * distance / _POINTS ** (1 / 3)
    hull = _hull(views, random.uniform(hull.min(axis=0) - margin, hull.max(axis=0) + margin, (_POINTS, 3)))
    return float(np.median([view.covered_by(hull) for view in views])) >= _MIN_COVERED


@dataclass(frozen=True)
class _MaskView:
    """A downscaled mask and its camera."""

    camera: Camera
    """Camera at the size of the reduced mask."""
    lens: Lens | None
    black: np.ndarray
    """(H, W) bool, True for black pixels."""

    @classmethod
    def of(cls, one: PosedImage) -> _MaskView | None:
        """Read the mask of ``one``; return None if the mask is unreadable or has the wrong orientation."""
        assert one.mask is not None
        try:
            limit = MAX_MASK_RATIO * one.camera.width * one.camera.height
            mask = read_mask_file(one.mask, at_most=min(limit, MAX_PIXELS))
        except UserError:
            return None
        factor = _SIDE / max(one.camera.width, one.camera.height)
        width, height = (max(1, round(side * factor)) for side in (one.camera.width, one.camera.height))
        if (mask.shape[1] > mask.shape[0]) != (width > height):
            return None
        black = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA) < 0.5
        return cls(at_size(one.camera, width, height), one.lens, black)

    @property
    def white_rim(self) -> float:
        """Fraction of white pixels along the border."""
        rim = np.concatenate([self.black[0], self.black[-1], self.black[:, 0], self.black[:, -1]])
        return float(1.0 - rim.mean())

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the row and column (2, n) of ``points`` (n, 3), and the mask (n,) bool of points that are in the
        picture."""
        camera = self.camera
        seen = points @ camera.rotation.T + camera.translation
        ahead = seen[:, 2] > camera.near
        plane = seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None]
        if self.lens is not None:
            plane = self.lens.distorted(plane)
        column, row = np.floor(plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]).T
        inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        return np.where(inside, [row, column], 0).astype(int), inside

    def covered_by(self, hull: np.ndarray) -> float:
        """Return the fraction of the black pixels onto or next to which points of ``hull`` (n, 3) are projected."""
        if not self.black.any() or len(hull) == 0:
            return 0.0
        (rows, columns), inside = self.pixels(hull)
        covered = np.zeros(self.black.shape, np.uint8)
        covered[rows[inside], columns[inside]] = 1
        covered = cv2.dilate(covered, np.ones((3, 3), np.uint8)) > 0
        return float(covered[self.black].mean())


def _hull(views: Sequence[_MaskView], points: np.ndarray) -> np.ndarray:
    """Return those ``points`` (n, 3) that nearly all views see, and show in black."""
    seen, black = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        (rows, columns), inside = view.pixels(points)
        seen += inside
        black += inside & view.black[rows, columns]
    return points[(seen >= _MIN_SEEN * len(views)) & (black >= _MIN_BLACK * seen)]
