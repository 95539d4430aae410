"""What an object leaves on the floor around the hole under it: the shadow that it cast, and shreds of its foot that the
capture has painted onto the floor. Both are darker than the floor is there.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from egs_warp.geometry.bitmaps import connected_parts, distance_to
from egs_warp.geometry.laplace_fill import laplace_fill

_BLUR = 2.0
"""Texels: standard deviation of the blur that takes the floor's texture out."""
_BROAD = 12.0
"""Texels: the same of what the floor is taken to look like from place to place; light changes slowly."""
_DARKER = 0.2
"""Natural logarithm: what is less dark than this is a shade that no one minds."""
_SHADE, _SHADE_BLUR = 0.1, 4.0
"""Natural logarithm, and texels: what is darker than that, after such a blur, is not copied from."""
_END = 4.0
"""Texels from where the floor ends: no shade of what stood in the hole reaches there."""
_UNUSUAL = 3.0
"""Standard deviations (robust) of the floor far from the hole, from place to place: a pattern is no stain."""
_ALIKE, _COMMON = 0.1, 0.02
"""Natural logarithm, in all channels: colours nearer than this are the same. What has the colour of this share of the
floor far from the hole is part of a pattern, as the blue of a checked cloth is.
"""
_SAMPLE = 2000
"""Texels of the floor that tell which colours are common."""
_DARKEST = 0.02
"""Of full brightness: darker colours are alike."""
_EVERY = 3
"""Texels."""
_ROUNDS = 4
"""What is far from the hole may be stained, too, until the stain is part of the hole."""
_FEW = 20
"""Texels: the rest of a stain that is not worth another round."""
_REACH = 60.0
"""Texels, half of the hole's side: no stain is followed further from the hole."""
_MOST = 2.0
"""Of the hole's area: what is larger is another part of the floor, not a stain on it."""


def stain_around(hole: np.ndarray, known: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: the part of the ``known`` (rows, columns) floor that hangs together with the ``hole``
    (rows, columns) and is darker there, in any of its ``colour``'s channels (rows, columns, 3), than the floor further
    out lets expect. The half of the floor that is further from the hole tells what to expect, and none of it is
    stained; nothing is what reaches further than half of the hole's side, or where more than twice the hole would be.
    """
    stain, away = np.zeros_like(hole), distance_to(hole)
    for _ in range(_ROUNDS):
        more = _next_to(hole | stain, known, colour) & ~stain
        # What goes on beyond that is a seam between planks, or another floor.
        parts, _ = connected_parts(more | stain)
        more &= ~np.isin(parts, np.unique(parts[(more | stain) & (away > _REACH)]))
        stain |= more
        if stain.sum() > _MOST * hole.sum():
            return np.zeros_like(hole)
        if more.sum() < _FEW:
            break
    return stain


def _next_to(hole: np.ndarray, known: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: what is stained in the half of the floor that is nearer to the hole."""
    floor = known & ~hole
    if not floor.any():
        return np.zeros_like(hole)
    far, brightness, off = _unexpected(floor, hole, colour, _BLUR)
    usual = 1.4826 * np.median(np.abs(off[far]), axis=0)
    dark = floor & ~far & (off < -np.maximum(_DARKER, _UNUSUAL * usual)).any(axis=-1)
    if not dark.any():
        return dark
    # A part is judged as a whole: of a shadow on gravel some texels have the colour of a pebble in the light.
    parts, count = connected_parts(dark)
    like_floor = np.bincount(parts[dark], _common(brightness[dark], brightness[far]), count + 1)
    dark &= (like_floor < 0.5 * np.bincount(parts[dark], minlength=count + 1))[parts]
    parts, _ = connected_parts(dark | hole)
    return dark & np.isin(parts, np.unique(parts[hole]))


def shaded(hole: np.ndarray, known: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: the part of the ``known`` (rows, columns) floor that is darker, as a whole, than the floor
    further from the ``hole`` (rows, columns) lets expect, though it may be no stain. What is copied from there takes
    shadows into places that had none."""
    floor = known & ~hole
    if not floor.any():
        return np.zeros_like(hole)
    _, _, off = _unexpected(floor, hole, colour, _SHADE_BLUR)
    shade = floor & (off.mean(axis=-1) < -_SHADE)
    # A seam or a dark plank goes on as far as the floor does.
    parts, _ = connected_parts(shade)
    end = distance_to(np.pad(~(known | hole), 1, constant_values=True))[1:-1, 1:-1] <= _END
    return shade & ~np.isin(parts, np.unique(parts[shade & end]))


def _unexpected(
    floor: np.ndarray, hole: np.ndarray, colour: np.ndarray, blur: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns) bool: the half of the ``floor`` (rows, columns) that is further from the ``hole``; (rows,
    columns, 3) natural logarithm of the ``colour`` (rows, columns, 3) after a ``blur`` (texels); and (rows, columns, 3)
    how much that is above what the further half lets expect."""
    away = distance_to(hole)
    far = floor & (away >= np.median(away[floor]))
    brightness = np.log(np.maximum(_blurred(colour, floor, blur), _DARKEST))
    return far, brightness, brightness - _carried_on(_blurred(brightness, far, _BROAD), far)


def _common(colours: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(n,) bool: those of the ``colours`` (n, 3) that many of the ``floor`` (m, 3) have, all of them logarithms."""
    few = floor[:: -(-len(floor) // _SAMPLE)]
    alike = KDTree(few).query_ball_point(colours, _ALIKE, p=np.inf, return_length=True)
    return np.asarray(alike) >= _COMMON * len(few)


def _carried_on(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Smooth ``values`` (rows, columns, 3) from where they are ``known`` (rows, columns) bool, as a soap film; solved
    on every third row and column, which is enough for what is smooth.
    """
    few = (slice(None, None, _EVERY),) * 2
    film = laplace_fill(np.where(known[few][..., None], values[few], 0.0), ~known[few])
    whole = cv2.resize(film, known.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], values, whole)


def _blurred(values: np.ndarray, known: np.ndarray, width: float) -> np.ndarray:
    """``values`` (rows, columns, 3) blurred by a normal distribution of ``width`` texels, those only that are ``known``
    (rows, columns) bool.
    """
    share = ndimage.gaussian_filter(known.astype(np.float64), width)
    sums = ndimage.gaussian_filter(np.where(known[..., None], values, 0.0).astype(np.float64), (width, width, 0.0))
    return sums / np.maximum(share, 1e-3)[..., None]
