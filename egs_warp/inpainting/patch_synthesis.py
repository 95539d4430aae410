"""Patch-based inpainting, which copies from the rest of the picture: patch search and voting over a pyramid.

Sources: Wexler, Shechtman, Irani 2007 (voting over scales); Barnes et al. 2009 (PatchMatch); He and Sun 2012 (few good
offsets as a start); Darabi et al. 2012 (a colour shift for each patch, so that light may change across the hole). The
kernels are in ``egs_warp/kernels/inpainting/patch_synthesis.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import depth_inside, nearest_set
from egs_warp.inpainting.offset_labels import labelled_sources
from egs_warp.kernels.inpainting.patch_synthesis import RADIUS, search_kernel, vote_kernel
from egs_warp.launching import launch_rows, zeros

_RIM_FACTOR = 1.4
"""Ratio of the number of target patches to the number of pixels of the hole, at the coarsest level."""
_COARSEST_HALF_WIDTH = 16.0
"""Half width, in pixels, of the hole at the coarsest level, where offsets are chosen."""
_STRIDES = (8, 4, 2, 1, 8, 4, 2, 1)
"""Distances, in pixels, of the neighbours whose sources are tried in one search."""
_TOLERANCE = 0.5
"""Cost, as a multiple of the median cost, at which a patch has the weight 1/e."""
_MIN_LIT_FRACTION = 0.5
"""Minimum fraction of the sources that must remain when shaded sources are excluded."""
_SCREEN = 0.01
"""Weight of the voted colours relative to the gradients of the sources. The colours dominate beyond about 1 /
sqrt(weight) pixels."""
_STRICT_TOLERANCE = 0.25
"""Tolerance of the last vote at each level; it is smaller, so that the result is as sharp as its sources."""
_SEARCH_TIME = 16e-6
"""Processor time of one search per target patch, s."""
_START_COST = 55.0
"""Ratio of two processor times per target patch: choosing the offsets at the coarsest level (0.88 ms on a CPU, measured
for the koala and the fox), and one search (16 us)."""


@dataclass(frozen=True)
class PatchSynthesis:
    """Default inpainter: patch search and voting over a pyramid."""

    rounds: int = 4
    """Rounds of search and voting at each level."""
    shift_limit: float = 0.02
    """Maximum change of a patch's colour, 0 to 1. A large value would change one colour of a pattern into another."""
    seed: int = 0
    device: str | None = None

    def fill(
        self,
        image: np.ndarray,
        hole: np.ndarray,
        known: np.ndarray,
        shade: np.ndarray | None = None,
        *,
        progress: Callable[[float], None] = lambda done: None,
    ) -> np.ndarray:
        """Fill the hole; see ``Inpainter.fill``. Raises ``UserError`` if no whole patch is known outside the hole."""
        work = None
        wide = _with_half_turn(image, hole, known, np.zeros_like(hole) if shade is None else shade)
        levels = [level for level in reversed(_pyramid(*wide)) if level.is_source.any()]
        searches = [float(level.targets.sum()) for level in levels]
        start_cost = _START_COST * searches[0] if searches else 0.0
        total, finished = start_cost + self.rounds * sum(searches), start_cost
        for depth, (level, cost) in enumerate(zip(levels, searches, strict=True)):
            # Each level starts from its own pixels, copied from the sources that the coarser level found. The enlarged
            # picture of the coarser level would be blurred and attract blurred patches.
            if work is None:
                started = lambda done: progress(start_cost * done / total)  # noqa: E731
                sources = _start(level, self.shift_limit, started)
            else:
                sources = _doubled(work.sources(), level)
            work = _Work(level, sources, self)
            work.copy()
            for number in range(self.rounds):
                work.search(seed=self.seed + 100 * depth + number)
                work.vote(_TOLERANCE if number < self.rounds - 1 else _STRICT_TOLERANCE)
                finished += cost
                progress(finished / total)
        if work is None:
            raise UserError(
                f"inpaint: no piece of {2 * RADIUS + 1} x {2 * RADIUS + 1} texels is known around the hole;"
                " make the hole smaller or show more of the floor"
            )
        _, wide_hole, wide_known, _ = wide
        blended = poisson_blend(work.picture, wide_hole, wide_known | wide_hole, work.sources())[:, : hole.shape[1]]
        return np.where(hole[..., None], np.clip(blended, 0.0, 1.0), image).astype(np.float32)


def painting_time(pixels: float, depth: float, source_depth: float = math.inf) -> float:
    """Return the expected processor time of ``PatchSynthesis.fill`` on a CPU, s.

    Args:
        pixels: number of pixels of the hole.
        depth: half width of the hole, pixels.
        source_depth: half width of the widest known part, pixels. Levels at which this part is narrower than a patch
            are not used.
    """
    wanted = math.ceil(math.log2(max(depth, 1.0) / _COARSEST_HALF_WIDTH))
    usable = 30 if math.isinf(source_depth) else math.floor(math.log2(max(source_depth, 1.0) / (RADIUS + 1)))
    halvings = max(0, min(wanted, usable))
    coarsest = _RIM_FACTOR * pixels / 4.0**halvings
    searches = PatchSynthesis().rounds * sum(pixels / 4.0**level for level in range(halvings + 1))
    return _SEARCH_TIME * (_START_COST * coarsest + searches)


