"""Colours that are plausible in each region of a hole, derived from the colours of its rim."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from egs_warp.geometry.bitmaps import connected_parts, nearest_set
from egs_warp.geometry.laplace_fill import laplace_fill

_SHADE = 0.1
"""Colours closer to each other than this belong to the same shade."""
_LINE = 5
"""Aperture of the median filter, pixels. Structure narrower than half of this is not tested, because a line may cross a
hole although little of the rim has its colour."""
_COMMON = 0.55
"""Minimum likelihood, relative to the most likely colour, of a colour that may form an island."""
_PATTERN = 0.5
"""Likelihood of the most likely colour below which the floor has a pattern, so that no colour is unusual."""
_TOUCH = 2
"""Distance from an island, in pixels, within which the rim is examined."""
_MAX_ADDED = 12
"""Maximum number of added offsets for one hole."""


class RimColours:
    """Colours of a picture (H, W, 3), grouped into shades, and the likelihood of each shade at the pixels ``domain``
    (n, 2) of a hole.

    The likelihood of a shade at a pixel is the probability that a random walk from the pixel ends at a rim pixel of
    that shade.
    """

    def __init__(self, image: np.ndarray, usable: np.ndarray, domain: np.ndarray) -> None:
        """Compute the likelihoods. ``usable`` (H, W) bool marks the pixels at which the picture is known."""
        rows, columns = nearest_set(usable)
        self._broad = cv2.medianBlur(image[rows, columns], _LINE)
        shades, index = np.unique(np.rint(self._broad / _SHADE).astype(int).reshape(-1, 3), axis=0, return_inverse=True)
        self._shade, self._usable, self._domain = index.reshape(usable.shape), usable, domain
        like = [np.linalg.norm(self._broad - shade, axis=-1) < 1.5 * _SHADE for shade in _SHADE * shades]
        film = laplace_fill(np.stack(like, axis=-1).astype(float), ~usable)[domain[:, 0], domain[:, 1]]
        top = film.max(axis=1, keepdims=True)
        self._common = (film > _COMMON * top) | (top < _PATTERN)

    def common(self, place: np.ndarray) -> np.ndarray:
        """Return the mask (n, k) bool of colours that are common: the colour at pixel ``place`` (n, k, 2) of the
        picture is not unusual at the pixel of the domain."""
        return np.take_along_axis(self._common, self._shade[place[..., 0], place[..., 1]], axis=1)

    def islands(self, place: np.ndarray) -> np.ndarray:
        """Return the mask (n,) bool of pixels of an unusual colour in an island, or in a tongue that is longer than
        wide.

        Each pixel of the domain is painted with the colour at pixel ``place`` (n, 2) of the picture. A region that
        touches the rim in two places is not an island.
        """
        rows, columns = self._domain.T
        painted = self._broad.copy()
        painted[rows, columns] = self._broad[place[:, 0], place[:, 1]]
        odd, hole = np.zeros((2, *self._usable.shape), bool)
        odd[rows, columns] = ~self.common(place[:, None])[:, 0]
        hole[rows, columns] = True
        hole &= ~self._usable
        odd &= hole
        found = np.zeros_like(odd)
        parts, count = connected_parts(odd, corners=True)
        for part in range(1, count + 1):
            here = parts == part
            alike = np.linalg.norm(painted - np.median(painted[here], axis=0), axis=-1) < 2.0 * _SHADE
            regions, _ = connected_parts(hole & (alike | here), corners=True)
            region = regions == regions[here][0]
            contact = ndimage.binary_dilation(region, np.ones((3, 3)), iterations=_TOUCH) & self._usable & alike
            _, contacts = connected_parts(contact, corners=True)
            if contacts == 0 or (contacts == 1 and (contact.sum() / _TOUCH) ** 2 < region.sum()):
                found |= here
        return found[rows, columns]

    def offsets_for(self, uncovered: np.ndarray, is_source: np.ndarray) -> list[np.ndarray]:
        """Return offsets (2,) int under which the sources in ``is_source`` (H, W) give the ``uncovered`` (n,) bool
        pixels common colours. Each offset covers as many pixels as possible."""
        uncovered, found = uncovered.copy(), []
        while uncovered.any() and len(found) < _MAX_ADDED:
            at, common = self._domain[uncovered], self._common[uncovered]
            low, size = at.min(axis=0), np.ptp(at, axis=0) + 1
            if (size > is_source.shape).any():
                break
            total: np.ndarray | float = 0.0
            for shade in np.flatnonzero(common.any(axis=0)):
                pattern = np.zeros(size, np.float32)
                pattern[tuple((at[common[:, shade]] - low).T)] = 1.0
                there = (is_source & (self._shade == shade)).astype(np.float32)
                total = total + cv2.matchTemplate(there, pattern, cv2.TM_CCORR)
            step = np.array(np.unravel_index(np.argmax(total), np.shape(total))) - low
            row, column = (at + step).T
            fits = is_source[row, column] & common[np.arange(len(at)), self._shade[row, column]]
            if not fits.any():
                break
            found.append(step)
            uncovered[np.flatnonzero(uncovered)[fits]] = False
        return found
