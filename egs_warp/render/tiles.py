"""The Gaussians of every tile, from front to back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.render_ellipse import TILE
from egs_warp.kernels.render_tiles import band_lists_kernel, emit_tiles_kernel, gather_ranks_kernel, tile_starts_kernel
from egs_warp.render.arrays import empty, zeros
from egs_warp.render.projection import ProjectedGaussians
from egs_warp.render.threads import launch_ranges

TILE_SIDE = int(TILE)
_LARGE_SORT = 10_000_000


@dataclass(frozen=True)
class TileLists:
    """Which Gaussians meet which tile of 16 x 16 pixels; tiles are numbered row by row."""

    tile_start: wp.array
    """(tiles + 1,) int32: tile t holds the intersections from tile_start[t] to tile_start[t + 1] - 1."""
    gaussian_from_intersection: wp.array
    """(at least tile_start[-1],) int32, nearest first within a tile; equal depths in index order."""
    slot_from_intersection: wp.array
    """(at least tile_start[-1],) int32: place of the same pair when pairs are numbered Gaussian by Gaussian."""
    work: np.ndarray | None
    """(tiles,) number of intersections, on a CPU; to share the tiles out between threads."""

    @property
    def tile_count(self) -> int:
        """Number of tiles."""
        return self.tile_start.shape[0] - 1


def build_tile_lists(projected: ProjectedGaussians, view: Any, *, threads: int) -> TileLists:
    """Sort the visible Gaussians by depth and list them for every tile that they reach (exact ellipse-tile test)."""
    columns = -(-view.width // TILE_SIDE)
    rows = -(-view.height // TILE_SIDE)
    device: Any = projected.ellipse.device
    if device.is_cuda:
        return _lists_by_sorting(projected, view, columns * rows)
    return _lists_by_counting(projected, view, columns, rows, threads)


def _lists_by_counting(projected: ProjectedGaussians, view: Any, columns: int, rows: int, threads: int) -> TileLists:
    """Counting sort: bands of tile rows are filled side by side, each from front to back: no pair is compared."""
    device = projected.ellipse.device
    gaussian_from_visible = np.flatnonzero(np.diff(projected.slot_end.numpy(), prepend=0)).astype(np.int32)
    visible_count = len(gaussian_from_visible)
    keys = empty(2 * max(visible_count, 1), wp.float32, device)
    order = empty(2 * max(visible_count, 1), wp.int32, device)
    keys.numpy()[:visible_count] = projected.colour_depth.numpy()[gaussian_from_visible, 3]
    order.numpy()[:visible_count] = gaussian_from_visible
    wp.utils.radix_sort_pairs(keys, order, visible_count)

    in_order = [empty(max(visible_count, 1), dtype, device) for dtype in (wp.vec2i, wp.int32, wp.vec4, wp.vec2)]
    launch_ranges(
        gather_ranks_kernel,
        visible_count,
        inputs=[view.height, order, projected.slot_end, projected.ellipse, projected.falloff],
        outputs=in_order,
        device=device,
        threads=threads,
    )
    band_rows = max(1, -(-rows // (4 * threads))) if threads > 1 else rows
    gaussians = empty(max(projected.slot_count, 1), wp.int32, device)
    slots = empty(max(projected.slot_count, 1), wp.int32, device)

    def walk(cursor: wp.array, fill: int) -> None:
        launch_ranges(
            band_lists_kernel,
            -(-rows // band_rows),
            inputs=[band_rows, view.width, view.height, visible_count, fill, order, *in_order],
            outputs=[cursor, gaussians, slots],
            device=device,
            threads=threads,
        )

    counts = zeros(columns * rows, wp.int32, device)
    walk(counts, 0)
    work = counts.numpy().copy()
    tile_start = np.concatenate([[0], np.cumsum(work)]).astype(np.int32)
    walk(wp.array(tile_start[:-1].copy(), dtype=wp.int32, device=device), 1)
    return TileLists(wp.array(tile_start, dtype=wp.int32, device=device), gaussians, slots, work)


def _lists_by_sorting(projected: ProjectedGaussians, view: Any, tiles: int) -> TileLists:
    """Radix sort of all (tile, Gaussian) pairs by tile and depth."""
    device = projected.ellipse.device
    count, pairs = projected.slot_end.shape[0], projected.slot_count
    gaussians = empty(max(pairs, 1), wp.int32, device)
    slots = empty(2 * max(pairs, 1), wp.int32, device)
    if pairs == 0:
        return TileLists(zeros(tiles + 1, wp.int32, device), gaussians, slots, None)
    tile_start = empty(tiles + 1, wp.int32, device)
    keys = empty(2 * pairs, wp.int64, device)
    gaussian_from_slot = empty(pairs, wp.int32, device)
    nearest, farthest = (int(np.float32(z).view(np.int32)) for z in (view.near, view.far))
    depth_bits = max((farthest - nearest).bit_length(), 1)
    wp.launch(
        emit_tiles_kernel,
        dim=count,
        inputs=[
            view.width,
            view.height,
            nearest,
            depth_bits,
            projected.slot_end,
            projected.ellipse,
            projected.falloff,
            projected.colour_depth,
        ],
        outputs=[keys, gaussian_from_slot, slots],
        device=device,
    )
    if pairs > _LARGE_SORT:
        # The sort takes scratch memory inside Warp, which does not report a failure: see first whether there is any.
        empty((pairs, 3), wp.int32, device)
    wp.utils.radix_sort_pairs(keys, slots, pairs, end_bit=depth_bits + max(tiles - 1, 1).bit_length())
    wp.launch(
        tile_starts_kernel,
        dim=pairs + 1,
        inputs=[pairs, depth_bits, keys, gaussian_from_slot, slots],
        outputs=[tile_start, gaussians],
        device=device,
    )
    return TileLists(tile_start, gaussians, slots, None)
