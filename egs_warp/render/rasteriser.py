"""The renderer on one page: project, list, composite (Kerbl et al. 2023, in Warp kernels).

See docs/concepts/renderer.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.launching import Device, available_threads
from egs_warp.render.compositing import Background, PendingImage, RenderedImage, add_geometry
from egs_warp.render.projection import project, view_from_camera
from egs_warp.render.tiles import TILE_SIDE


def render_gaussians(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: tuple[float, float, float] | np.ndarray | wp.array = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    geometry: bool = False,
    mask: np.ndarray | None = None,
    threads: int | None = None,
) -> RenderedImage:
    """Picture of ``cloud`` through ``camera``, on the device of the cloud.

    ``background`` is one colour, or an image (H, W, 3) of this camera's size. ``antialiased`` dims each splat by what
    the 0.3 px low-pass adds to its area. ``geometry`` adds median depth, its splats and normals. ``mask``, one bool for
    each tile of 16 x 16 pixels from the top left, leaves tiles out: they show the background alone. ``threads`` (a CPU
    only) defaults to the available cores; the picture does not depend on it.
    Raises ``UserError`` for non-finite Gaussians, which it names, for an impossible camera and for a background or mask
    of another size.
    """
    threads = threads or available_threads()
    given = {"background": background, "antialiased": antialiased, "mask": mask, "threads": threads}
    begun = enqueue_image(cloud, camera, **given)
    with translate_out_of_memory(cloud, camera):
        begun = begun.result()
        if geometry:
            return add_geometry(begun.image, cloud, begun.projected, begun.lists, begun.view, threads=threads)
    return begun.image


def enqueue_image(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: tuple[float, float, float] | np.ndarray | wp.array = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    mask: np.ndarray | None = None,
    threads: int | None = None,
) -> PendingImage:
    """The picture of ``render_gaussians`` on its way, for which nobody has waited: to be ``settled``."""
    threads = threads or available_threads()
    view = view_from_camera(camera)
    with translate_out_of_memory(cloud, camera):
        behind = background_of(background, camera, cloud.device)
        drawn = tile_mask_array(mask, camera, cloud.device)
        projected = project(cloud, view, antialiased=antialiased, threads=threads)
        return PendingImage(projected, view, background=behind, threads=threads, drawn=drawn)


def render_views(
    cloud: GaussianCloud, cameras: Sequence[Camera], *, backgrounds: Sequence[Any] | None = None, **options: Any
) -> list[RenderedImage]:
    """One picture of ``cloud`` for each camera; the options are those of ``render_gaussians``.

    ``backgrounds`` has one for each camera, where ``background`` is one for all. Raises ``UserError`` where their
    numbers differ.
    """
    if backgrounds is None:
        return [render_gaussians(cloud, camera, **options) for camera in cameras]
    if len(backgrounds) != len(cameras) or "background" in options:
        raise UserError(
            f"render: {len(backgrounds)} backgrounds for {len(cameras)} cameras"
            f"{' and one for all' if 'background' in options else ''}; give one for each"
        )
    return [
        render_gaussians(cloud, camera, background=behind, **options)
        for camera, behind in zip(cameras, backgrounds, strict=True)
    ]


@contextmanager
def translate_out_of_memory(cloud: GaussianCloud, camera: Camera) -> Iterator[None]:
    """Turn a failed allocation into a ``UserError`` that says how much there was to render."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        device = cloud.device
        # A failure inside Warp's own scratch memory comes under many names.
        full = device.is_cuda and device.free_memory < 0.05 * device.total_memory
        if isinstance(error, RuntimeError) and not (full or re.search("alloc|out of mem", str(error), re.IGNORECASE)):
            raise
        if device.is_cuda:
            # The failure leaves a mark in CUDA's state, which Warp's next scan would take for its own.
            with suppress(RuntimeError):
                mark = wp.zeros(1, dtype=wp.int32, device=device)
                wp.utils.array_scan(mark, mark)
        raise UserError(
            f"render: {cloud.count} Gaussians at {camera.width} x {camera.height} do not fit into the memory of"
            f" {cloud.device}; render a smaller image, fewer Gaussians, or on another device"
        ) from error


def _is_finite_number(value: Any) -> bool:
    return isinstance(value, float | int) and math.isfinite(value)


def tile_mask_array(mask: np.ndarray | None, camera: Camera, device: Device) -> wp.array | None:
    """``mask`` (tile rows, tile columns) bool as ``TileLists`` wants it. Raises ``UserError`` for another shape."""
    if mask is None:
        return None
    values, shape = np.asarray(mask), (-(-camera.height // TILE_SIDE), -(-camera.width // TILE_SIDE))
    if values.shape != shape or values.dtype != bool:
        raise UserError(
            f"mask: give {shape[0]} x {shape[1]} booleans, one for each tile of {TILE_SIDE} x {TILE_SIDE} pixels,"
            f" not {values.dtype} of shape {values.shape}"
        )
    return wp.array(values.ravel().astype(np.int32), dtype=wp.int32, device=device)


@lru_cache(maxsize=64)
def _flat_background(colour: tuple[float, float, float]) -> Background:
    return Background(wp.vec3(*colour))


def background_of(background: Any, camera: Camera, device: Device) -> Background:
    """From a colour or an image (H, W, 3). Raises ``UserError`` for anything else."""
    shape = (camera.height, camera.width)
    if isinstance(background, tuple) and len(background) == 3 and all(map(_is_finite_number, background)):
        return _flat_background(background)
    if isinstance(background, wp.array) and background.dtype == wp.vec3 and background.shape == shape:
        image: Any = background.to(device).contiguous()
        return Background(wp.vec3(), image.flatten())
    values = np.asarray(background.numpy() if isinstance(background, wp.array) else background, dtype=np.float32)
    if values.shape not in ((3,), (*shape, 3)) or not np.isfinite(values).all():
        raise UserError(
            f"background: give three finite numbers or an image of {camera.height} x {camera.width} x 3,"
            f" not shape {values.shape}"
        )
    if values.shape == (3,):
        return Background(wp.vec3(*values.tolist()))
    return Background(wp.vec3(), wp.array(values.reshape(-1, 3), dtype=wp.vec3, device=device))
