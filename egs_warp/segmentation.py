"""Which Gaussians of a capture are the object: votes of masks, a box or a point; then what is connected above the plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from egs_warp.camera import Camera
from egs_warp.errors import UserError
from egs_warp.gaussians import GaussianCloud
from egs_warp.plane import Plane
from egs_warp.votes import MaskedView, Votes, blending_votes, check_size

_MIN_OPACITY = 0.1
"""Fainter Gaussians make no connection; they go with what surrounds them."""
_SEEN = 0.02
"""A Gaussian of which less than this share shows in the masked views has no say in whether it belongs to the object."""
_CELLS = 64
"""Across the object, for connectivity."""
_ARM = 1.5
"""Standard deviations: how far a Gaussian reaches to touch another."""
_FOOT = 0.015
"""Of the object's size: within this height above the plane, floor and object cannot be told apart by connection."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the capture's frame."""

    low: np.ndarray
    """(3,)"""
    high: np.ndarray
    """(3,)"""

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool for points (n, 3)."""
        return np.all((points >= self.low) & (points <= self.high), axis=1)


@dataclass(frozen=True)
class ObjectSpec:
    """What the user says about where the object is: exactly one of the three."""

    masks: tuple[MaskedView, ...] = ()
    box: Box | None = None
    point: np.ndarray | None = None
    """(3,) on or in the object, scene units."""


@dataclass(frozen=True)
class Segmentation:
    """The object among the Gaussians of a capture."""

    object_mask: np.ndarray
    """(n,) bool: the object, means above the plane."""
    buried_mask: np.ndarray
    """(n,) bool: of the object, but with means below the plane. Belongs to neither object nor background."""
    floater_mask: np.ndarray
    """(n,) bool: looks like the object's, but hangs apart from it. Belongs to neither."""
    size: float
    """Scene units: diagonal of the object's bounding box."""

    @property
    def background_mask(self) -> np.ndarray:
        """(n,) bool."""
        return ~(self.object_mask | self.buried_mask | self.floater_mask)


def segment(cloud: GaussianCloud, plane: Plane, spec: ObjectSpec) -> Segmentation:
    """Find the object that ``spec`` means and that stands on ``plane``.

    Raises ``UserError`` where masks are empty, miss the object or have the wrong size, where box or point hold nothing,
    and where the object does not touch the plane.
    """
    means, opacity = cloud.means.numpy().astype(np.float64), cloud.opacities()
    heights = plane.heights(means)
    if spec.masks:
        wanted, unknown = _voted(cloud, spec.masks)
    elif spec.box is not None:
        wanted, unknown = spec.box.holds(means), np.zeros(cloud.count, bool)
    else:
        wanted, unknown = np.ones(cloud.count, bool), np.zeros(cloud.count, bool)
    solid = opacity >= _MIN_OPACITY
    size = _size_of(means, wanted & solid & (heights > 0.0), spec)
    foot = _FOOT * size
    core = (wanted | unknown) & solid & (heights > foot)
    if not core.any():
        raise UserError("object: nothing of it lies above the plane; check the masks, box or point, or give --plane")
    chosen = _component(cloud, plane, foot, core, wanted, spec, size)
    size = _diagonal(means[chosen])
    # Loose matter inside a hollow body would stay behind as a ghost.
    chosen |= _enclosed(means, means[chosen], 2.0 * size / _CELLS) & (heights > foot)
    near = _near(means, means[chosen], 2.0 * size / _CELLS)
    floor = floor_top(means, opacity, plane, chosen, size)
    # Where masks decide, they decide on the foot as well; else it is what stands under the object, off the floor.
    if spec.masks:
        foot_mask = wanted & near & (heights > 0.0) & (heights <= foot)
    else:
        foot_mask = (heights <= foot) & (heights > floor) & _under(means, heights, chosen, plane, 3.0 * foot, size)
    faint = near & ~solid & (heights > foot) & (wanted | unknown) & _near(means, means[chosen], size / _CELLS)
    object_mask = chosen | foot_mask | faint
    lowest = float(np.quantile(heights[object_mask], 0.002))
    if lowest > 0.1 * size:
        raise UserError(
            f"object: it touches no plane: its lowest part is {lowest / size:.2f} of its size above this one; "
            "give --plane, or mark all of the object"
        )
    # What lies below the object's foot is hidden, so nobody can tell whose it is; inpainting makes new floor there.
    under = _under(means, heights, chosen, plane, 3.0 * foot, size)
    buried = ~object_mask & (heights <= foot) & (heights > -0.25 * size) & (under | (wanted & near & bool(spec.masks)))
    floaters = wanted & ~object_mask & ~buried & (heights > foot) if spec.masks else np.zeros(cloud.count, bool)
    return Segmentation(object_mask, buried, floaters, size)


