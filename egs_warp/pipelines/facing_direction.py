"""Which way a body faces: along the upright plane that mirrors it best, to the side where its face is.

The body is looked at from all around. A face has more detail than the back of a head, a head leans out over the feet,
the back of a chair away from its seat, and where photos are from one side only, they are of the front.
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
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.render.rasteriser import render_gaussians

_VIEWS = 24
"""Pictures, evenly around; planes of symmetry are tried at half their angle."""
_SIDE, _COARSE_SIDE = 128, 64
"""Pixels, to look for detail and for symmetry."""
_ELEVATION = 0.2
"""Of the way from the body to the camera, up to along the ground."""
_FOV_DEGREES = 20.0
"""So narrow that a mirrored body gives nearly a mirrored picture."""
_MOST_GAUSSIANS = 50_000
"""More are thinned out, and widened: nothing so small is looked for."""
_FINE, _SMOOTH = 0.01, 0.04
"""Body heights: detail is what is lost from the one blur to the other."""
_OFFSETS = np.arange(-6.0, 7.0, 1.5)
"""Coarse pixels from the body's middle at which a plane of symmetry is tried."""
_OPAQUE = 0.8
_SILHOUETTE = 0.5
"""What covers counts beside its lightness, 0 to 1."""
_HIGH, _LOW = 0.7, 0.3
"""Body heights: above is the head, below are the feet."""
_PLATE = 2.7
"""A head that is so much wider than deep is a back."""
_SYMMETRY, _LEAN, _PHOTOS = 2.0, 1.5, 1.0
"""Weights beside that of detail, 1: of the mirrored part of a picture, a body height of lean, all photos from one
way."""
_CLEAR = 0.4
"""Score by which the front is ahead of the back: that of a face half as rich again in detail."""


@dataclass(frozen=True)
class Front:
    """Which way a body faces, and why."""

    direction: np.ndarray
    """(3,) unit, along the ground, in the frame of the body."""
    reason: str | None
    """Why, where it was found; None where it was given."""

    def told(self, frame: BodyFrame) -> str:
        """One line for the user of a capture that the body has this ``frame`` in."""
        way = ",".join(f"{x:.2f}" for x in frame.axes.T @ self.direction)
        return f"front is {way}, as given" if self.reason is None else f"front is taken to be {way} ({self.reason})"


