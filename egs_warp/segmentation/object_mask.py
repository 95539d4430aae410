"""Search for an object's Gaussians: votes of masks, a box or a point, and then connected parts above the plane."""

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
from egs_warp.segmentation.object_spec import Box, ObjectSpec, Segmentation
from egs_warp.segmentation.photo_clicks import ClicksInPhotos, picked_in_photos
from egs_warp.segmentation.votes import votes_of_masks

_NOTHING_ABOVE = (
    "object: no part of it lies above the plane; mark it with other masks, a box or a point, or give its plane"
)
_MAX_FLOATER_MASS = 0.01
"""Opacity mass below which a connected part is a floater, as a fraction of the mass of the object's main part."""
_MIN_PART_MASS = 0.05
"""Minimum opacity mass claimed by masks in another part that belongs to the object, as a fraction of the mass that they
claim in the main part."""
_HOLLOW = 0.35
"""Maximum distance of a point in the middle of a hollow body from its surface, as a fraction of the object's size."""
TOUCHING = 0.1
"""Maximum height above a plane of an object that stands on it, as a fraction of the object's size."""
FOOTPRINT_HEIGHT = 0.08
"""Height below which the parts of the object hide the floor, as a fraction of the object's size."""
_HALO = 0.1
"""Maximum distance from the object of floaters that form its halo, as a fraction of the object's size."""
_HALVINGS = 6
"""Maximum number of times that the first guess of an object's size is halved, around a point in a large room."""
_MIN_SIZE_RATIO, _MAX_SIZE_RATIO = 0.3, 4.0
"""Minimum and maximum size of an object that matches a guessed size, as fractions of that size."""
_HANGING = 0.5
"""Maximum height above the plane of the lowest point of an object whose hollow shell the floor closes, as a fraction of
the object's size."""
_MIN_HAZE_WIDTH, _MIN_HAZE_WIDTH_RATIO, _MAX_HAZE_OPACITY = 0.05, 4.0, 0.3
"""Minimum width of haze, as a fraction of the object's size and as a multiple of the median width of the object's
Gaussians, and its maximum opacity. Gaussians that are wider and fainter would move with the object as a halo."""
_MAX_HAZE_GAP, _MAX_COLOUR_DIFFERENCE, _NEIGHBOURS = 0.05, 0.15, 16
"""Maximum distance of haze from the object, as a fraction of its size; maximum difference of each colour channel, 0 to
1; and number of nearest Gaussians of the object with which the colour is compared. Haze within both limits belongs to
the object."""
_BOX_DISTANCE, _MIN_CUT_MASS = 0.1, 0.01
"""Distance from a box within which its object may continue, as a fraction of the object's size; and minimum opacity
mass beyond a side that the box cuts, as a fraction of the mass of the object."""
_FOOT = 0.015
"""Height above the plane, as a fraction of the object's size, below which floor and object cannot be separated by
connectivity."""


def segment(
    cloud: GaussianCloud,
    plane: Plane | HeightField,
    spec: ObjectSpec,
    *,
    size: float | None = None,
    hover: float = TOUCHING,
) -> Segmentation:
    """Find the object that ``spec`` describes and that stands on ``plane`` or on uneven ground.

    Around a point, the object's size is first guessed as half of the capture's size. If nothing of this size stands on
    the plane, as is common in a room, the guess is halved repeatedly.

    Args:
        cloud: the capture.
        plane: the ground.
        spec: masks, a box, a point or picked Gaussians, and clicks.
        size: size of the object, scene units, if known; replaces the guess.
        hover: maximum height of the object above the ground, as a fraction of its size.

    Raises:
        UserError: masks are empty, miss the object or have the wrong size; there is nothing in the box or near the
            point; the object does not touch the plane; or nothing is left of it.
    """
    scene = SceneAbovePlane.of(cloud, plane)
    if isinstance(spec, ClicksInPhotos):
        spec = picked_in_photos(spec, scene)
    if spec.masks:
        claimed_by_user, unknown = _masked(scene, spec)
    elif spec.picked is not None:
        claimed_by_user, unknown = spec.picked, np.zeros(cloud.count, bool)
    else:
        claimed_by_user = spec.box.holds(scene.means) if spec.box is not None else np.ones(cloud.count, bool)
        unknown = np.zeros(cloud.count, bool)
    size = size or _first_size(scene, claimed_by_user, spec)
    try:
        return _of_size(scene, claimed_by_user, unknown, spec, size, hover)
    except UserError:
        if spec.point is None or spec.picked is not None:
            raise
        for halving in range(1, _HALVINGS + 1):
            smaller = size * 0.5**halving
            with contextlib.suppress(UserError):
                found = _of_size(scene, claimed_by_user, unknown, spec, smaller, hover)
                # If the assumed size is wrong, the search may find only a fragment, which is much smaller.
                if found.size > _MIN_SIZE_RATIO * smaller:
                    return found
        raise