def _voted(cloud: GaussianCloud, masks: Sequence[MaskedView]) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians that the masks claim, and those that they do not show."""
    for view in masks:
        check_size(view)
        if not view.mask.any():
            raise UserError(f"{view.name}: the mask is empty; mark the object in it")
    votes: Votes = blending_votes(cloud, masks)
    if not (votes.inside + votes.outside > 0.0).any():
        raise UserError("object: the masks' cameras see nothing of the capture; check that both share one frame")
    seen = votes.share_seen() >= _SEEN
    wanted = seen & (votes.share_inside() > 0.5)
    if not wanted.any():
        raise UserError("object: nothing of the capture shows inside the masks; check masks and cameras")
    return wanted, ~seen


def _size_of(means: np.ndarray, wanted: np.ndarray, spec: ObjectSpec) -> float:
    """First guess of the object's size: the whole capture's where only a point is known."""
    if spec.box is not None:
        return float(np.linalg.norm(spec.box.high - spec.box.low))
    if not wanted.any():
        raise UserError("object: nothing of it lies above the plane; check the masks, box or point, or give --plane")
    return _diagonal(means[wanted]) * (0.5 if spec.point is not None else 1.0)


def _diagonal(points: np.ndarray) -> float:
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    return float(np.linalg.norm(high - low))


def _component(
    cloud: GaussianCloud, plane: Plane, foot: float, core: np.ndarray, wanted: np.ndarray, spec: ObjectSpec, size: float
) -> np.ndarray:
    """(n,) bool: the connected part of ``core`` that holds the point, or else most of what is wanted.

    Gaussians are connected that reach, with centre or arms, into one cell of a grid; cells below ``foot`` do not count.
    """
    indices = np.flatnonzero(core)
    points = cloud.means.numpy()[indices].astype(np.float64)
    mass = cloud.opacities()[indices]
    spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1])) if len(points) > 1 else size / _CELLS
    cell = max(size / _CELLS, 2.0 * spacing)
    arms = _ARM * np.exp(cloud.log_scales.numpy()[indices].astype(np.float64))
    axes = (
        Rotation.from_quat(cloud.rotations.numpy()[indices][:, [1, 2, 3, 0]]).as_matrix()
        * np.minimum(arms, 4.0 * cell)[:, None, :]
    )
    reached = np.concatenate(
        [points[:, None], points[:, None] + axes.transpose(0, 2, 1), points[:, None] - axes.transpose(0, 2, 1)], axis=1
    )
    owner = np.repeat(np.arange(len(points)), 7).reshape(-1, 7)
    above = plane.heights(reached) > foot
    voxel = np.floor((reached[above] - points.min(axis=0)) / cell).astype(np.int64)
    _, cells = np.unique(voxel, axis=0, return_inverse=True)
    count = len(points) + int(cells.max()) + 1
    links = coo_array((np.ones(len(cells)), (owner[above], len(points) + cells.ravel())), shape=(count, count))
    labels = connected_components(links, directed=False)[1][: len(points)]
    if spec.point is not None:
        away = np.linalg.norm(points - spec.point, axis=1)
        distance = float(away.min())
        # A point may lie in the middle of an object, which is hollow.
        if distance > 0.25 * size:
            raise UserError(
                f"object: nothing solid above the plane within {0.25 * size:.3g} of the point "
                f"{','.join(f'{v:g}' for v in spec.point)}; give a point on the object, in the capture's units"
            )
        # The heaviest of what is about as near: the nearest may be a stray.
        near = np.isin(labels, labels[away < distance + 4.0 * cell])
        best = int(np.argmax(np.bincount(labels, weights=mass * near)))
    else:
        best = int(np.argmax(np.bincount(labels, weights=mass * wanted[indices])))
    chosen = np.zeros(cloud.count, bool)
    chosen[indices[labels == best]] = True
    return chosen


def _enclosed(points: np.ndarray, shell: np.ndarray, cell: float) -> np.ndarray:
    """(n,) bool: whether ``points`` (n, k) lie in or within the closed shell of ``shell`` (m, k), on a grid of ``cell``."""
    corner = shell.min(axis=0) - 3.0 * cell
    shape = np.ceil((shell.max(axis=0) + 3.0 * cell - corner) / cell).astype(int) + 1
    grid = np.zeros(shape, bool)
    grid[tuple(np.floor((shell - corner) / cell).astype(int).T)] = True
    closed = ndimage.binary_closing(grid, np.ones((3,) * grid.ndim), iterations=2)
    filled = ndimage.binary_fill_holes(closed)
    place = np.floor((points - corner) / cell).astype(int)
    held = np.all((place >= 0) & (place < shape), axis=1)
    result = np.zeros(len(points), bool)
    result[held] = np.asarray(filled)[tuple(place[held].T)]
    return result


def _near(means: np.ndarray, others: np.ndarray, reach: float) -> np.ndarray:
    """(n,) bool: within ``reach`` of one of ``others`` (m, 3)."""
    return cKDTree(others).query(means, distance_upper_bound=reach)[0] <= reach


def floor_top(means: np.ndarray, opacity: np.ndarray, plane: Plane, chosen: np.ndarray, size: float) -> float:
    """Height up to which the floor's own Gaussians scatter, judged beside the object ``chosen`` (n,) bool; at least 0."""
    tangents = np.stack(plane.tangents(), axis=1)
    flat, heights = means @ tangents, plane.heights(means)
    middle = np.median(flat[chosen], axis=0)
    low = np.abs(heights) < 0.05 * size
    beside = low & ~chosen & (opacity > _MIN_OPACITY) & (np.linalg.norm(flat - middle, axis=1) < size)
    beside &= ~_near(flat, flat[chosen & (heights < 0.2 * size)], 0.03 * size)
    if beside.sum() < 20:
        return 0.0
    level = float(np.median(heights[beside]))
    return max(level + 3.0 * 1.4826 * float(np.median(np.abs(heights[beside] - level))), 0.0)


