"""Which Gaussians of a capture are the object: votes of masks, a box or a point;
then what is connected above the plane.
"""

from __future__ import annotations

import contextlib

import numpy as np
from scipy.spatial import KDTree

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.above_plane import CELLS, SceneAbovePlane, clicked_parts, detached_parts
from egs_warp.segmentation.clicks import removed_by_clicks
from egs_warp.segmentation.connectivity import close_to, connected_parts, enclosed, nearer_to
from egs_warp.segmentation.floor_remnants import floor_remnants, floor_scatter_height
from egs_warp.segmentation.labels import labels_of_votes, smoothed_labels
from egs_warp.segmentation.object_spec import ObjectSpec, Segmentation
from egs_warp.segmentation.votes import votes_of_masks

_NOTHING_ABOVE = (
    "object: nothing of it lies above the plane; mark it by other masks, a box or a point, or give its plane"
)
_SMALL = 0.01
"""Of the object's opacity mass: a connected part below this is a floater."""
_PIECE = 0.05
"""Of the largest connected part: what masks claim elsewhere is another piece of the object from this share on."""
_HOLLOW = 0.35
"""Of the object's size: a point in the middle of a hollow body is this far from its skin, or less."""
TOUCHING = 0.1
"""Of the object's size: what hangs higher above a plane does not stand on it."""
FOOTPRINT_HEIGHT = 0.08
"""Of the object's size: what it has below this height hides the floor."""
_HALO = 0.1
"""Of the object's size: floaters this near to it are its halo."""
_HALVINGS = 6
"""Of the first guess of an object's size, about a point in a large room."""
_LIKELY, _LARGEST = 0.3, 4.0
"""Of a guess: smaller and larger objects are not what it was made for."""
_HANGING = 0.5
"""Of the object's size: what is this high above the plane in all of its parts does not stand on it."""
_VEIL, _USUAL, _FAINT = 0.05, 4.0, 0.3
"""Of the object's size, across, times what is usual on it, and of opacity: what is wider and fainter is haze about it,
and would go along as a halo.
"""
_TINGED, _ALIKE, _SKIN = 0.05, 0.15, 16
"""Of the object's size, of full brightness in each channel, and Gaussians of the object: haze so near to it, and in
colour so like the nearest of it, is its own.
"""
_FOOT = 0.015
"""Of the object's size: within this height above the plane, floor and object cannot be told apart by connection."""


def segment(
    cloud: GaussianCloud,
    plane: Plane | HeightField,
    spec: ObjectSpec,
    *,
    size: float | None = None,
    hover: float = TOUCHING,
) -> Segmentation:
    """Find the object that ``spec`` means and that stands on ``plane``, or on ground that is not flat.

    Around a point the object is first taken to be half as large as the capture; where nothing so large stands on the
    plane, as in a room, half as large again, and so on; ``size`` (scene units) tells better. ``hover`` is how high, of
    its size, it may hang above the plane. Raises ``UserError`` where masks are empty, miss the object or have the wrong
    size, where box or point hold nothing, and where the object does not touch the plane.
    """
    scene = SceneAbovePlane.of(cloud, plane)
    if spec.masks:
        wanted, unknown = _masked(scene, spec)
    else:
        wanted = spec.box.holds(scene.means) if spec.box is not None else np.ones(cloud.count, bool)
        unknown = np.zeros(cloud.count, bool)
    size = size or _first_size(scene, wanted, spec)
    try:
        return _of_size(scene, wanted, unknown, spec, size, hover)
    except UserError:
        if spec.point is None:
            raise
        for halvings in range(1, _HALVINGS + 1):
            smaller = size * 0.5**halvings
            with contextlib.suppress(UserError):
                found = _of_size(scene, wanted, unknown, spec, smaller, hover)
                # A shred of what is meant is found by a wrong guess as well.
                if found.size > _LIKELY * smaller:
                    return found
        raise


def _nothing_left(reason: str, count: int) -> str:
    """Message for an object of ``count`` Gaussians of which segmentation leaves none."""
    return (
        f"segment: none of the object's {count} Gaussians is left: {reason}; mark the object by masks, or click on"
        " more of it"
    )


