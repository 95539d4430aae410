"""Selection of the offset from which each pixel of a hole is copied: a few good offsets, assigned by graph cuts.

Sources: He and Sun 2012 (statistics of offsets), Kwatra et al. 2003 (cost of a seam), Boykov, Veksler, Zabih 2001
(expansion moves).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from egs_warp.geometry.bitmaps import connected_parts, depth_inside
from egs_warp.inpainting.rim_colours import RimColours

_PIECES = (5, 10)
"""Radii, in pixels, of the parts of the rim that are matched to similar regions, in addition to the whole rim."""
_RING = 6
"""Width in pixels of the compared ring around the hole."""
_MIN_PIXELS = 15
"""Minimum number of pixels in a part of the rim."""
_OFFSETS_PER_PIXEL = 3
"""Number of best offsets that are determined for each pixel; an offset that is not among the best of any pixel is
discarded."""
_RIM = 3
"""Width in pixels of the rim around the hole that a copy must also match."""
_COST_UNIT = 2000.0
"""Capacities are integers; one unit is a colour difference of 1 / 2000."""
_PRIOR = 0.5
"""Weight of the agreement of an offset with the known surroundings of a pixel, relative to the cost of seams."""
_SEAM = 0.03
"""Cost of a seam that is not visible, as a colour difference; it favours large copied regions."""
_SWEEPS = 3
"""Maximum number of rounds of expansion over all offsets."""
_ATTEMPTS = 4
"""Maximum number of attempts to fill the hole without islands of colours that do not occur on its rim."""
_ALIKE = 0.05
"""Mean colour difference around a pixel below which an offset may paint the pixel in any colour, because the picture
repeats there."""
_FORBIDDEN = 50_000_000
_PREPARED = 0.6
"""Fraction of the processor time for computing the costs of the offsets; the rest is for choosing among the offsets.
Measured on a CPU: 0.55 for the koala and 0.7 for the fox."""


@dataclass(frozen=True)
class Offsets:
    """Candidate offsets to copy from."""

    steps: np.ndarray
    """(k, 2) int, rows and columns from a pixel to its source."""
    shifts: np.ndarray
    """(k, 3) float32, colour that is added to the colour of the source."""


def labelled_sources(
    image: np.ndarray,
    hole: np.ndarray,
    known: np.ndarray,
    is_source: np.ndarray,
    *,
    shift_limit: float,
    progress: Callable[[float], None] = lambda done: None,
) -> np.ndarray:
    """Choose the source of every pixel of ``hole`` and its rim so that the seams are as invisible as possible.

    All other pixels, and the pixels of holes whose surroundings contain no repetition, are their own sources.

    Args:
        image: (H, W, 3) float32.
        hole: (H, W) bool.
        known: (H, W) bool; ``image`` is valid where ``known`` and not ``hole``.
        is_source: (H, W) bool, allowed sources.
        shift_limit: maximum change of a copied colour.
        progress: called with the approximate finished fraction.

    Returns:
        (H, W, 2) int, row and column of each source.
    """
    place = np.moveaxis(np.indices(hole.shape), 0, -1)
    sources = place.copy()
    parts, count = connected_parts(ndimage.binary_dilation(hole, np.ones((3, 3)), iterations=_RIM), corners=True)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    ends = np.cumsum(sizes[1:]) / max(sizes[1:].sum(), 1)
    for part in range(1, count + 1):
        here = parts == part
        start, end = (float(ends[part - 2]) if part > 1 else 0.0), float(ends[part - 1])
        show_part = lambda done, start=start, end=end: progress(start + (end - start) * done)  # noqa: E731
        offsets = _candidates(image, hole & here, hole, known, shift_limit)
        if len(offsets.steps) == 0:
            continue
        domain = np.argwhere(here & (hole | known))
        sources[domain[:, 0], domain[:, 1]] = domain + _label(image, hole, known, is_source, domain, offsets, show_part)
    return sources


def _candidates(image: np.ndarray, part: np.ndarray, hole: np.ndarray, known: np.ndarray, limit: float) -> Offsets:
    """Return the offsets under which parts of the rim of ``part``, of several sizes, are most similar to other
    regions."""
    usable = (known & ~hole).astype(np.float32)
    rim = np.argwhere(np.logical_and(ndimage.binary_dilation(part), usable > 0.0))
    found: dict[tuple[int, int], np.ndarray] = {}
    middle = np.argwhere(part).mean(axis=0).astype(int)
    whole = int(np.ptp(np.argwhere(part), axis=0).max() // 2 + _RING)
    places = [(middle, whole, 10)]
    for radius in _PIECES:
        places += [(centre, radius, 3) for centre in _spread_out(rim, max(radius, len(rim) / 10.0))]
    for centre, radius, count in places:
        for step, shift in _alike(image, part, usable, centre, radius, count, limit):
            found.setdefault((int(step[0]), int(step[1])), shift)
    return Offsets(
        np.array(list(found), dtype=int).reshape(-1, 2), np.array(list(found.values()), np.float32).reshape(-1, 3)
    )


def _spread_out(points: np.ndarray, spacing: float) -> np.ndarray:
    """Return a subset of ``points`` (n, 2) such that its points are at least ``spacing`` apart and every other point is
    within ``spacing`` of one of them."""
    left, chosen = points, []
    while len(left):
        chosen.append(left[0])
        left = left[np.linalg.norm(left - left[0], axis=1) > spacing]
    return np.array(chosen).reshape(-1, 2)


def _alike(
    image: np.ndarray, part: np.ndarray, usable: np.ndarray, centre: np.ndarray, radius: int, count: int, limit: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ``count`` offsets, and the colour shift of each, for which the known pixels within ``radius`` of
    ``centre`` and near ``part`` best match other regions."""
    low = np.maximum(centre - radius, 0)
    high = np.minimum(centre + radius + 1, part.shape)
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    mask = ndimage.binary_dilation(part[window], iterations=_RING).astype(np.float32) * usable[window]
    total = float(mask.sum())
    if total < _MIN_PIXELS:
        return []
    template = image[window]
    score = cv2.matchTemplate(image, template, cv2.TM_SQDIFF, mask=np.repeat(mask[..., None], 3, axis=2))
    # Exclude positions at which a required pixel would be read from an unknown one.
    missing = cv2.matchTemplate(1.0 - usable, np.maximum(mask, part[window].astype(np.float32)), cv2.TM_CCORR)
    score[missing > 0.5] = np.inf
    found = []
    for _ in range(count):
        best = np.unravel_index(np.argmin(score), score.shape)
        if not np.isfinite(score[best]):
            break
        there = image[best[0] : best[0] + mask.shape[0], best[1] : best[1] + mask.shape[1]]
        shift = np.einsum("ij,ijk->k", mask, template - there) / total
        found.append((np.array(best) - low, np.clip(shift, -limit, limit)))
        score[max(best[0] - 2, 0) : best[0] + 3, max(best[1] - 2, 0) : best[1] + 3] = np.inf
    return found