def find_front(
    cloud: GaussianCloud, mesh: TetMesh, *, seen_from: np.ndarray | None = None, lengthwise: bool = False
) -> Front:
    """Which way the body of ``cloud`` and cage ``mesh`` faces, both in its own frame.

    ``seen_from`` (3,) is the mean of the unit vectors to the cameras of its photos, in that frame: nothing if they go
    all around. What lies along the ground faces ``lengthwise``. The same body gives the same bits.
    """
    height = float(mesh.nodes[:, 2].max())
    pictures, pixels = _look_around(cloud, mesh)
    mirrored = _symmetry(pictures)
    detail = np.array([_detail(picture, height * pixels) for picture in pictures])
    detail = 0.5 * detail + 0.25 * (np.roll(detail, 1) + np.roll(detail, -1))
    richer = np.log(np.maximum(detail, 1e-12) / np.maximum(np.roll(detail, _VIEWS // 2), 1e-12))
    angles = np.pi * np.arange(2 * _VIEWS) / _VIEWS
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lean = _lean(mesh) @ ways.T
    symmetric = np.tile(mirrored - np.median(mirrored), 2)
    richer = np.stack([richer, 0.5 * (richer + np.roll(richer, -1))], axis=1).ravel()
    photos = np.zeros(len(ways)) if seen_from is None else seen_from[:2] @ ways.T
    score = _SYMMETRY * symmetric + richer + _LEAN * lean + _PHOTOS * photos
    length = _length(mesh)
    along = length @ ways.T
    allowed = np.abs(along) > np.abs(along).max() - 1e-9 if lengthwise else np.full(len(ways), True)
    best = int(np.argmax(np.where(allowed, score, -np.inf)))
    if lengthwise:
        angle = np.arctan2(*(np.sign(along[best]) * length)[::-1])
    else:
        # A parabola through the best and its neighbours.
        before, at, after = score[best - 1], score[best], score[(best + 1) % len(score)]
        angle = angles[best] + 0.5 * (before - after) / min(before - 2.0 * at + after, -1e-12) * np.pi / _VIEWS
    alike = f"the body is {100.0 * mirrored[best % _VIEWS]:.0f} % alike when mirrored along it"
    reasons = [
        "the body lies along it" if lengthwise else alike,
        f"has {np.exp(richer[best]):.2f} times the detail of behind",
        f"leans {lean[best]:+.2f} of its height ahead",
    ]
    if abs(photos[best]) > 0.05:
        reasons.append(f"was photographed from {'there' if photos[best] > 0.0 else 'behind'}")
    ahead = float(score[best] - score[(best + _VIEWS) % len(score)])
    sure = "clearly" if ahead > _CLEAR else "narrowly"
    why = f"guessed: {', '.join(reasons)}; {sure} ahead of the back; if not, say which way is front"
    return Front(np.array([np.cos(angle), np.sin(angle), 0.0]), why)


def _length(mesh: TetMesh) -> np.ndarray:
    """(2,) unit, along the longest way through the body on the ground."""
    middles, volumes = mesh.nodes[mesh.tets].mean(axis=1)[:, :2], mesh.volumes()
    arms = middles - np.average(middles, axis=0, weights=volumes)
    return np.linalg.eigh((arms * volumes[:, None]).T @ arms)[1][:, -1]


def mean_view(cameras: Sequence[Camera], centre: np.ndarray) -> np.ndarray | None:
    """(3,) mean of the unit vectors from ``centre`` (3,) to the ``cameras``; None where there are none."""
    arms = np.array([camera.centre - centre for camera in cameras]).reshape(-1, 3)
    return (arms / np.linalg.norm(arms, axis=1, keepdims=True)).mean(axis=0) if len(arms) else None


def _look_around(cloud: GaussianCloud, mesh: TetMesh) -> tuple[np.ndarray, float]:
    """(views, H, W, 4) CIELAB over 100 and coverage of the body alone, and pixels a metre."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    means = cloud.means.numpy()
    slack = 0.02 * high[2]
    cloud = cloud.subset(np.flatnonzero(((means >= low - slack) & (means <= high + slack)).all(axis=1)))
    step = -(-cloud.count // _MOST_GAUSSIANS)
    if step > 1:
        thinned = cloud.subset(np.arange(0, cloud.count, step))
        wider = thinned.log_scales.numpy() + np.float32(0.5 * np.log(step))
        cloud = replace(thinned, log_scales=wp.array(wider, dtype=wp.vec3, device=cloud.device))
    middle = np.append(np.median(mesh.nodes[:, :2], axis=0), 0.5 * (low[2] + high[2]))
    radius = float(np.linalg.norm(mesh.nodes - middle, axis=1).max())
    pictures = []
    for angle in 2.0 * np.pi * np.arange(_VIEWS) / _VIEWS:
        way = np.array([np.cos(angle), np.sin(angle), _ELEVATION])
        camera = ring_camera(way, middle, radius, GROUND.normal, size=_SIDE, vertical_fov_degrees=_FOV_DEGREES)
        image = render_gaussians(cloud, camera, background=(0.0, 0.0, 0.0))
        cover = np.clip(image.alpha.numpy(), 0.0, 1.0)
        colour = np.clip(image.colour.numpy() / np.maximum(cover, 1e-3)[..., None], 0.0, 1.0)
        lab = cv2.cvtColor(colour.astype(np.float32), cv2.COLOR_RGB2LAB)
        pictures.append(np.dstack([0.01 * lab, cover]))
    return np.array(pictures, np.float32), _SIDE / (2.0 * radius)


def _symmetry(pictures: np.ndarray) -> np.ndarray:
    """(views,) how much of the pictures (views, H, W, 4) is alike, 1 at most, when the body is mirrored in the upright
    plane at each half of their angle: the view to the one side of the plane is then the mirrored view to the other."""
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
    """Root mean square over the body of what differs in a ``picture`` (H, W, 4) of a body ``height`` pixels high
    between one blur and the next."""
    inside = cv2.erode((picture[..., 3] > _OPAQUE).astype(np.float32), np.ones((3, 3)))

    def blurred(sigma: float) -> np.ndarray:
        over = cv2.GaussianBlur(picture[..., :3] * inside[..., None], (0, 0), sigma * height)
        return over / np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma * height), 1e-3)[..., None]

    lost = (((blurred(_FINE) - blurred(_SMOOTH)) ** 2).sum(axis=2) * inside).sum()
    return float(np.sqrt(lost / max(float(inside.sum()), 1.0)))


def _lean(mesh: TetMesh) -> np.ndarray:
    """(2,) body heights by which the head is ahead of the feet; of a back, as a chair has it, behind them."""
    middles, volumes, height = mesh.nodes[mesh.tets].mean(axis=1), mesh.volumes(), float(mesh.nodes[:, 2].max())

    def middle(part: np.ndarray) -> np.ndarray:
        return np.average(middles[part, :2], axis=0, weights=volumes[part]) if part.any() else np.zeros(2)

    head, feet = middles[:, 2] > _HIGH * height, middles[:, 2] < _LOW * height
    if not head.any() or not feet.any():
        return np.zeros(2)
    lean = (middle(head) - middle(feet)) / height
    arms = middles[head, :2] - middle(head)
    moments, axes = np.linalg.eigh((arms * volumes[head, None]).T @ arms)
    if moments[1] > _PLATE**2 * max(moments[0], 1e-300):
        thin = axes[:, 0]
        return -(lean @ thin) * thin
    return lean
