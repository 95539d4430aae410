"""Roofline of the renderer's stages: bytes moved, operations computed, and the machine's peak rates of both."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.render.ellipse import TILE_PIXELS
from egs_warp.launching import device_of, launch_rows
from egs_warp.render.backward import backward
from egs_warp.render.compositing import Background, composite
from egs_warp.render.projection import ProjectedGaussians, project, view_from_camera
from egs_warp.render.tiles import TileLists, build_tile_lists
from harness import median_ms
from kernels import PROBE_STEPS, arithmetic_kernel, hits_kernel, vector_arithmetic_kernel


def stage_rows(cloud: GaussianCloud, camera: Camera, *, repeats: int, threads: int) -> dict[str, dict[str, Any]]:
    """Measure each stage's milliseconds, megabytes, millions of operations, and share of the device's limit.

    The share is the time that the data transfer or the arithmetic, whichever is slower, would take at the peak rate,
    divided by the measured time, which includes the calls from Python. Both peak rates are measured here: with a copy
    of 1 GiB, and with chains of multiply and add.
    """
    device = cloud.device
    view, background = view_from_camera(camera), Background(wp.vec3())
    shape = (camera.height, camera.width)
    gradient = [wp.ones(shape, dtype=t, device=device) for t in (wp.vec3, wp.float32, wp.float32)]
    projected = project(cloud, view, antialiased=False, threads=threads)
    lists = build_tile_lists(projected, view, threads=threads)
    image = composite(projected, lists, view, background=background, threads=threads)
    times = median_ms(
        {
            "project": lambda: project(cloud, view, antialiased=False, threads=threads),
            "lists": lambda: build_tile_lists(projected, view, threads=threads),
            "composite": lambda: composite(projected, lists, view, background=background, threads=threads),
            "backward": lambda: backward(
                *(cloud, view, projected, lists, image),
                colour_gradient=gradient[0],
                alpha_gradient=gradient[1],
                depth_gradient=gradient[2],
                antialiased=False,
                want_pose=False,
                threads=threads,
            ),
        },
        repeats=repeats,
        synchronise=lambda: wp.synchronize_device(device),
    )
    bandwidth, arithmetic = device_limits(device)
    counts = _counts(projected, lists, view)
    moved = _bytes(cloud.count, counts, int(view.width * view.height), cuda=device.is_cuda, tiles=lists.tile_count)
    done = _operations(cloud.count, counts)
    rows: dict[str, dict[str, Any]] = {}
    for name, ms in times.items():
        needed = {"bandwidth": moved[name] / bandwidth, "arithmetic": done[name] / arithmetic}
        limit = max(needed, key=needed.__getitem__)
        rows[name] = {
            "ms": ms,
            "megabytes": moved[name] / 1e6,
            "million_operations": done[name] / 1e6,
            "limit": limit,
            "share_of_limit": needed[limit] / (ms * 1e-3),
        }
    return rows | {
        "counts": counts,
        "device": {"gigabytes_per_second": bandwidth / 1e9, "gigaflops": arithmetic / 1e9},
    }


def device_limits(device: wp.Device) -> tuple[float, float]:
    """Return the bytes per second of a long copy, counting reads and writes, and the single-precision operations per
    second."""
    size = 2**30 if device.is_cuda else 2**27
    source = wp.zeros(size // 4, dtype=wp.int32, device=device)
    target = wp.empty_like(source)
    lanes = 2**20 if device.is_cuda else 64
    sums = wp.zeros(lanes, dtype=wp.float32, device=device)
    # On a CPU, a core computes sixteen numbers at once only if the code uses explicit vectors.
    kernel, width = (arithmetic_kernel, 1) if device.is_cuda else (vector_arithmetic_kernel, 16)
    times = median_ms(
        {
            "copy": lambda: wp.copy(target, source),
            "arithmetic": lambda: wp.launch(kernel, lanes, inputs=[0, 0.999], outputs=[sums], device=device),
        },
        repeats=7,
        synchronise=lambda: wp.synchronize_device(device),
    )
    # Each step has two operations in each of eight chains.
    operations = lanes * width * int(PROBE_STEPS) * 8 * 2
    return 2 * size / (times["copy"] * 1e-3), operations / (times["arithmetic"] * 1e-3)


def arithmetic_by_threads(threads: int, sums: wp.array) -> None:
    """Measure the speedup of work that scales perfectly with the number of cores, an upper bound for ``threads``
    threads."""
    launch_rows(
        arithmetic_kernel,
        len(sums),
        inputs=[0.999],
        outputs=[sums],
        device=device_of(sums),
        threads=threads,
        work=np.ones(len(sums)),
    )


def _counts(projected: ProjectedGaussians, lists: TileLists, view: Any) -> dict[str, float]:
    device = device_of(projected.ellipse)
    hits = wp.zeros(int(view.width * view.height), dtype=wp.int32, device=device)
    wp.launch(
        hits_kernel,
        dim=lists.tile_count * TILE_PIXELS,
        inputs=[
            *(view.width, view.height, lists.tile_start, lists.gaussian_from_intersection),
            *(projected.ellipse, projected.falloff),
        ],
        outputs=[hits],
        device=device,
    )
    visible = np.diff(projected.slot_end.numpy(), prepend=0) > 0
    return {
        "visible": float(visible.sum()),
        "pairs": float(projected.slot_count),
        "pixel_hits": float(hits.numpy().sum(dtype=np.int64)),
    }


def _bytes(count: int, counts: dict[str, float], pixels: int, *, cuda: bool, tiles: int) -> dict[str, float]:
    visible, pairs = counts["visible"], counts["pairs"]
    if cuda:
        # Keys, slots and Gaussians are written; each radix pass reads and writes 12 bytes per pair; the search for the
        # starts of tiles reads the keys again.
        sorting = pairs * (16 + 24 * -(-(31 + tiles.bit_length()) // 8) + 20)
    else:
        # The tile of each slot is written and read; then the Gaussian and the slot are written.
        sorting = pairs * 16 + visible * 64
    return {
        # Attributes are read; the tile count is written and scanned; the ellipses of visible Gaussians are written.
        "project": count * (56 + 8 + 16) + visible * 40,
        "lists": count * 8 + visible * 40 + sorting,
        "composite": pairs * (4 + 40) + pixels * 20,
        # Pairs are read again; their moments are zeroed, written and read; attributes are read, and gradients are
        # written.
        "backward": pairs * (8 + 40 + 3 * 48) + pixels * 60 + count * (56 + 8 + 64),
    }


def _operations(count: int, counts: dict[str, float]) -> dict[str, float]:
    """Return the operations as counted in the kernels' source: a multiply, an add and a special function are one
    operation each."""
    visible, pairs, hits = counts["visible"], counts["pairs"], counts["pixel_hits"]
    return {
        # For all Gaussians, the rotation matrix and its product with the camera's rotation and the scales; for visible
        # Gaussians, the ellipse and the colour.
        "project": count * 150 + visible * 120,
        # The span of the ellipse in each tile row, with about two rows per three pairs; sorting needs no arithmetic.
        "lists": pairs * 30,
        # Per pair of pixel and splat, 12 operations for alpha and 10 for blending.
        "composite": hits * 22,
        # Per pair, 12 operations for alpha, 20 for value, slope and transmittance, and 24 for ten sums; then the chain
        # rule for each visible Gaussian.
        "backward": hits * 56 + visible * 600 + pairs * 12,
    }
