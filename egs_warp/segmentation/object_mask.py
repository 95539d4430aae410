"""Which Gaussians of a capture are the object: votes of masks, a box or a point;
then what is connected above the plane.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.connectivity import close_to, connected_parts, enclosed
from egs_warp.segmentation.plane_search import lies_along
from egs_warp.segmentation.votes import MaskedView, Votes, blending_votes, check_size

_NOTHING_ABOVE = (
    "object: nothing of it lies above the plane; mark it by other masks, a box or a point, or give its plane"
)
_MIN_OPACITY = 0.1
"""Fainter Gaussians make no connection; they go with what surrounds them."""
_SEEN = 0.02
"""A Gaussian of which less than this share shows in the masked views has no say in whether it belongs to the object."""
CELLS = 64
"""Across the object, for connectivity."""
_SMALL = 0.01
"""Of the object's opacity mass: a connected part below this is a floater."""
_HOLLOW = 0.35
"""Of the object's size: a point in the middle of a hollow body is this far from its skin, or less."""
_ROUGHEST = 0.02
"""Of the object's size: a floor is not taken to scatter more than this."""
FOOTPRINT_HEIGHT = 0.08
"""Of the object's size: what it has below this height hides the floor."""
_HALO = 0.1
"""Of the object's size: floaters this near to it are its halo."""
_WISP, _WISP_HEIGHT = 0.015, 0.1
"""Of the object's size: standard deviation from which, and height up to which,
a Gaussian may be a shred of the floor.
"""
_NEIGHBOURS = 16
"""Gaussians whose median colour is that of a place."""
_HALVINGS = 6
"""Of the first guess of an object's size, about a point in a large room."""
_LIKELY, _LARGEST = 0.3, 4.0
"""Of a guess: smaller and larger objects are not what it was made for."""
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


def segment(
    cloud: GaussianCloud, plane: Plane | HeightField, spec: ObjectSpec, *, size: float | None = None
) -> Segmentation:
    """Find the object that ``spec`` means and that stands on ``plane``, or on ground that is not flat.

    Around a point the object is first taken to be half as large as the capture; where nothing so large stands on the
    plane, as in a room, half as large again, and so on; ``size`` (scene units) tells better. Raises ``UserError`` where
    masks are empty, miss the object or have the wrong size, where box or point hold nothing, and where the object does
    not touch the plane.
    """
    scene = _Scene.of(cloud, plane)
    if spec.masks:
        wanted, unknown = _voted(cloud, spec.masks)
    else:
        wanted = spec.box.holds(scene.means) if spec.box is not None else np.ones(cloud.count, bool)
        unknown = np.zeros(cloud.count, bool)
    size = size or _first_size(scene, wanted, spec)
    try:
        return _of_size(scene, wanted, unknown, spec, size)
    except UserError:
        if spec.point is None:
            raise
        for halvings in range(1, _HALVINGS + 1):
            smaller = size * 0.5**halvings
            with contextlib.suppress(UserError):
                found = _of_size(scene, wanted, unknown, spec, smaller)
                # A shred of what is meant is found by a wrong guess as well.
                if found.size > _LIKELY * smaller:
                    return found
        raise


def _of_size(scene: _Scene, wanted: np.ndarray, unknown: np.ndarray, spec: ObjectSpec, size: float) -> Segmentation:
    """The object, if it is roughly of ``size`` (scene units)."""
    foot = _FOOT * size
    # The first round tells how large the object is and how rough its floor; the second goes by that.
    for _ in range(2):
        chosen, small = _body(scene, wanted, unknown, spec, foot, size)
        size = _diagonal(scene.means[chosen])
        if size == 0.0:
            raise UserError(_NOTHING_ABOVE, check=("plane",))
        floor = _floor_top(scene, chosen, size)
        foot = max(_FOOT * size, 1.2 * floor)
    outline = scene.under(chosen, max(3.0 * foot, FOOTPRINT_HEIGHT * size), size)
    near = close_to(scene.means, scene.means[chosen], 2.0 * size / CELLS)
    above = scene.heights > foot
    # Where masks decide, they decide on the foot as well; else it is what stands under the object, off the floor.
    claimed = wanted & near & bool(spec.masks)
    standing = (scene.heights > floor) & scene.under(chosen, 3.0 * foot, size)
    at_foot = ~above & (scene.heights > 0.0) & (claimed if spec.masks else standing)
    faint = ~scene.solid & above & (wanted | unknown) & near
    object_mask = chosen | at_foot | faint
    lowest = float(np.quantile(scene.heights[object_mask], 0.002))
    if lowest > 0.1 * size:
        raise UserError(
            f"object: it touches no plane: its lowest part is {lowest / size:.2f} of its size above this one; "
            "mark all of the object, or give its plane",
            check=("plane",),
        )
    # What lies below the object's foot is hidden, so nobody can tell whose it is; inpainting makes new floor there.
    buried = ~object_mask & ~above & (scene.heights > -0.25 * size) & (outline | claimed)
    halo = (small | ~scene.solid) & above & close_to(scene.means, scene.means[chosen], _HALO * size)
    if not spec.masks:
        wisps = _wisps(scene, object_mask, size)
        object_mask &= ~wisps
        halo |= wisps
    floaters = (halo | (claimed & above)) & ~object_mask & ~buried
    return Segmentation(object_mask, buried, floaters, size)


