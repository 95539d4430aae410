"""Tile lists: the Gaussians of every tile, from front to back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.render.ellipse import SEGMENT, TILE, TILE_PIXELS
from egs_warp.kernels.render.tiles import emit_tiles_kernel, finish_lists_kernel
from egs_warp.kernels.render.tiles_cpu import (
    compact_visible_kernel,
    count_tiles_kernel,
    fill_tiles_kernel,
    split_ranks_kernel,
)
from egs_warp.launching import device_of, empty, empty_pooled, grow_capacity, launch_cached, launch_rows, zeros
from egs_warp.render.projection import ProjectedGaussians

TILE_SIDE = int(TILE)
_LARGE_SORT = 10_000_000
_KEY_BITS = 32


@dataclass(frozen=True)
class Checkpoints:
    """State of the pixels of a tile before each segment of ``SEGMENT`` splats except the first. The backward pass on a
    GPU processes the segments in parallel.

    The number of a checkpoint is tile_start[t] // SEGMENT + s for segment s of tile t, which is unique.
    """

    sums: wp.array
    """(checkpoints * 256,) vec4, weighted sums of colour and depth over the splats before the segment."""
    passing: wp.array
    """(checkpoints * 256,) float32, transmittance before the segment; 0 where compositing has ended."""

    @property
    def count(self) -> int:
        """Number of checkpoints; number 0 is not used."""
        return self.passing.shape[0] // int(TILE_PIXELS)


@dataclass(frozen=True)
class TileLists:
    """Gaussians that meet each tile of 16 x 16 pixels; tiles are numbered row by row."""

    tile_start: wp.array
    """(tiles + 1,) int32: tile t holds the intersections from tile_start[t] to tile_start[t + 1] - 1."""
    gaussian_from_intersection: wp.array
    """(at least tile_start[-1],) int32, Gaussian of each intersection; within a tile, the nearest comes first, and
    equal depths are in the order of the indices."""
    slot_from_intersection: wp.array
    """(at least tile_start[-1],) int32, slot of each intersection: its index among all (Gaussian, tile) pairs, numbered
    by Gaussian."""
    tile_work: np.ndarray | None
    """(tiles,) number of intersections, used on a CPU to distribute the tiles over threads."""
    tile_mask: wp.array | None = None
    """(tiles,) int32, 0 for tiles that show only the background; None renders all tiles."""
    checkpoints: Checkpoints | None = None
    """Written by compositing and read by the backward pass on a GPU. Without them, one block of the backward pass
    processes all splats of a tile."""

    @property
    def tile_count(self) -> int:
        """Number of tiles of the image."""
        return self.tile_start.shape[0] - 1


def build_tile_lists(
    projected: ProjectedGaussians, view: Any, *, threads: int, guess: bool = False, for_gradients: bool = False
) -> TileLists:
    """Sort the visible Gaussians by depth and list them for every tile that they reach (exact ellipse-tile test).

    With ``guess``, the host does not wait for the number of pairs if recent images had few pairs. ``lists_fit`` then
    returns whether the guessed capacity was large enough. With ``for_gradients``, the lists have checkpoints on a GPU.
    """
    columns = -(-view.width // TILE_SIDE)
    rows = -(-view.height // TILE_SIDE)
    device = device_of(projected.ellipse)
    if device.is_cuda:
        return _lists_by_sorting(projected, view, columns * rows, guess=guess, for_gradients=for_gradients)
    return _lists_by_counting(projected, view, columns * rows, threads)


def lists_fit(lists: TileLists, projected: ProjectedGaussians) -> bool:
    """Return True if the pairs fit into ``lists``, whose capacity was guessed. If they do not fit, the lists are
    empty."""
    pairs = projected.slot_count
    _update_guess(device_of(lists.tile_start), pairs)
    return pairs <= len(lists.gaussian_from_intersection)


def _lists_by_counting(projected: ProjectedGaussians, view: Any, tiles: int, threads: int) -> TileLists:
    """Build the lists by a counting sort over chunks of the depth order, which runs in parallel and does not compare
    pairs."""
    device = device_of(projected.ellipse)
    pairs = projected.slot_count
    count = projected.slot_end.shape[0]
    # The sort needs twice the space of its data.
    keys, order, visible = empty_pooled(device, (2 * count, wp.float32), (2 * count, wp.int32), (1, wp.int32))
    launch_cached(
        compact_visible_kernel,
        1,
        inputs=[projected.slot_end, projected.colour_depth],
        outputs=[keys, order, visible],
        device=device,
    )
    visible_count = int(visible.numpy()[0])
    wp.utils.radix_sort_pairs(keys, order, visible_count)
    chunks = min(8 + 4 * threads, max(1, visible_count // 256)) if threads > 1 else 1
    chunk_start, pair_start = empty_pooled(device, (chunks + 1, wp.int32), (chunks + 1, wp.int32))
    launch_cached(
        split_ranks_kernel,
        1,
        inputs=[visible_count, pairs, order, projected.slot_end],
        outputs=[chunk_start, pair_start],
        device=device,
    )
    capacity = grow_capacity(pairs)
    (tile_from_pair,) = empty_pooled(device, (capacity + 4 * chunks, wp.int32))
    gaussians, slots = empty_pooled(device, (capacity, wp.int32), (capacity, wp.int32))
    counts = zeros((chunks, tiles), wp.int32, device)
    walk = {"device": device, "threads": threads, "work": np.ones(chunks)}
    shared = [chunk_start, pair_start, order]
    launch_rows(
        count_tiles_kernel,
        chunks,
        inputs=[view.width, view.height, *shared, projected.ellipse, projected.falloff],
        outputs=[tile_from_pair, counts],
        **walk,
    )
    work = counts.numpy().sum(axis=0)
    tile_start = np.concatenate([[0], np.cumsum(work)]).astype(np.int32)
    # In each tile, the entries of a chunk follow the entries of the previous chunks, which are nearer.
    cursor = counts.numpy()
    cursor[:] = np.cumsum(cursor, axis=0) - cursor + tile_start[:-1]
    launch_rows(
        fill_tiles_kernel,
        chunks,
        inputs=[*shared, projected.slot_end, tile_from_pair],
        outputs=[counts, gaussians, slots],
        **walk,
    )
    return TileLists(wp.array(tile_start, dtype=wp.int32, device=device), gaussians, slots, work)


def _lists_by_sorting(
    projected: ProjectedGaussians, view: Any, tiles: int, *, guess: bool = False, for_gradients: bool = False
) -> TileLists:
    """Build the lists by a radix sort of all (tile, Gaussian) pairs. The 32-bit keys consist of the tile and the
    leading bits of the depth; sorting them is twice as fast as sorting 64-bit keys."""
    device = device_of(projected.ellipse)
    # Allocate memory for the expected number of pairs while the GPU projects, before the actual number is known.
    expected = _expected.get(device.alias, 0)
    buffers = pair_buffers(expected, tiles, device, for_gradients=for_gradients)
    if guess and buffers is not None and expected <= _MAX_GUESSED_PAIRS:
        pairs = len(buffers.gaussians)
    else:
        pairs = projected.slot_count
        _update_guess(device, pairs)
    if pairs == 0:
        return TileLists(
            zeros(tiles + 1, wp.int32, device), empty(1, wp.int32, device), empty(1, wp.int32, device), None
        )
    if buffers is None or len(buffers.gaussians) < pairs:
        buffers = pair_buffers(pairs, tiles, device, for_gradients=for_gradients)
        assert buffers is not None
    return sort_pairs(projected, view, buffers, pairs)


def sort_pairs(projected: ProjectedGaussians, view: Any, buffers: PairBuffers, capacity: int) -> TileLists:
    """Sort all (Gaussian, tile) pairs in ``buffers``, without a synchronisation with the GPU.

    If there are more than ``capacity`` pairs, the lists are empty. ``view`` may be another camera than that of
    ``projected`` if both have the same image size and the same depth range.
    """
    device, count = device_of(projected.ellipse), projected.slot_end.shape[0]
    tiles = len(buffers.tile_start) - 1
    keys, scratch = buffers.keys, buffers.scratch
    nearest, farthest = (int(np.float32(z).view(np.int32)) for z in (view.near, view.far))
    depth_bits = max((farthest - nearest).bit_length(), 1)
    tile_bits = tiles.bit_length()
    depth_key_bits = min(depth_bits, _KEY_BITS - tile_bits)
    launch_cached(
        emit_tiles_kernel,
        count,
        inputs=[
            *(view.width, view.height, capacity, nearest, depth_bits - depth_key_bits, depth_key_bits),
            *(projected.slot_end, projected.ellipse, projected.falloff, projected.colour_depth),
        ],
        outputs=[keys, scratch],
        device=device,
    )
    if capacity > _LARGE_SORT:
        # Warp does not report a failed allocation of the sort's scratch memory, so test beforehand that there is enough
        # memory.
        empty((capacity, 2), wp.int32, device)
    wp.utils.radix_sort_pairs(keys, scratch, capacity, end_bit=depth_key_bits + tile_bits)
    launch_cached(
        finish_lists_kernel,
        capacity + 1,
        inputs=[capacity, depth_key_bits, keys, scratch, projected.colour_depth],
        outputs=[buffers.tile_start, buffers.gaussians, buffers.slots],
        device=device,
    )
    return TileLists(buffers.tile_start, buffers.gaussians, buffers.slots, None, checkpoints=buffers.checkpoints)


_MAX_GUESSED_PAIRS = 2_000_000
"""Maximum number of expected pairs at which sorting unused capacity is faster than waiting for the actual number."""


def _update_guess(device: wp.Device, pairs: int) -> None:
    """Update the expected number of pairs, which is the recent maximum and decays slowly."""
    previous = _expected.get(device.alias, 0) * 15 // 16
    _expected[device.alias] = max(pairs, previous) if pairs <= _LARGE_SORT else 0


_expected: dict[str, int] = {}
"""Expected number of pairs of the next image, by device."""


@dataclass(frozen=True)
class PairBuffers:
    """Buffers for the lists of a given number of pairs, and scratch space for the sort."""

    keys: wp.array
    scratch: wp.array
    """Slots, scratch space for sorting them, and the Gaussian of each slot."""
    tile_start: wp.array
    gaussians: wp.array
    slots: wp.array
    checkpoints: Checkpoints | None


def pair_buffers(pairs: int, tiles: int, device: wp.Device, *, for_gradients: bool) -> PairBuffers | None:
    """Allocate the buffers for the lists of at least ``pairs`` pairs; None for 0 pairs. With ``for_gradients``, they
    have checkpoints on a GPU."""
    if pairs == 0:
        return None
    pairs = grow_capacity(pairs)
    checkpoints = None
    if for_gradients and device.is_cuda:
        size = (pairs // int(SEGMENT) + 1) * int(TILE_PIXELS)
        checkpoints = Checkpoints(*empty_pooled(device, (size, wp.vec4), (size, wp.float32)))
    # Use two allocations, so that the scratch space can be released before the lists.
    return PairBuffers(
        *empty_pooled(device, (2 * pairs, wp.uint32), (3 * pairs, wp.int32)),
        *empty_pooled(device, (tiles + 1, wp.int32), (pairs, wp.int32), (pairs, wp.int32)),
        checkpoints=checkpoints,
    )