def _nothing_left(reason: str, count: int) -> str:
    """Return the error message for an object of ``count`` Gaussians of which segmentation leaves none."""
    return (
        f"segment: none of the object's {count} Gaussians is left: {reason}; mark the object with masks, or click on"
        " more of it"
    )


def _masked(scene: SceneAbovePlane, spec: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask (n,) bool of Gaussians that masks and clicks select, and the mask (n,) bool of Gaussians that no
    mask shows."""
    votes = votes_of_masks(scene.cloud, spec.masks)
    claimed_by_user, unknown = labels_of_votes(votes)
    standing = scene.is_opaque & (scene.heights > 0.0)
    if not (claimed_by_user & standing).any():
        return claimed_by_user, unknown
    size = _diagonal(scene.means[claimed_by_user & standing])
    # The plane is background: Gaussians at or below it link nothing.
    standing &= scene.heights > _FOOT * size
    nodes = np.flatnonzero(standing & _within(scene.means, claimed_by_user & standing, size))
    unknown &= ~standing
    claimed_by_user[nodes] = smoothed_labels(scene.cloud, votes, nodes, spec.clicks, views=len(spec.masks))
    return claimed_by_user, unknown


def _of_size(
    scene: SceneAbovePlane,
    claimed_by_user: np.ndarray,
    unknown: np.ndarray,
    spec: ObjectSpec,
    size: float,
    hover: float,
) -> Segmentation:
    """Find the object, if it has approximately the ``size`` (scene units)."""
    foot, floor = _FOOT * size, 0.0
    chosen, small_parts, removed = np.zeros((3, len(claimed_by_user)), bool)
    # The first round measures the size of the object and the roughness of its floor; the second round uses both.
    for _ in range(2):
        chosen, small_parts, removed = _body(scene, claimed_by_user, unknown, spec, foot, size)
        size = _diagonal(scene.means[chosen])
        if size == 0.0:
            raise UserError(_NOTHING_ABOVE, check=("plane",))
        floor = floor_scatter_height(scene, chosen, size)
        foot = max(_FOOT * size, 1.2 * floor)
    outline = scene.is_under(chosen, max(3.0 * foot, FOOTPRINT_HEIGHT * size), size)
    near = close_to(scene.means, scene.means[chosen], 2.0 * size / CELLS)
    above = scene.heights > foot
    # If there are masks, they also decide which Gaussians are the foot; otherwise the foot is everything under the
    # object and above the floor.
    claimed = claimed_by_user & near & bool(spec.masks)
    standing = (scene.heights > floor) & scene.is_under(chosen, 3.0 * foot, size)
    at_foot = ~above & (scene.heights > 0.0) & (claimed if spec.masks else standing)
    if spec.picked is not None:
        at_foot |= ~above & (scene.heights > 0.0) & spec.picked
    faint = ~scene.is_opaque & above & (claimed_by_user | unknown) & near
    object_mask = (chosen | at_foot | faint) & ~removed
    for click in spec.clicks:
        object_mask[click.hits] = click.inside & (scene.heights[click.hits] > 0.0) & ~removed[click.hits]
    haze = _haze_indices(scene, np.flatnonzero(object_mask), size)
    object_mask[haze] = False
    own_haze = np.zeros_like(object_mask)
    own_haze[haze] = _is_own_haze(scene, haze, object_mask & scene.is_opaque, size)
    if not object_mask.any():
        raise UserError(_nothing_left("haze and the clicks beside the object remove all of it", int(chosen.sum())))
    lowest = float(np.quantile(scene.heights[object_mask], 0.002))
    if lowest > hover * size:
        raise UserError(
            f"object: it does not touch the plane: its lowest part is {lowest / size:.2f} of its size above the plane; "
            "mark all of the object, or give its plane",
            check=("plane",),
        )
    # Gaussians below the object's foot are hidden, so they cannot be assigned; inpainting creates new floor there.
    buried = ~object_mask & ~above & (scene.heights > -0.25 * size) & (outline | claimed)
    halo = (small_parts | ~scene.is_opaque) & above & close_to(scene.means, scene.means[chosen], _HALO * size)
    if not spec.masks:
        remnants = floor_remnants(scene, object_mask, size)
        for click in spec.clicks:
            remnants[click.hits] = False
        if not (object_mask & ~remnants).any():
            raise UserError(_nothing_left("all of it has the colours of the floor", int(object_mask.sum())))
        object_mask &= ~remnants
        halo |= remnants
    floaters = (halo | own_haze | (claimed & above)) & ~object_mask & ~buried & ~removed
    shared = spec.shared_colours if isinstance(spec, ClicksInPhotos) else 0.0
    cut_sides = () if spec.box is None else _cut_sides(scene, object_mask, spec.box, foot, size)
    return Segmentation(object_mask, buried, floaters, size, shared, cut_sides)


def _cut_sides(scene: SceneAbovePlane, object_mask: np.ndarray, box: Box, foot: float, size: float) -> tuple[str, ...]:
    """Return the sides of ``box`` beyond which the connected part of the object ``object_mask`` (n,) bool continues,
    higher than ``foot`` and within a fraction of its ``size``, scene units."""
    margin = _BOX_DISTANCE * size
    solid = scene.is_opaque & (scene.heights > foot) & ~(scene.is_level & (scene.heights < 3.0 * foot))
    near = np.all((scene.means > box.low - margin) & (scene.means < box.high + margin), axis=1)
    indices = np.flatnonzero(solid & near)
    if len(indices) == 0:
        return ()
    parts = connected_parts(scene.cloud, indices, cell=size / CELLS, plane=scene.plane, above=foot)
    points, mass = scene.means[indices], scene.opacity[indices]
    own = object_mask[indices]
    beyond = np.isin(parts, np.unique(parts[own])) & ~own
    least = _MIN_CUT_MASS * float(mass[own].sum())
    sides = []
    for axis, name in enumerate("xyz"):
        for sign, outside in (("-", points[:, axis] < box.low[axis]), ("+", points[:, axis] > box.high[axis])):
            if float(mass[beyond & outside].sum()) > least:
                sides.append(sign + name)
    return tuple(sides)


def foreign_haze(scene: SceneAbovePlane, object_mask: np.ndarray, size: float) -> np.ndarray:
    """Return the mask (n,) bool of the haze in ``object_mask`` (n,) bool that does not belong to the object, because it
    is neither inside the object nor near it with similar colours. ``size`` is the size of the object, scene units."""
    result = np.zeros_like(object_mask)
    haze = _haze_indices(scene, np.flatnonzero(object_mask), size)
    solid = object_mask & scene.is_opaque
    solid[haze] = False
    result[haze] = ~_is_own_haze(scene, haze, solid, size)
    return result


def _haze_indices(scene: SceneAbovePlane, object_indices: np.ndarray, size: float) -> np.ndarray:
    """Return the indices (k,) int of the haze among the Gaussians with the indices ``object_indices`` (m,)."""
    across = scene.cloud.breadths(object_indices)
    wide = across > max(_MIN_HAZE_WIDTH * size, _MIN_HAZE_WIDTH_RATIO * float(np.median(across)))
    return object_indices[wide & (scene.opacity[object_indices] < _MAX_HAZE_OPACITY)]


def _is_own_haze(scene: SceneAbovePlane, haze: np.ndarray, object_mask: np.ndarray, size: float) -> np.ndarray:
    """Return the mask (k,) bool of those Gaussians with the indices ``haze`` (k,) that are inside the object
    ``object_mask`` (n,) bool, or near it with similar colours.

    If this haze remained in the background, it would look like a ghost of the object.
    """
    own = scene.is_within(haze, object_mask, size)
    if len(haze) == 0 or not object_mask.any():
        return own
    solid = np.flatnonzero(object_mask)
    away, nearest = KDTree(scene.means[solid]).query(scene.means[haze], k=min(_NEIGHBOURS, len(solid)))
    nearest = solid[np.reshape(nearest, (len(haze), -1))]
    colours = 0.5 + SH_BAND_0 * scene.cloud.sh.numpy()[:, 0]
    off = np.abs(colours[haze] - colours[nearest].mean(axis=1)).max(axis=1)
    return own | ((np.reshape(away, (len(haze), -1))[:, 0] < _MAX_HAZE_GAP * size) & (off < _MAX_COLOUR_DIFFERENCE))


def _body(
    scene: SceneAbovePlane, claimed_by_user: np.ndarray, unknown: np.ndarray, spec: ObjectSpec, foot: float, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three masks (n,) bool: the connected parts of the object, all of them higher than ``foot``; all other
    small parts; and the Gaussians that clicks removed."""
    core = (claimed_by_user | unknown) & scene.is_opaque & (scene.heights > foot)
    if spec.picked is not None:
        if not core.any():
            raise UserError(_NOTHING_ABOVE, check=("plane",))
        return core, np.zeros_like(core), np.zeros_like(core)
    # Gaussians that lie flat near the plane connect nothing, because an uneven floor must not be connected to the
    # object.
    lying = core & scene.is_level & (scene.heights < 3.0 * foot) & (not spec.masks)
    indices = np.flatnonzero(core & ~lying)
    if len(indices) == 0:
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    parts = connected_parts(scene.cloud, indices, cell=size / CELLS, plane=scene.plane, above=foot)
    mass = np.bincount(parts, weights=scene.opacity[indices])
    claimed = np.bincount(parts, weights=scene.opacity[indices] * claimed_by_user[indices])
    if spec.point is not None:
        away = np.linalg.norm(scene.means[indices] - spec.point, axis=1)
        # The point may lie in the middle of an object, which is hollow.
        if away.min() > _HOLLOW * size:
            point, height = ",".join(f"{v:g}" for v in spec.point), float(scene.plane.heights(spec.point))
            if height < 0.0:
                raise UserError(
                    f"object: the point {point} is {-height:.3g} below the plane on which the object stands; give a"
                    " point on the object, above the plane",
                    check=("plane",),
                )
            raise UserError(
                f"object: nothing solid above the plane within {_HOLLOW * size:.3g} of the point {point}; give a point"
                " on the object, in the capture's units"
            )
        # Choose the nearest part with enough mass, which is neither a stray nor a floater inside the object.
        around = np.unique(parts[away < _HOLLOW * size])
        around = around[mass[around] > 0.05 * mass[around].max()]
        best = int(around[np.argmin([away[parts == one].min() for one in around])])
    else:
        best = int(np.argmax(claimed))
        if claimed[best] == 0.0:
            raise UserError(_NOTHING_ABOVE, check=("plane",))
    meant = np.union1d(best, clicked_parts(indices, parts, scene, spec.clicks, size))
    if spec.masks:
        # An object may consist of several parts. Masks select all of them.
        meant = np.union1d(meant, np.flatnonzero(claimed > _MIN_PART_MASS * claimed[best]))
    chosen, small_parts, removed = np.zeros((3, len(core)), bool)
    chosen[indices[np.isin(parts, meant)]] = True
    small_parts[indices[(mass[parts] < _MAX_FLOATER_MASS * mass[best]) & ~chosen[indices]]] = True
    if spec.point is not None:
        chosen[indices[np.isin(parts, detached_parts(scene, indices, parts, meant, size))]] = True
        small_parts &= ~chosen
    nodes = np.flatnonzero(chosen)
    low = FOOTPRINT_HEIGHT * min(size, _diagonal(scene.means[chosen]))
    removed[nodes[removed_by_clicks(scene.cloud, nodes, spec.clicks, scene.heights[nodes], low)]] = True
    chosen &= ~removed
    if not chosen.any():
        raise UserError(_nothing_left("the clicks beside the object remove all of it", int(removed.sum())))
    # Remove distant strays that a huge Gaussian connects to the object, because they would extend the following steps
    # to the whole room.
    chosen &= _within(scene.means, chosen, size)
    # Floaters inside a hollow body would remain in the background as a ghost of it. The body is closed from below by
    # the floor, and by the mirror image of the body in the floor.
    shell = scene.means[chosen]
    if _diagonal(shell) > _MAX_SIZE_RATIO * size:
        # A whole room that is divided into cells for a small object would have too many cells.
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    heights = scene.heights[chosen]
    # An object high above the plane is not closed by the floor, and the shell with its mirror image would span a very
    # large grid.
    if len(shell) and heights.min() < _HANGING * size:
        shell = np.concatenate([shell, shell - 2.0 * (heights[:, None] - foot) * scene.plane.normal])
    chosen |= enclosed(scene.means, shell, 2.0 * size / CELLS) & (scene.heights > foot)
    chosen |= lying & scene.is_under(chosen, 0.1 * size, size)
    # Remove Gaussians that were added by position again if a removed Gaussian is nearer than any Gaussian of the
    # object.
    removed |= nearer_to(scene.means, scene.means[removed], scene.means[chosen & ~removed])
    return chosen & ~removed, small_parts, removed


def _first_size(scene: SceneAbovePlane, claimed_by_user: np.ndarray, spec: ObjectSpec) -> float:
    """Return the first guess of the object's size, scene units; it is half of the capture's size if only a point is
    known."""
    if spec.box is not None:
        return float(np.linalg.norm(spec.box.high - spec.box.low))
    standing = claimed_by_user & scene.is_opaque & (scene.heights > 0.0)
    if not standing.any():
        raise UserError(_NOTHING_ABOVE, check=("plane",))
    return _diagonal(scene.means[standing]) * (0.5 if spec.point is not None and spec.picked is None else 1.0)


def _diagonal(points: np.ndarray) -> float:
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    return float(np.linalg.norm(high - low))


def _within(points: np.ndarray, chosen: np.ndarray, margin: float) -> np.ndarray:
    """Return the mask (n,) bool of those ``points`` (n, 3) that are in the bounding box of nearly all ``chosen`` (n,)
    bool points, enlarged by ``margin``."""
    if not chosen.any():
        return chosen
    low, high = np.quantile(points[chosen], [0.005, 0.995], axis=0)
    return np.all((points >= low - margin) & (points <= high + margin), axis=1)