def _label(
    image: np.ndarray,
    hole: np.ndarray,
    known: np.ndarray,
    is_source: np.ndarray,
    domain: np.ndarray,
    offsets: Offsets,
    progress: Callable[[float], None],
) -> np.ndarray:
    """Return the offset (n, 2) of each pixel of ``domain`` (n, 2), found by expansion moves over ``offsets`` and over
    additional offsets that provide missing colours."""
    in_hole = hole[domain[:, 0], domain[:, 1]]
    colours = RimColours(image, known & ~hole, domain)
    place, allowed = _places(domain, offsets, is_source)
    covered = (allowed & colours.common(place)).any(axis=1)
    added = colours.offsets_for(in_hole & ~covered, is_source)
    if added:
        offsets = Offsets(
            np.concatenate([offsets.steps, added]),
            np.concatenate([offsets.shifts, np.zeros((len(added), 3), np.float32)]),
        )
        place, allowed = _places(domain, offsets, is_source)
    colour = image[place[..., 0], place[..., 1]] + offsets.shifts
    copy_error = np.linalg.norm(colour - image[domain[:, 0], domain[:, 1]][:, None], axis=-1)
    within = _PRIOR * _surround_error(image, hole, known, domain, offsets)
    data = _COST_UNIT * np.where(in_hole[:, None], within, copy_error)
    data = np.where(allowed, data, _FORBIDDEN).astype(np.int64)
    ranked = np.argsort(data, axis=1, kind="stable")[:, :_OFFSETS_PER_PIXEL]
    retained = np.unique(
        np.concatenate([ranked.ravel(), np.arange(len(offsets.steps) - len(added), len(offsets.steps))])
    )
    data, colour, place = data[:, retained], colour[:, retained], place[:, retained]
    index = np.full(hole.shape, -1)
    index[domain[:, 0], domain[:, 1]] = np.arange(len(domain))
    pairs = []
    for step in ((0, 1), (1, 0)):
        there = domain + np.array(step)
        inside = (there < hole.shape).all(axis=1)
        other = np.full(len(domain), -1)
        other[inside] = index[there[inside, 0], there[inside, 1]]
        pairs.append(np.stack([np.flatnonzero(other >= 0), other[other >= 0]], axis=1))
    p, q = np.concatenate(pairs).T

    progress(_PREPARED)
    labels, every = np.argmin(data, axis=1), np.arange(len(domain))
    common = colours.common(place)
    for attempt in range(_ATTEMPTS):
        labels = _expanded(labels, data, colour, p, q)
        # One or two attempts suffice for most holes.
        progress(1.0 - (1.0 - _PREPARED) * 0.3 ** (attempt + 1))
        islands = in_hole & colours.islands(place[every, labels]) & (common & (data < _FORBIDDEN)).any(axis=1)
        islands &= data[every, labels] > _ALIKE * _PRIOR * _COST_UNIT
        if not islands.any():
            break
        data[islands[:, None] & ~common] = _FORBIDDEN
    return offsets.steps[retained[labels]]


