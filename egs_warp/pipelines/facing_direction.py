"""Estimate of the direction in which a body faces. The direction lies in the best vertical mirror plane of the body and
points to the side of its face.

The body is rendered from all around. The side of the face is recognised by four criteria: a face has more detail than
the back of a head, a head is in front of the feet, the back of a chair is behind its seat, and photos that were all
taken from one side usually show the front.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import warp as wp

from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.meshing.occupancy import LatticeSolid
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.short_repr import short_repr

_VIEWS = 24
"""Number of views, evenly spaced around the body. Mirror planes are tested at half the angular spacing of the views."""
_SIDE, _COARSE_SIDE = 128, 64
"""Side lengths of the pictures, pixels: for detail, and for symmetry."""
_ELEVATION = 0.2
"""Vertical component divided by the horizontal component of the direction from the body to the camera."""
_FOV_DEGREES = 20.0
"""Vertical field of view; it is narrow, so that images of a mirrored body are nearly mirrored."""
_MAX_GAUSSIANS = 50_000
"""Maximum number of rendered Gaussians. Of a larger cloud, a subset with enlarged splats is rendered, because small
details do not matter."""
_FINE, _SMOOTH = 0.01, 0.04
"""Standard deviations of two blurs, body heights; detail is the difference between the blurred images."""
_OFFSETS = np.arange(-6.0, 7.0, 1.5)
"""Offsets from the body's centre at which mirror planes are tested, in pixels of the coarse pictures."""
_OPAQUE = 0.8
"""Coverage above which a pixel belongs to the body."""
_SILHOUETTE = 0.5
"""Weight of the coverage relative to the colours, 0 to 1."""
_HIGH, _TOP, _LOW = 0.7, 0.85, 0.3
"""Lower limits of the upper part and of the top, and upper limit of the feet: heights above the ground, body heights.
For an animal on four legs, the upper part is mostly the trunk, and the top is the head."""
_MAX_HEAD_ASPECT = 2.7
"""Ratio of width to depth above which an upper part is considered a plate."""
_SYMMETRY, _LEAN, _TOP_LEAN, _PHOTOS = 2.0, 1.5, 1.0, 1.0
"""Weights of the terms of a direction's score: symmetry, lean of the upper part, lean of the top (both in body
heights), and mean direction to the photos. The logarithm of the ratio of detail in front to detail behind has the
weight 1."""
_CLEAR_MARGIN = 0.4
"""Difference between the scores of the front and its alternative above which a result is clear. It corresponds to a
front with 1.5 times as much detail as the back."""
_MIN_SYMMETRY = 0.1
"""Minimum excess of the symmetry about the best plane over the median of all planes, for a clear result."""
_MIN_APART = np.radians(60.0)
"""Minimum angle between the front and its alternative, radians."""


@dataclass(frozen=True)
class Front:
    """Facing direction of a body, with the reason for it."""

    __repr__ = short_repr

    direction: np.ndarray
    """(3,) Unit vector along the ground, in the frame of the body."""
    reason: str | None
    """Explanation of an estimate; None if the direction was given."""
    alternative: np.ndarray | None = None
    """(3,) Unit vector along the ground: the next best direction, if the estimate is not clear."""

    def rotated(self, turn: np.ndarray) -> Front:
        """Return the front in other axes: each direction is multiplied by ``turn`` (3, 3)."""
        alternative = None if self.alternative is None else turn @ self.alternative
        return replace(self, direction=turn @ self.direction, alternative=alternative)

    def description(self, frame: BodyFrame) -> str:
        """Return a description in one line for the user, without the reason; ``frame`` is the frame of the body in the
        capture."""
        direction, alternative = (
            None if vector is None else ",".join(f"{x:.2f}" for x in frame.axes.T @ vector)
            for vector in (self.direction, self.alternative)
        )
        if self.reason is None:
            return f"front is {direction}, as given"
        other = "" if alternative is None else f", but may be {alternative}"
        return f"front is taken to be {direction}{other}; if that is wrong, give the front"