def _under(
    means: np.ndarray, heights: np.ndarray, chosen: np.ndarray, plane: Plane, level: float, size: float
) -> np.ndarray:
    """(n,) bool: within the outline, seen along the normal, of what ``chosen`` has below ``level``; holes are filled."""
    low = chosen & (heights < level)
    if not low.any():
        return np.zeros(len(means), bool)
    flat = means @ np.stack(plane.tangents(), axis=1)
    return _enclosed(flat, flat[low], size / _CELLS)


def masks_from_selection(cloud: GaussianCloud, selection: np.ndarray, cameras: Sequence[Camera]) -> list[MaskedView]:
    """Masks of where the Gaussians ``selection`` (n,) bool make up more than half of what shows, through ``cameras``."""
    from egs_warp.render.rasteriser import render

    sh = np.zeros((cloud.count, 1, 3), np.float32)
    sh[:, 0, :] = np.where(selection, 0.5, -0.5)[:, None] / 0.28209479177387814
    painted = GaussianCloud.from_numpy(
        cloud.means.numpy(),
        cloud.rotations.numpy(),
        cloud.log_scales.numpy(),
        cloud.opacity_logits.numpy(),
        sh,
        device=str(cloud.device),
    )
    return [
        MaskedView(
            camera, render(painted, camera, background=(0.0, 0.0, 0.0)).colour.numpy()[..., 0] > 0.5, f"view {k}"
        )
        for k, camera in enumerate(cameras)
    ]