@dataclass(frozen=True)
class _Scene:
    """What is asked of the capture again and again; all (n, ...)."""

    cloud: GaussianCloud
    plane: Plane | HeightField
    means: np.ndarray
    flat: np.ndarray
    """(n, 2) along the plane."""
    heights: np.ndarray
    opacity: np.ndarray
    solid: np.ndarray
    """(n,) bool: opaque enough to connect."""
    level: np.ndarray
    """(n,) bool: flat, and lying along the plane as a floor's Gaussians do."""

    @classmethod
    def of(cls, cloud: GaussianCloud, plane: Plane | HeightField) -> _Scene:
        means, opacity = cloud.means.numpy().astype(np.float64), cloud.opacities()
        level = lies_along(cloud, plane)
        flat = means @ np.stack(plane.tangents(), axis=1)
        return cls(cloud, plane, means, flat, plane.heights(means), opacity, opacity >= _MIN_OPACITY, level)

    def under(self, chosen: np.ndarray, height: float, size: float) -> np.ndarray:
        """(n,) bool: within the outline, seen along the normal, of what ``chosen`` has below ``height``."""
        return enclosed(self.flat, self.flat[chosen & (self.heights < height)], size / CELLS)


def _body(
    scene: _Scene, wanted: np.ndarray, unknown: np.ndarray, spec: ObjectSpec, foot: float, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool: the connected part that is meant, all of it higher than ``foot``; and (n,) bool: all small parts."""
    core = (wanted | unknown) & scene.solid & (scene.heights > foot)
    # A rumpled floor must not join the object: what lies flat near the plane connects nothing.
    lying = core & scene.level & (scene.heights < 3.0 * foot) & (not spec.masks)
    indices = np.flatnonzero(core & ~lying)
    if len(indices) == 0:
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    parts = connected_parts(scene.cloud, indices, cell=size / CELLS, plane=scene.plane, above=foot)
    mass = np.bincount(parts, weights=scene.opacity[indices])
    if spec.point is not None:
        away = np.linalg.norm(scene.means[indices] - spec.point, axis=1)
        # A point may lie in the middle of an object, which is hollow.
        if away.min() > _HOLLOW * size:
            raise UserError(
                f"object: nothing solid above the plane within {_HOLLOW * size:.3g} of the point "
                f"{','.join(f'{v:g}' for v in spec.point)}; give a point on the object, in the capture's units"
            )
        # The nearest of what matters: beside the object, strays and loose matter inside it do not.
        around = np.unique(parts[away < _HOLLOW * size])
        around = around[mass[around] > 0.05 * mass[around].max()]
        best = int(around[np.argmin([away[parts == one].min() for one in around])])
    else:
        claimed = np.bincount(parts, weights=scene.opacity[indices] * wanted[indices])
        best = int(np.argmax(claimed))
        if claimed[best] == 0.0:
            raise UserError(_NOTHING_ABOVE, check=("plane",))
    chosen, small = np.zeros((2, len(core)), bool)
    chosen[indices[parts == best]] = True
    small[indices[mass[parts] < _SMALL * mass[best]]] = True
    # Loose matter inside a hollow body would stay behind as a ghost. The floor closes the body from below: its mirror
    # image in the floor does as well.
    shell = scene.means[chosen]
    if _diagonal(shell) > _LARGEST * size:
        # Cells made for a small object would fill a room.
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    mirrored = shell - 2.0 * (scene.heights[chosen, None] - foot) * scene.plane.normal
    chosen |= enclosed(scene.means, np.concatenate([shell, mirrored]), 2.0 * size / CELLS) & (scene.heights > foot)
    chosen |= lying & scene.under(chosen, 0.1 * size, size)
    return chosen, small


def _wisps(scene: _Scene, chosen: np.ndarray, size: float) -> np.ndarray:
    """(n,) bool: wide Gaussians at the object's foot in the floor's colour, on uneven ground those that lie flat, too,
    which would go along as shreds of the floor.
    """
    low = scene.heights < _WISP_HEIGHT * size
    length = np.exp(scene.cloud.log_scales.numpy().max(axis=1))
    wide = length > max(_WISP * size, 2.0 * float(np.median(length[chosen])))
    if isinstance(scene.plane, HeightField):
        # Under the object the ground is a guess, and what lies there may be higher.
        wide |= scene.level
    suspects = np.flatnonzero(chosen & low & wide)
    own = np.flatnonzero(chosen & low & ~wide & scene.solid)
    floor = np.flatnonzero(~chosen & low & scene.level & scene.solid & (np.abs(scene.heights) < 0.05 * size))
    found = np.zeros(len(chosen), bool)
    if min(len(suspects), len(own), len(floor)) < 1:
        return found
    colours = scene.cloud.sh.numpy()[:, 0].astype(np.float64) * SH_BAND_0

    def apart(others: np.ndarray) -> np.ndarray:
        tree = KDTree(scene.means[others])
        _, nearest = tree.query(scene.means[suspects], k=min(_NEIGHBOURS, len(others)))
        nearest = np.reshape(nearest, (len(suspects), -1))
        return np.linalg.norm(np.median(colours[others[nearest]], axis=1) - colours[suspects], axis=1)

    found[suspects[apart(floor) < 0.5 * apart(own)]] = True
    return found


def _first_size(scene: _Scene, wanted: np.ndarray, spec: ObjectSpec) -> float:
    """First guess of the object's size, scene units: half of the capture's where only a point is known."""
    if spec.box is not None:
        return float(np.linalg.norm(spec.box.high - spec.box.low))
    standing = wanted & scene.solid & (scene.heights > 0.0)
    if not standing.any():
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    return _diagonal(scene.means[standing]) * (0.5 if spec.point is not None else 1.0)


def _diagonal(points: np.ndarray) -> float:
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    return float(np.linalg.norm(high - low))


def _floor_top(scene: _Scene, chosen: np.ndarray, size: float) -> float:
    """Height up to which the floor's own Gaussians scatter, judged beside the object ``chosen`` (n,) bool;
    at least 0.
    """
    middle = np.median(scene.flat[chosen], axis=0)
    beside = scene.level & scene.solid & ~chosen & (np.abs(scene.heights) < 0.05 * size)
    beside &= np.linalg.norm(scene.flat - middle, axis=1) < size
    beside &= ~close_to(scene.flat, scene.flat[chosen & (scene.heights < 0.2 * size)], 0.03 * size)
    if beside.sum() < 20:
        return 0.0
    level = float(np.median(scene.heights[beside]))
    spread = 1.4826 * float(np.median(np.abs(scene.heights[beside] - level)))
    return float(np.clip(level + 3.0 * spread, 0.0, _ROUGHEST * size))


def votes_of_masks(cloud: GaussianCloud, masks: Sequence[MaskedView]) -> Votes:
    """Votes of the masks that mark anything: where the object is out of sight its mask is empty, and says nothing.

    Raises ``UserError`` for masks of another size than their cameras', where all are empty, and where their cameras see
    nothing.
    """
    for view in masks:
        check_size(view)
    marked = [view for view in masks if view.mask.any()]
    if not marked:
        raise UserError(f"{masks[0].name}: the mask is empty; mark the object in it")
    votes = blending_votes(cloud, marked)
    if not (votes.inside + votes.outside > 0.0).any():
        raise UserError("object: the masks' cameras see nothing of the capture; check that both share one frame")
    return votes


def _voted(cloud: GaussianCloud, masks: Sequence[MaskedView]) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians that the masks claim, and those that they do not show."""
    votes = votes_of_masks(cloud, masks)
    seen = votes.share_seen() >= _SEEN
    wanted = seen & (votes.share_inside() > 0.5)
    if not wanted.any():
        raise UserError("object: nothing of the capture shows inside the masks; check masks and cameras")
    return wanted, ~seen


def masks_from_selection(cloud: GaussianCloud, selection: np.ndarray, cameras: Sequence[Camera]) -> list[MaskedView]:
    """Masks of where the Gaussians ``selection`` (n,) bool make up more than half of what shows,
    through ``cameras``.
    """
    from egs_warp.render.rasteriser import render_gaussians

    sh = np.zeros((cloud.count, 1, 3), np.float32)
    sh[:, 0, :] = np.where(selection, 0.5, -0.5)[:, None] / SH_BAND_0
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
            camera,
            render_gaussians(painted, camera, background=(0.0, 0.0, 0.0)).colour.numpy()[..., 0] > 0.5,
            f"view {k}",
        )
        for k, camera in enumerate(cameras)
    ]