@dataclass(frozen=True)
class _Level:
    image: np.ndarray
    hole: np.ndarray
    known: np.ndarray
    is_source: np.ndarray
    targets: np.ndarray
    confidence: np.ndarray
    shade: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, hole: np.ndarray, known: np.ndarray, shade: np.ndarray) -> _Level:
        square = np.ones((2 * RADIUS + 1, 2 * RADIUS + 1), bool)
        usable = known & ~hole
        is_source = ndimage.binary_erosion(usable, square, border_value=0)
        lit = is_source & ~shade
        if lit.sum() >= _MIN_LIT_FRACTION * is_source.sum():
            is_source = lit
        targets = ndimage.binary_dilation(hole, square)
        # Far inside the hole, the current colours have less weight than near the rim.
        confidence = np.where(hole, 1.3 ** -depth_inside(hole), np.where(known, 1.0, 0.0))
        return cls(image, hole, known, is_source, targets, np.maximum(confidence, 1e-4).astype(np.float32), shade)


def _pyramid(image: np.ndarray, hole: np.ndarray, known: np.ndarray, shade: np.ndarray) -> list[_Level]:
    """Return the levels, finest first; each has half the resolution of the previous one."""
    levels = [_Level.of(image.astype(np.float32), hole, known, shade)]
    while depth_inside(np.pad(levels[-1].hole, 1)).max() > _COARSEST_HALF_WIDTH:
        fine = levels[-1]
        size = (-(-fine.hole.shape[0] // 2), -(-fine.hole.shape[1] // 2))
        weight = (fine.known & ~fine.hole).astype(np.float32)
        share = cv2.resize(weight, size[::-1], interpolation=cv2.INTER_AREA)
        colour = cv2.resize(fine.image * weight[..., None], size[::-1], interpolation=cv2.INTER_AREA)
        coarse_hole = cv2.resize(fine.hole.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA) > 0.25
        coarse_known = (share > 0.5) & ~coarse_hole
        coarse = np.where(coarse_known[..., None], colour / np.maximum(share, 1e-3)[..., None], 0.0)
        coarse_shade = cv2.resize(fine.shade.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA) > 0.5
        levels.append(_Level.of(coarse.astype(np.float32), coarse_hole, coarse_known, coarse_shade))
    return levels


def _with_half_turn(
    image: np.ndarray, hole: np.ndarray, known: np.ndarray, shade: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Append the picture rotated by 180 degrees, as a source of patches.

    An edge or a corner often matches only a region of the opposite orientation. A strip between the two pictures
    prevents patches from spanning both.
    """

    def side_by_side(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        strip = np.zeros((first.shape[0], 2 * RADIUS, *first.shape[2:]), first.dtype)
        return np.concatenate([first, strip, second[::-1, ::-1]], axis=1)

    wide = side_by_side(image, image), side_by_side(hole, np.zeros_like(hole)), side_by_side(known, known & ~hole)
    return *wide, side_by_side(shade, shade)


def _start(level: _Level, shift_limit: float, progress: Callable[[float], None]) -> np.ndarray:
    """Return for each pixel a source (H, W, 2) int32 around which a whole patch is known, from the offsets that match
    the rim."""
    sources = labelled_sources(
        level.image, level.hole, level.known, level.is_source, shift_limit=shift_limit, progress=progress
    )
    return _with_whole_patches(sources, level)


def _doubled(sources: np.ndarray, level: _Level) -> np.ndarray:
    """Return the sources of the coarser level, transferred to ``level``."""
    rows, columns = np.indices(level.hole.shape)
    coarse = sources[np.minimum(rows // 2, sources.shape[0] - 1), np.minimum(columns // 2, sources.shape[1] - 1)]
    return _with_whole_patches(2 * coarse + np.stack([rows % 2, columns % 2], axis=-1), level)


def _with_whole_patches(sources: np.ndarray, level: _Level) -> np.ndarray:
    """Return each source, or the nearest one around which a whole patch is known."""
    nearest = nearest_set(level.is_source)
    inside = np.clip(sources, 0, np.array(level.hole.shape) - 1)
    return np.stack([nearest[k][inside[..., 0], inside[..., 1]] for k in (0, 1)], axis=-1).astype(np.int32)


def poisson_blend(picture: np.ndarray, hole: np.ndarray, known: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Return the ``picture`` (H, W, 3) with the gradients of its ``sources`` (H, W, 2) in the ``hole`` (H, W) bool.

    Solving the screened Poisson equation (Bhat et al. 2008) joins regions of different illumination without a seam.
    """
    at = np.argwhere(hole)
    index = np.full(hole.shape, -1)
    index[hole] = np.arange(len(at))
    source = sources[hole]
    matrix_rows, matrix_columns, matrix_values = [np.arange(len(at))], [np.arange(len(at))], [np.full(len(at), _SCREEN)]
    right = _SCREEN * picture[hole].astype(np.float64)
    limit = np.array(hole.shape) - 1
    for step in np.array([(0, 1), (1, 0), (0, -1), (-1, 0)]):
        there = np.clip(at + step, 0, limit)
        inside = (there == at + step).all(axis=1) & known[there[:, 0], there[:, 1]]
        ahead = np.clip(source + step, 0, limit)
        rise = picture[ahead[:, 0], ahead[:, 1]].astype(np.float64) - picture[source[:, 0], source[:, 1]]
        other = index[there[:, 0], there[:, 1]]
        free = inside & (other >= 0)
        # Between two pixels of the hole, the gradient is the mean of the gradients at both sources.
        from_other = sources[there[:, 0], there[:, 1]]
        behind = np.clip(from_other - step, 0, limit)
        of_other = picture[from_other[:, 0], from_other[:, 1]].astype(np.float64) - picture[behind[:, 0], behind[:, 1]]
        rise = np.where(free[:, None], 0.5 * (rise + of_other), rise)
        right -= np.where(inside[:, None], rise, 0.0)
        fixed = inside & (other < 0)
        right[fixed] += picture[there[fixed, 0], there[fixed, 1]]
        row = np.flatnonzero(inside)
        matrix_rows += [row, np.flatnonzero(free)]
        matrix_columns += [row, other[free]]
        matrix_values += [np.ones(len(row)), np.full(int(free.sum()), -1.0)]
    matrix = sparse.coo_array(
        (np.concatenate(matrix_values), (np.concatenate(matrix_rows), np.concatenate(matrix_columns))),
        shape=(len(at), len(at)),
    )
    blended = picture.copy()
    blended[hole] = splu(sparse.csc_array(matrix)).solve(right)
    return blended


class _Work:
    """Arrays of one level on the device."""

    def __init__(self, level: _Level, sources: np.ndarray, options: PatchSynthesis) -> None:
        self._device = wp.get_device(options.device)
        self._shift_limit = options.shift_limit
        self._reach = max(level.hole.shape)
        self._holes_at, self._targets_at = np.argwhere(level.hole), np.argwhere(level.targets)
        self.picture = level.image.copy()
        """(H, W, 3) float32, colours of the level."""

        def upload(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

        self._image = upload(self.picture, wp.vec3)
        self._confidence = upload(level.confidence, wp.float32)
        self._is_source = upload(level.is_source.astype(np.int32), wp.int32)
        self._is_target = upload(level.targets.astype(np.int32), wp.int32)
        self._targets = upload(self._targets_at.astype(np.int32), wp.vec2i)
        self._holes = upload(self._holes_at.astype(np.int32), wp.vec2i)
        self._sources = upload(sources, wp.vec2i)
        self._next = wp.clone(self._sources)
        self._cost = zeros(level.hole.shape, wp.float32, self._device)
        self._shift = zeros(level.hole.shape, wp.vec3, self._device)
        self._voted = zeros(len(self._holes_at), wp.vec3, self._device)

    def copy(self) -> None:
        """Fill the hole with the colours of its sources."""
        sources: np.ndarray = self._sources.numpy()[self._holes_at[:, 0], self._holes_at[:, 1]]
        self.picture[self._holes_at[:, 0], self._holes_at[:, 1]] = self.picture[sources[:, 0], sources[:, 1]]
        self._image = wp.array(self.picture, dtype=wp.vec3, device=self._device)

    def search(self, *, seed: int) -> None:
        """Improve the sources by propagation and random search."""
        for number, stride in enumerate(_STRIDES):
            launch_rows(
                search_kernel,
                len(self._targets_at),
                inputs=[
                    *(self._image, self._confidence, self._is_source, self._targets, self._is_target, self._sources),
                    *(stride, self._reach if stride == 1 else 0, self._shift_limit, 7919 * seed + number),
                ],
                outputs=[self._next, self._cost, self._shift],
                device=self._device,
            )
            self._sources, self._next = self._next, self._sources

    def vote(self, tolerance: float) -> None:
        """Fill the hole with the weighted mean of the overlapping patches. ``tolerance`` is the cost of a patch with
        the weight 1/e, as a multiple of the median cost."""
        costs = self._cost.numpy()[self._targets_at[:, 0], self._targets_at[:, 1]]
        launch_rows(
            vote_kernel,
            len(self._holes_at),
            inputs=[
                *(self._image, self._confidence, self._holes, self._is_target, self._sources, self._cost, self._shift),
                max(tolerance * float(np.median(costs)), 1e-6),
            ],
            outputs=[self._voted],
            device=self._device,
        )
        self.picture[self._holes_at[:, 0], self._holes_at[:, 1]] = self._voted.numpy()
        self._image = wp.array(self.picture, dtype=wp.vec3, device=self._device)

    def sources(self) -> np.ndarray:
        """Return the row and column (H, W, 2) int32 of each source."""
        return self._sources.numpy()