def _expanded(labels: np.ndarray, data: np.ndarray, colour: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Improve ``labels`` (n,) by expansion moves.

    Args:
        labels: (n,) initial labels.
        data: (n, k) cost of each label.
        colour: (n, k, 3) colour that each label paints.
        p: (m,) first pixel of each pair of neighbours.
        q: (m,) second pixel of each pair.
    """

    def seam(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        cost = np.linalg.norm(colour[p, a] - colour[p, b], axis=-1) + np.linalg.norm(
            colour[q, a] - colour[q, b], axis=-1
        )
        return np.where(a == b, 0, np.rint(_COST_UNIT * (cost + _SEAM))).astype(np.int64)

    count = len(labels)
    every = np.arange(count)

    def energy(labels: np.ndarray) -> int:
        return int(data[every, labels].sum() + seam(labels[p], labels[q]).sum())

    lowest = energy(labels)
    for _ in range(_SWEEPS):
        before = lowest
        for label in range(data.shape[1]):
            new = np.full(len(p), label)
            e00, e01, e10 = seam(labels[p], labels[q]), seam(labels[p], new), seam(new, labels[q])
            unary = data[:, label] - data[every, labels]
            unary = unary + np.bincount(p, e10 - e00, count) - np.bincount(q, e10, count)
            moved = _cut(np.clip(unary, -_FORBIDDEN, _FORBIDDEN), p, q, np.maximum(e01 + e10 - e00, 0))
            candidate = np.where(moved, label, labels)
            value = energy(candidate)
            if value < lowest:
                labels, lowest = candidate, value
        if lowest == before:
            break
    return labels


def _places(domain: np.ndarray, offsets: Offsets, is_source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the source (n, k, 2) of each pixel at each offset, clipped to the picture, and the mask (n, k) bool of
    allowed sources."""
    place = domain[:, None] + offsets.steps[None]
    bounded = np.clip(place, 0, np.array(is_source.shape) - 1)
    return bounded, (place == bounded).all(axis=-1) & is_source[bounded[..., 0], bounded[..., 1]]


def _surround_error(
    image: np.ndarray, hole: np.ndarray, known: np.ndarray, domain: np.ndarray, offsets: Offsets
) -> np.ndarray:
    """Return the mean colour difference (n, k) of each offset over the known surroundings of each pixel of ``domain``
    (n, 2)."""
    width = float(depth_inside(hole).max())
    margin = int(2 * width) + 4
    low = np.maximum(domain.min(axis=0) - margin, 0)
    high = np.minimum(domain.max(axis=0) + margin + 1, hole.shape)
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    usable = known & ~hole
    place = np.moveaxis(np.indices(hole.shape), 0, -1)[window]
    at = domain - low
    result = np.zeros((len(domain), len(offsets.steps)))
    for k, (step, shift) in enumerate(zip(offsets.steps, offsets.shifts, strict=True)):
        there = place + step
        bounded = np.clip(there, 0, np.array(hole.shape) - 1)
        both = usable[window] & (there == bounded).all(axis=-1) & usable[bounded[..., 0], bounded[..., 1]]
        off = np.linalg.norm(image[bounded[..., 0], bounded[..., 1]] + shift - image[window], axis=-1)
        weight = cv2.GaussianBlur(both.astype(np.float32), (0, 0), width)
        total = cv2.GaussianBlur(np.where(both, off, 0.0).astype(np.float32), (0, 0), width)
        result[:, k] = np.where(weight > 1e-3, total / np.maximum(weight, 1e-3), 1.0)[at[:, 0], at[:, 1]]
    return result


def _cut(unary: np.ndarray, p: np.ndarray, q: np.ndarray, pairwise: np.ndarray) -> np.ndarray:
    """Return the labels x (n,) bool that minimise sum unary x + sum pairwise (1 - x_p) x_q, computed by maximum
    flow."""
    count = len(unary)
    source, sink = count, count + 1
    plus, minus = np.flatnonzero(unary > 0), np.flatnonzero(unary < 0)
    rows = np.concatenate([np.full(len(plus), source), minus, p])
    columns = np.concatenate([plus, np.full(len(minus), sink), q])
    capacity = np.concatenate([unary[plus], -unary[minus], pairwise]).astype(np.int32)
    graph = sparse.csr_matrix((capacity, (rows, columns)), shape=(count + 2, count + 2))
    flow = csgraph.maximum_flow(graph, source, sink).flow
    rest = graph - flow
    rest.data = np.maximum(rest.data, 0)
    rest.eliminate_zeros()
    reached = np.zeros(count + 2, bool)
    reached[csgraph.breadth_first_order(rest, source, return_predecessors=False)] = True
    return ~reached[:count]
