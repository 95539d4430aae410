"""Stains on the floor around a hole: the shadow of the removed object, and remnants of its foot in the colours of the
captured floor.

Both are darker than the floor.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from egs_warp.geometry.bitmaps import connected_parts, distance_to
from egs_warp.geometry.laplace_fill import laplace_fill

_BLUR = 2.0
"""Standard deviation in texels of the blur that removes the floor's texture."""
_BROAD = 12.0
"""Standard deviation in texels of the blur for the expected brightness of the floor; it is large, because light changes
slowly."""
_DARKER = 0.2
"""Minimum darkening of a stain, as a difference of the natural logarithm of brightness. Weaker darkening is hardly
visible."""
_SHADE, _SHADE_BLUR = 0.1, 4.0
"""Difference of the natural logarithm of brightness, and standard deviation of a blur in texels. Floor whose blurred
brightness is lower than predicted by more than this difference is not copied."""
_END = 4.0
"""Distance from the floor's edge in texels that the shadow of an object in the hole does not reach."""
_UNUSUAL = 3.0
"""Threshold of darkening, in robust standard deviations of the floor far from the hole. Weaker darkening is part of the
floor's pattern."""
_ALIKE, _COMMON = 0.1, 0.02
"""Maximum difference of the natural logarithm, in every channel, of colours that are considered equal; and the minimum
fraction of the floor far from the hole that has a colour of the floor's pattern, such as the blue of a checked
cloth."""
_SAMPLE = 2000
"""Maximum number of texels of the floor from which common colours are determined."""
_MIN_BRIGHTNESS = 0.02
"""Fraction of full brightness below which colours are not distinguished."""
_EVERY = 3
"""Sampling step, texels."""
_ROUNDS = 4
"""Maximum number of search rounds. The floor from which brightness is predicted may itself be stained until a round has
added that stain to the hole."""
_FEW = 20
"""Minimum number of texels that a round must add for the search to continue."""
_REACH = 60.0
"""Maximum distance of a stain's texels from the hole, in texels: half of the hole's side."""
_MAX_AREA = 2.0
"""Maximum area of a stain, as a multiple of the hole's area; a larger region is another part of the floor."""


def stain_around(hole: np.ndarray, known: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the mask (rows, columns) bool of the stained floor.

    A stain is connected to the hole and, in at least one channel, darker than predicted from the floor farther out. The
    prediction uses the half of the floor that is farther from the hole; this half is never stained. Regions that extend
    from the hole by more than half of its side are not stains, and the result is empty if the stain exceeds twice the
    hole's area.

    Args:
        hole: (rows, columns) bool.
        known: (rows, columns) bool, the visible floor.
        colour: (rows, columns, 3) colour of the floor, 0 to 1.
    """
    stain, away = np.zeros_like(hole), distance_to(hole)
    for _ in range(_ROUNDS):
        more = _next_to(hole | stain, known, colour) & ~stain
        # Regions that extend farther are seams between planks, or a different floor.
        parts, _ = connected_parts(more | stain)
        more &= ~np.isin(parts, np.unique(parts[(more | stain) & (away > _REACH)]))
        stain |= more
        if stain.sum() > _MAX_AREA * hole.sum():
            return np.zeros_like(hole)
        if more.sum() < _FEW:
            break
    return stain


def _next_to(hole: np.ndarray, known: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the mask (rows, columns) bool of the stained floor in the half that is nearer to the hole."""
    floor = known & ~hole
    if not floor.any():
        return np.zeros_like(hole)
    far, brightness, off = _unexpected(floor, hole, colour, _BLUR)
    usual = 1.4826 * np.median(np.abs(off[far]), axis=0)
    dark = floor & ~far & (off < -np.maximum(_DARKER, _UNUSUAL * usual)).any(axis=-1)
    if not dark.any():
        return dark
    # Judge each part as a whole: in a shadow on gravel, some texels have the colour of a lit pebble.
    parts, count = connected_parts(dark)
    like_floor = np.bincount(parts[dark], _common(brightness[dark], brightness[far]), count + 1)
    dark &= (like_floor < 0.5 * np.bincount(parts[dark], minlength=count + 1))[parts]
    parts, _ = connected_parts(dark | hole)
    return dark & np.isin(parts, np.unique(parts[hole]))


def shaded(hole: np.ndarray, known: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the mask (rows, columns) bool of the part of the ``known`` (rows, columns) floor whose mean brightness is
    lower than predicted from the floor farther from the ``hole`` (rows, columns).

    This part need not be a stain, but copies of it would look like shadows on lit floor.
    """
    floor = known & ~hole
    if not floor.any():
        return np.zeros_like(hole)
    _, _, off = _unexpected(floor, hole, colour, _SHADE_BLUR)
    shade = floor & (off.mean(axis=-1) < -_SHADE)
    # A seam or a dark plank extends to the edge of the floor.
    parts, _ = connected_parts(shade)
    end = distance_to(np.pad(~(known | hole), 1, constant_values=True))[1:-1, 1:-1] <= _END
    return shade & ~np.isin(parts, np.unique(parts[shade & end]))


def _unexpected(
    floor: np.ndarray, hole: np.ndarray, colour: np.ndarray, blur: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare the brightness of the floor with the prediction from its farther half.

    Returns the mask (rows, columns) bool of the half of the ``floor`` (rows, columns) farther from the ``hole``; the
    natural logarithm (rows, columns, 3) of ``colour`` (rows, columns, 3) after a ``blur`` (texels); and the excess
    (rows, columns, 3) of this logarithm over the prediction.
    """
    away = distance_to(hole)
    far = floor & (away >= np.median(away[floor]))
    brightness = np.log(np.maximum(_blurred(colour, floor, blur), _MIN_BRIGHTNESS))
    return far, brightness, brightness - _extended(_blurred(brightness, far, _BROAD), far)


def _common(colours: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Return the mask (n,) bool of ``colours`` (n, 3) that are common among the colours ``floor`` (m, 3); all are
    logarithms."""
    few = floor[:: -(-len(floor) // _SAMPLE)]
    alike = KDTree(few).query_ball_point(colours, _ALIKE, p=np.inf, return_length=True)
    return np.asarray(alike) >= _COMMON * len(few)


def _extended(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Extend smooth ``values`` (rows, columns, 3) from the ``known`` (rows, columns) bool texels to all others by
    Laplace's equation, solved on every third row and column."""
    few = (slice(None, None, _EVERY),) * 2
    film = laplace_fill(np.where(known[few][..., None], values[few], 0.0), ~known[few])
    whole = cv2.resize(film, known.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], values, whole)


def _blurred(values: np.ndarray, known: np.ndarray, width: float) -> np.ndarray:
    """Blur ``values`` (rows, columns, 3), which are valid where ``known`` (rows, columns) bool is set, by a Gaussian of
    ``width`` texels."""
    share = ndimage.gaussian_filter(known.astype(np.float64), width)
    sums = ndimage.gaussian_filter(np.where(known[..., None], values, 0.0).astype(np.float64), (width, width, 0.0))
    return sums / np.maximum(share, 1e-3)[..., None]
