"""Initial cloud for training from photos: Gaussians where the colours of the photos agree.

This module imports torch through ``egs_warp.training.finetune``; import it only where a training runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.colmap import SparsePoints
from egs_warp.training.training_view import TrainingView

MIN_POINTS = 500
"""Minimum number of triangulated points from which the initial cloud is created."""
_SIZE_OF_POINT, _OPACITY_OF_POINT = 1.0, 0.1
"""Initial standard deviation, as a multiple of the spacing, and initial opacity of a triangulated point."""


def middle_of(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the point (3,) nearest to the optical axes of all ``cameras``, in the least-squares sense."""
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]


def initial_cloud(
    views: Sequence[TrainingView], *, count: int, sh_degree: int, seed: int = 0, device: str | None = None
) -> GaussianCloud:
    """Create ``count`` isotropic Gaussians, spread evenly over the region that most cameras see, in the colours of the
    photos there.

    Of many random points, those whose colour varies least between the views are chosen. If all views have alpha, only
    points inside all silhouettes are used, so that the result is a rough visual and photometric hull.
    """
    centres = np.array([view.camera.centre for view in views])
    focus = middle_of([view.camera for view in views])
    distance = float(np.median(np.linalg.norm(centres - focus, axis=1)))
    reach = np.median([0.5 * max(v.camera.width / v.camera.fx, v.camera.height / v.camera.fy) for v in views])
    random = np.random.default_rng(seed)
    low, high = focus - distance * min(float(reach), 1.0), focus + distance * min(float(reach), 1.0)
    points = random.uniform(low, high, (8 * count, 3))
    visibility = _Visibility.of(points, views)
    if visibility.solid.any():
        # The object may fill only a small part of the cameras' common view, so sample again around the object alone.
        margin = 0.05 * (high - low)
        low, high = points[visibility.solid].min(axis=0) - margin, points[visibility.solid].max(axis=0) + margin
        points = random.uniform(low, high, (8 * count, 3))
        visibility = _Visibility.of(points, views)
    candidates = np.flatnonzero(visibility.solid if visibility.solid.any() else visibility.often)
    if len(candidates) == 0:
        raise UserError("train: the cameras have no common view; check the poses")
    # In empty space in front of a plain backdrop, the colour varies as little between the views as on a surface, so
    # half of the points are chosen at random.
    best = candidates[np.argsort(visibility.spread[candidates], kind="stable")][: count // 2]
    rest = random.permutation(np.setdiff1d(candidates, best))[: count - len(best)]
    chosen = np.concatenate([best, rest])
    means = points[chosen]
    volume = float(np.prod(high - low)) * len(candidates) / len(points)
    spacing = 0.5 * (volume / len(means)) ** (1 / 3)
    sh = np.zeros((len(means), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (visibility.colour[chosen] - 0.5) / SH_BAND_0
    return GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0, 0, 0], (len(means), 1)),
        np.full((len(means), 3), np.log(spacing)),
        np.full(len(means), np.log(0.1 / 0.9)),
        sh,
        device=device,
    )


def cloud_from_points(
    points: SparsePoints, *, count: int | None, sh_degree: int, seed: int = 0, device: str | None = None
) -> GaussianCloud:
    """Create isotropic Gaussians at ``points``, at most ``count`` of them. The size of each Gaussian is the root mean
    square distance to the three nearest neighbours."""
    positions, colours = points.positions, points.colours
    if count is not None and len(positions) > count:
        chosen = np.sort(np.random.default_rng(seed).permutation(len(positions))[:count])
        positions, colours = positions[chosen], colours[chosen]
    near = KDTree(positions).query(positions, k=4)[0][:, 1:]
    spacing = np.sqrt(np.mean(near**2, axis=1))
    # Coincident points have a distance of zero.
    spacing = np.maximum(spacing, 1e-3 * np.median(spacing))
    sh = np.zeros((len(positions), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (colours - 0.5) / SH_BAND_0
    return GaussianCloud.from_numpy(
        positions,
        np.tile([1.0, 0, 0, 0], (len(positions), 1)),
        np.repeat(np.log(_SIZE_OF_POINT * spacing)[:, None], 3, axis=1),
        np.full(len(positions), np.log(_OPACITY_OF_POINT / (1 - _OPACITY_OF_POINT))),
        sh,
        device=device,
    )


@dataclass(frozen=True)
class _Visibility:
    """Colour and visibility of n points in all views combined."""

    colour: np.ndarray
    """(n, 3) mean colour over the views that see the point."""
    spread: np.ndarray
    """(n,) standard deviation of the colour over these views."""
    often: np.ndarray
    """(n,) bool, True for points that are seen by at least half as many views as the point that is seen most often."""
    solid: np.ndarray
    """(n,) bool, True for points in ``often`` that are inside the silhouettes of nearly all views; all False unless all
    views have alpha."""

    @classmethod
    def of(cls, points: np.ndarray, views: Sequence[TrainingView]) -> _Visibility:
        sums, squares = np.zeros((len(points), 3)), np.zeros((len(points), 3))
        seen, alpha = np.zeros(len(points)), np.zeros(len(points))
        for view in views:
            camera = view.camera
            p = points @ camera.rotation.T + camera.translation
            ahead = p[:, 2] > camera.near
            z = np.where(ahead, p[:, 2], 1.0)
            column = np.floor(camera.fx * p[:, 0] / z + camera.cx)
            row = np.floor(camera.fy * p[:, 1] / z + camera.cy)
            inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            pixel = row[inside].astype(int), column[inside].astype(int)
            sums[inside] += view.image[pixel]
            squares[inside] += view.image[pixel] ** 2
            seen[inside] += 1
            if view.alpha is not None:
                alpha[inside] += view.alpha[pixel]
        known = np.maximum(seen, 1)
        mean = sums / known[:, None]
        often = seen >= max(0.5 * seen.max(), 1)
        return cls(
            colour=mean,
            spread=np.sqrt(np.maximum(squares / known[:, None] - mean**2, 0).sum(axis=1)),
            often=often,
            # One mask in ten may wrongly exclude a part of the object.
            solid=often & (alpha > 0.9 * known),
        )