def _masked(scene: SceneAbovePlane, spec: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool: Gaussians that masks and clicks mean, and (n,) bool: those that nobody knows of."""
    votes = votes_of_masks(scene.cloud, spec.masks)
    wanted, unknown = labels_of_votes(votes)
    standing = scene.is_opaque & (scene.heights > 0.0)
    if not (wanted & standing).any():
        return wanted, unknown
    size = _diagonal(scene.means[wanted & standing])
    # The plane is background: what lies at it or below links nothing.
    standing &= scene.heights > _FOOT * size
    nodes = np.flatnonzero(standing & _within(scene.means, wanted & standing, size))
    unknown &= ~standing
    wanted[nodes] = smoothed_labels(scene.cloud, votes, nodes, spec.clicks, views=len(spec.masks))
    return wanted, unknown


def _of_size(
    scene: SceneAbovePlane, wanted: np.ndarray, unknown: np.ndarray, spec: ObjectSpec, size: float, hover: float
) -> Segmentation:
    """The object, if it is roughly of ``size`` (scene units)."""
    foot, floor = _FOOT * size, 0.0
    chosen, small, cut_off = np.zeros((3, len(wanted)), bool)
    # The first round tells how large the object is and how rough its floor; the second goes by that.
    for _ in range(2):
        chosen, small, cut_off = _body(scene, wanted, unknown, spec, foot, size)
        size = _diagonal(scene.means[chosen])
        if size == 0.0:
            raise UserError(_NOTHING_ABOVE, check=("plane",))
        floor = floor_scatter_height(scene, chosen, size)
        foot = max(_FOOT * size, 1.2 * floor)
    outline = scene.is_under(chosen, max(3.0 * foot, FOOTPRINT_HEIGHT * size), size)
    near = close_to(scene.means, scene.means[chosen], 2.0 * size / CELLS)
    above = scene.heights > foot
    # Where masks decide, they decide on the foot as well; else it is what stands under the object, off the floor.
    claimed = wanted & near & bool(spec.masks)
    standing = (scene.heights > floor) & scene.is_under(chosen, 3.0 * foot, size)
    at_foot = ~above & (scene.heights > 0.0) & (claimed if spec.masks else standing)
    faint = ~scene.is_opaque & above & (wanted | unknown) & near
    object_mask = (chosen | at_foot | faint) & ~cut_off
    for click in spec.clicks:
        object_mask[click.hits] = click.inside & (scene.heights[click.hits] > 0.0) & ~cut_off[click.hits]
    veils = _veils(scene, np.flatnonzero(object_mask), size)
    object_mask[veils] = False
    ghosts = np.zeros_like(object_mask)
    ghosts[veils] = _of_its_own(scene, veils, object_mask & scene.is_opaque, size)
    if not object_mask.any():
        raise UserError(_nothing_left("haze and the clicks beside the object remove all of it", int(chosen.sum())))
    lowest = float(np.quantile(scene.heights[object_mask], 0.002))
    if lowest > hover * size:
        raise UserError(
            f"object: it touches no plane: its lowest part is {lowest / size:.2f} of its size above this one; "
            "mark all of the object, or give its plane",
            check=("plane",),
        )
    # What lies below the object's foot is hidden, so nobody can tell whose it is; inpainting makes new floor there.
    buried = ~object_mask & ~above & (scene.heights > -0.25 * size) & (outline | claimed)
    halo = (small | ~scene.is_opaque) & above & close_to(scene.means, scene.means[chosen], _HALO * size)
    if not spec.masks:
        shreds = floor_remnants(scene, object_mask, size)
        for click in spec.clicks:
            shreds[click.hits] = False
        if not (object_mask & ~shreds).any():
            raise UserError(_nothing_left("all of it has the colours of the floor", int(object_mask.sum())))
        object_mask &= ~shreds
        halo |= shreds
    floaters = (halo | ghosts | (claimed & above)) & ~object_mask & ~buried & ~cut_off
    return Segmentation(object_mask, buried, floaters, size)


def _veils(scene: SceneAbovePlane, thing: np.ndarray, size: float) -> np.ndarray:
    """(k,) int: the haze among the Gaussians ``thing`` (m,)."""
    across = scene.cloud.breadths(thing)
    wide = across > max(_VEIL * size, _USUAL * float(np.median(across)))
    return thing[wide & (scene.opacity[thing] < _FAINT)]


def _of_its_own(scene: SceneAbovePlane, veils: np.ndarray, thing: np.ndarray, size: float) -> np.ndarray:
    """(k,) bool: which of the ``veils`` (k,) lie within the ``thing`` (n,) bool, or near to it in its colours: left
    behind, they would be a ghost of it."""
    own = scene.is_within(veils, thing, size)
    if len(veils) == 0 or not thing.any():
        return own
    solid = np.flatnonzero(thing)
    away, nearest = KDTree(scene.means[solid]).query(scene.means[veils], k=min(_SKIN, len(solid)))
    nearest = solid[np.reshape(nearest, (len(veils), -1))]
    colours = 0.5 + SH_BAND_0 * scene.cloud.sh.numpy()[:, 0]
    off = np.abs(colours[veils] - colours[nearest].mean(axis=1)).max(axis=1)
    return own | ((np.reshape(away, (len(veils), -1))[:, 0] < _TINGED * size) & (off < _ALIKE))


def _body(
    scene: SceneAbovePlane, wanted: np.ndarray, unknown: np.ndarray, spec: ObjectSpec, foot: float, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) bool: the connected parts that are meant, all of them higher than ``foot``; (n,) bool: all small others; and
    (n,) bool: what clicks took away.
    """
    core = (wanted | unknown) & scene.is_opaque & (scene.heights > foot)
    # A rumpled floor must not join the object: what lies flat near the plane connects nothing.
    lying = core & scene.is_level & (scene.heights < 3.0 * foot) & (not spec.masks)
    indices = np.flatnonzero(core & ~lying)
    if len(indices) == 0:
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    parts = connected_parts(scene.cloud, indices, cell=size / CELLS, plane=scene.plane, above=foot)
    mass = np.bincount(parts, weights=scene.opacity[indices])
    claimed = np.bincount(parts, weights=scene.opacity[indices] * wanted[indices])
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
        best = int(np.argmax(claimed))
        if claimed[best] == 0.0:
            raise UserError(_NOTHING_ABOVE, check=("plane",))
    meant = np.union1d(best, clicked_parts(indices, parts, scene, spec.clicks, size))
    if spec.masks:
        # An object may be of several pieces, and masks mean them all.
        meant = np.union1d(meant, np.flatnonzero(claimed > _PIECE * claimed[best]))
    chosen, small, cut_off = np.zeros((3, len(core)), bool)
    chosen[indices[np.isin(parts, meant)]] = True
    small[indices[(mass[parts] < _SMALL * mass[best]) & ~chosen[indices]]] = True
    if spec.point is not None:
        chosen[indices[np.isin(parts, detached_parts(scene, indices, parts, meant, size))]] = True
        small &= ~chosen
    nodes = np.flatnonzero(chosen)
    low = FOOTPRINT_HEIGHT * min(size, _diagonal(scene.means[chosen]))
    cut_off[nodes[removed_by_clicks(scene.cloud, nodes, spec.clicks, scene.heights[nodes], low)]] = True
    chosen &= ~cut_off
    if not chosen.any():
        raise UserError(_nothing_left("the clicks beside the object remove all of it", int(cut_off.sum())))
    # Strays far out, joined by some huge one, would stretch what follows over the whole room.
    chosen &= _within(scene.means, chosen, size)
    # Loose matter inside a hollow body would stay behind as a ghost. The floor closes the body from below: its mirror
    # image in the floor does as well.
    shell = scene.means[chosen]
    if _diagonal(shell) > _LARGEST * size:
        # Cells made for a small object would fill a room.
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    heights = scene.heights[chosen]
    # What hangs high over the plane has no floor that closes it; the two images would span a grid of any size.
    if len(shell) and heights.min() < _HANGING * size:
        shell = np.concatenate([shell, shell - 2.0 * (heights[:, None] - foot) * scene.plane.normal])
    chosen |= enclosed(scene.means, shell, 2.0 * size / CELLS) & (scene.heights > foot)
    chosen |= lying & scene.is_under(chosen, 0.1 * size, size)
    # What was found by its place goes with what is next to it.
    cut_off |= nearer_to(scene.means, scene.means[cut_off], scene.means[chosen & ~cut_off])
    return chosen & ~cut_off, small, cut_off


def _first_size(scene: SceneAbovePlane, wanted: np.ndarray, spec: ObjectSpec) -> float:
    """First guess of the object's size, scene units: half of the capture's where only a point is known."""
    if spec.box is not None:
        return float(np.linalg.norm(spec.box.high - spec.box.low))
    standing = wanted & scene.is_opaque & (scene.heights > 0.0)
    if not standing.any():
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    return _diagonal(scene.means[standing]) * (0.5 if spec.point is not None else 1.0)


def _diagonal(points: np.ndarray) -> float:
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    return float(np.linalg.norm(high - low))


def _within(points: np.ndarray, chosen: np.ndarray, margin: float) -> np.ndarray:
    """(n,) bool: in the box that holds nearly all that is ``chosen`` (n,) bool, or so near to it."""
    if not chosen.any():
        return chosen
    low, high = np.quantile(points[chosen], [0.005, 0.995], axis=0)
    return np.all((points >= low - margin) & (points <= high + margin), axis=1)