def find_front(
    cloud: GaussianCloud, solid: LatticeSolid, *, seen_from: np.ndarray | None = None, lengthwise: bool = False
) -> Front:
    """Estimate the facing direction of a body. Equal bodies give bitwise equal results.

    Args:
        cloud: Gaussians in the frame of the body.
        solid: Solid of the body in its frame. The estimate does not depend on the cage, whose number of nodes varies.
        seen_from: (3,) Mean of the unit vectors from the body to the cameras of its photos, in the frame of the body;
            near zero if the cameras are all around.
        lengthwise: True if the body faces along its longest horizontal axis, as a lying body does.
    """
    points = solid.points(np.argwhere(solid.inside))
    height = float(points[:, 2].max())
    pictures, pixels = _render_views(cloud, points)
    mirrored = _symmetry(pictures)
    detail = np.array([_detail(picture, height * pixels) for picture in pictures])
    detail = 0.5 * detail + 0.25 * (np.roll(detail, 1) + np.roll(detail, -1))
    richer = np.log(np.maximum(detail, 1e-12) / np.maximum(np.roll(detail, _VIEWS // 2), 1e-12))
    angles = np.pi * np.arange(2 * _VIEWS) / _VIEWS
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lean, top_lean = (_lean(points, height) @ directions.T for height in (_HIGH, _TOP))
    symmetric_part = np.tile(mirrored - np.median(mirrored), 2)
    richer = np.stack([richer, 0.5 * (richer + np.roll(richer, -1))], axis=1).ravel()
    photos = np.zeros(len(directions)) if seen_from is None else seen_from[:2] @ directions.T
    score = _SYMMETRY * symmetric_part + richer + _LEAN * lean + _PHOTOS * photos
    length = _length(points)
    along = length @ directions.T
    allowed = np.abs(along) > np.abs(along).max() - 1e-9 if lengthwise else np.full(len(directions), True)
    total = score + _TOP_LEAN * top_lean
    best = int(np.argmax(np.where(allowed, total, -np.inf)))
    if lengthwise:
        angle = np.arctan2(*(np.sign(along[best]) * length)[::-1])
    else:
        # Refine the direction to the maximum of a parabola through the best score and its neighbours. The lean of the
        # top only selects a direction, because a head may be turned.
        before, at, after = score[best - 1], score[best], score[(best + 1) % len(score)]
        offset = 0.5 * (before - after) / min(before - 2.0 * at + after, -1e-12)
        angle = angles[best] + np.clip(offset, -1.0, 1.0) * np.pi / _VIEWS
    symmetric = f"the body is {100.0 * mirrored[best % _VIEWS]:.0f} % symmetric about this direction"
    reasons = [
        "the body lies along this direction" if lengthwise else symmetric,
        f"its front has {np.exp(richer[best]):.2f} times the detail of its back",
        f"its head is {lean[best]:+.2f} of its height in front of its feet",
    ]
    if abs(photos[best]) > 0.05:
        reasons.append(f"it was photographed from {'the front' if photos[best] > 0.0 else 'behind'}")
    apart = np.abs(np.angle(np.exp(1j * (angles - angles[best]))))
    second = int(np.argmax(np.where(allowed & (apart >= _MIN_APART), total, -np.inf)))
    margin = float(total[best] - total[second])
    is_clear = margin > _CLEAR_MARGIN and (lengthwise or symmetric_part[best] > _MIN_SYMMETRY)
    sure = "clearly" if is_clear else "not clearly"
    why = f"guessed: {', '.join(reasons)}; {sure} better than the next best direction"
    alternative = None if is_clear else np.array([*directions[second], 0.0])
    return Front(np.array([np.cos(angle), np.sin(angle), 0.0]), why, alternative)


def _length(points: np.ndarray) -> np.ndarray:
    """Return the unit vector (2,) along the longest horizontal principal axis of ``points`` (n, 3)."""
    arms = points[:, :2] - points[:, :2].mean(axis=0)
    return np.linalg.eigh(arms.T @ arms)[1][:, -1]


def mean_view(cameras: Sequence[Camera], centre: np.ndarray) -> np.ndarray | None:
    """Return the mean (3,) of the unit vectors from ``centre`` (3,) to the ``cameras``; None without cameras."""
    arms = np.array([camera.centre - centre for camera in cameras]).reshape(-1, 3)
    return (arms / np.linalg.norm(arms, axis=1, keepdims=True)).mean(axis=0) if len(arms) else None


def _render_views(cloud: GaussianCloud, points: np.ndarray) -> tuple[np.ndarray, float]:
    """Render the body alone from all around; ``points`` (n, 3) are inside it.

    Returns:
        Pictures (views, H, W, 4) of CIELAB / 100 and coverage, and their scale in pixels per metre.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    means = cloud.means.numpy()
    slack = 0.02 * high[2]
    cloud = cloud.subset(np.flatnonzero(((means >= low - slack) & (means <= high + slack)).all(axis=1)))
    step = -(-cloud.count // _MAX_GAUSSIANS)
    if step > 1:
        thinned = cloud.subset(np.arange(0, cloud.count, step))
        wider = thinned.log_scales.numpy() + np.float32(0.5 * np.log(step))
        cloud = replace(thinned, log_scales=wp.array(wider, dtype=wp.vec3, device=cloud.device))
    middle = np.append(np.median(points[:, :2], axis=0), 0.5 * (low[2] + high[2]))
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    pictures = []
    for angle in 2.0 * np.pi * np.arange(_VIEWS) / _VIEWS:
        direction = np.array([np.cos(angle), np.sin(angle), _ELEVATION])
        camera = ring_camera(direction, middle, radius, GROUND.normal, size=_SIDE, vertical_fov_degrees=_FOV_DEGREES)
        image = render_gaussians(cloud, camera, background=(0.0, 0.0, 0.0))
        cover = np.clip(image.alpha.numpy(), 0.0, 1.0)
        colour = np.clip(image.colour.numpy() / np.maximum(cover, 1e-3)[..., None], 0.0, 1.0)
        lab = cv2.cvtColor(colour.astype(np.float32), cv2.COLOR_RGB2LAB)
        pictures.append(np.dstack([0.01 * lab, cover]))
    return np.array(pictures, np.float32), _SIDE / (2.0 * radius)


def _symmetry(pictures: np.ndarray) -> np.ndarray:
    """Return the symmetry (views,), at most 1, of the pictures (views, H, W, 4) about each vertical mirror plane.

    The planes are at half the angular spacing of the views. For a symmetric body, the view from one side of the plane
    is the mirrored view from the other side.
    """
    small = np.array([cv2.resize(p, (_COARSE_SIDE, _COARSE_SIDE), interpolation=cv2.INTER_AREA) for p in pictures])
    small[..., :3] *= small[..., 3:]
    small[..., 3] *= _SILHOUETTE
    flipped = small[:, :, ::-1]
    total = float(np.abs(small).sum())
    alike = np.zeros(_VIEWS)
    for plane in range(_VIEWS):
        apart = np.zeros(len(_OFFSETS))
        for first in range(_VIEWS):
            second = (plane - first) % _VIEWS
            if second < first:
                continue
            times = 1.0 if second == first else 2.0
            aside = np.cos(2.0 * np.pi / _VIEWS * (first - 0.5 * plane))
            for k, offset in enumerate(_OFFSETS):
                shifted = np.roll(flipped[second], round(2.0 * offset * aside), axis=1)
                apart[k] += times * float(np.abs(small[first] - shifted).sum())
        alike[plane] = 1.0 - apart.min() / max(total, 1e-12)
    return alike


def _detail(picture: np.ndarray, height: float) -> float:
    """Return the root mean square, over the body, of the difference between two blurs of ``picture`` (H, W, 4).

    ``height`` is the height of the body in pixels.
    """
    inside = cv2.erode((picture[..., 3] > _OPAQUE).astype(np.float32), np.ones((3, 3)))

    def blurred(sigma: float) -> np.ndarray:
        over = cv2.GaussianBlur(picture[..., :3] * inside[..., None], (0, 0), sigma * height)
        return over / np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma * height), 1e-3)[..., None]

    difference = (((blurred(_FINE) - blurred(_SMOOTH)) ** 2).sum(axis=2) * inside).sum()
    return float(np.sqrt(difference / max(float(inside.sum()), 1.0)))


def _lean(points: np.ndarray, above: float) -> np.ndarray:
    """Return the horizontal offset (2,) from the feet to the upper part, body heights. ``points`` (n, 3) fill the body
    evenly.

    The upper part is what is higher than ``above`` body heights. If it is a thin plate whose offset is mainly
    perpendicular to it, such as the back of a chair, the result is the perpendicular offset, negated.
    """
    height = float(points[:, 2].max())
    head, feet = (points[part, :2] for part in (points[:, 2] > above * height, points[:, 2] < _LOW * height))
    if len(head) == 0 or len(feet) == 0:
        return np.zeros(2)
    lean = (head.mean(axis=0) - feet.mean(axis=0)) / height
    arms = head - head.mean(axis=0)
    moments, axes = np.linalg.eigh(arms.T @ arms)
    if moments[1] > _MAX_HEAD_ASPECT**2 * max(moments[0], 1e-300):
        thin, wide = axes.T
        if abs(lean @ thin) >= abs(lean @ wide):
            return -(lean @ thin) * thin
    return lean
