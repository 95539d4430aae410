"""The Gaussians of every tile, from front to back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from egs_warp.kernels.render_projection import View
from egs_warp.kernels.render_tiles import (
    TILE,
    band_lists_kernel,
    compact_visible_kernel,
    count_tiles_kernel,
    emit_tiles_kernel,
    tile_ends_kernel,
    visible_kernel,
)
from egs_warp.render.projection import ProjectedGaussians
from egs_warp.render.threads import launch_ranges

TILE_SIDE = int(TILE)


@dataclass(frozen=True)
class TileLists:
    """Which Gaussians meet which tile of 16 x 16 pixels; tiles are numbered row by row."""

    tile_start: wp.array
    """(tiles + 1,) int32: tile t holds the intersections from tile_start[t] to tile_start[t + 1] - 1."""
    gaussian_from_intersection: wp.array
    """(at least tile_start[-1],) int32, nearest first within a tile; equal depths in index order."""
    work: np.ndarray | None
    """(tiles,) number of intersections, on a CPU; to share the tiles out between threads."""

    @property
    def tile_count(self) -> int:
        """Number of tiles."""
        return self.tile_start.shape[0] - 1


def build_tile_lists(projected: ProjectedGaussians, view: View, *, threads: int) -> TileLists:
    """Sort the visible Gaussians by depth and list them for every tile that they reach (exact ellipse-tile test)."""
    columns = -(-view.width // TILE_SIDE)
    rows = -(-view.height // TILE_SIDE)
    if projected.depth_key.device.is_cuda:
        return _lists_by_sorting(projected, view, columns * rows)
    return _lists_by_counting(projected, view, columns, rows, threads)


def _lists_by_counting(projected: ProjectedGaussians, view: View, columns: int, rows: int, threads: int) -> TileLists:
    """Counting sort: bands of tile rows are filled side by side, each from front to back, so no pair is ever
    compared.
    """
    device = projected.depth_key.device
    key = projected.depth_key.numpy()
    gaussian_from_visible = np.flatnonzero(np.isfinite(key)).astype(np.int32)
    visible_count = len(gaussian_from_visible)
    keys = wp.empty(2 * max(visible_count, 1), dtype=wp.float32, device=device)
    order = wp.empty(2 * max(visible_count, 1), dtype=wp.int32, device=device)
    keys.numpy()[:visible_count] = key[gaussian_from_visible]
    order.numpy()[:visible_count] = gaussian_from_visible
    wp.utils.radix_sort_pairs(keys, order, visible_count)

    band_rows = max(1, -(-rows // (4 * threads))) if threads > 1 else rows
    bands = -(-rows // band_rows)

    def walk(cursor: wp.array, gaussians: wp.array, fill: int) -> None:
        launch_ranges(
            band_lists_kernel,
            bands,
            inputs=[
                band_rows,
                view.width,
                view.height,
                visible_count,
                fill,
                order,
                projected.ellipse,
                projected.falloff,
            ],
            outputs=[cursor, gaussians],
            device=device,
            threads=threads,
        )

    counts = wp.zeros(columns * rows, dtype=wp.int32, device=device)
    walk(counts, order, 0)
    work = counts.numpy().copy()
    tile_start = np.concatenate([[0], np.cumsum(work)]).astype(np.int32)
    gaussians = wp.empty(max(int(tile_start[-1]), 1), dtype=wp.int32, device=device)
    walk(wp.array(tile_start[:-1].copy(), dtype=wp.int32, device=device), gaussians, 1)
    return TileLists(wp.array(tile_start, dtype=wp.int32, device=device), gaussians, work)


def _lists_by_sorting(projected: ProjectedGaussians, view: View, tiles: int) -> TileLists:
    """Depth sort of the visible Gaussians, then a stable sort of the intersections by tile alone: few bits, few
    passes.
    """
    device = projected.depth_key.device
    count = projected.depth_key.shape[0]
    visible_end = wp.empty(count, dtype=wp.int32, device=device)
    wp.launch(visible_kernel, dim=count, inputs=[projected.depth_key], outputs=[visible_end], device=device)
    wp.utils.array_scan(visible_end, visible_end, inclusive=True)
    visible_count = int(visible_end[count - 1 :].numpy()[0])
    tile_start = wp.zeros(tiles + 1, dtype=wp.int32, device=device)
    if visible_count == 0:
        return TileLists(tile_start, wp.empty(1, dtype=wp.int32, device=device), None)
    keys = wp.empty(2 * visible_count, dtype=wp.float32, device=device)
    order = wp.empty(2 * visible_count, dtype=wp.int32, device=device)
    wp.launch(
        compact_visible_kernel,
        dim=count,
        inputs=[projected.depth_key, visible_end],
        outputs=[keys, order],
        device=device,
    )
    wp.utils.radix_sort_pairs(keys, order, visible_count, end_bit=31)

    shared = [view.width, view.height, order, projected.ellipse, projected.falloff]
    ends = wp.empty(visible_count, dtype=wp.int32, device=device)
    wp.launch(count_tiles_kernel, dim=visible_count, inputs=shared, outputs=[ends], device=device)
    wp.utils.array_scan(ends, ends, inclusive=True)
    intersections = int(ends[visible_count - 1 :].numpy()[0])
    tile_from_intersection = wp.empty(2 * max(intersections, 1), dtype=wp.int32, device=device)
    gaussians = wp.empty(2 * max(intersections, 1), dtype=wp.int32, device=device)
    wp.launch(
        emit_tiles_kernel,
        dim=visible_count,
        inputs=[*shared, ends],
        outputs=[tile_from_intersection, gaussians],
        device=device,
    )
    wp.utils.radix_sort_pairs(tile_from_intersection, gaussians, intersections, end_bit=max(tiles.bit_length(), 1))
    wp.launch(
        tile_ends_kernel,
        dim=intersections + 1,
        inputs=[intersections, tile_from_intersection],
        outputs=[tile_start],
        device=device,
    )
    return TileLists(tile_start, gaussians, None)
