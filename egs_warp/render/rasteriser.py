"""The renderer: projection, tile lists and compositing (Kerbl et al. 2023, with Warp kernels).

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
    antialiased: bool | None = None,
    geometry: bool = False,
    mask: np.ndarray | None = None,
    max_depth: wp.array | None = None,
    threads: int | None = None,
) -> RenderedImage:
    """Render ``cloud`` through ``camera``, on the device of the cloud.

    Args:
        cloud: Gaussians.
        camera: camera.
        background: one colour, or an image (H, W, 3) of this camera's size.
        antialiased: True to dim each splat by the factor by which the 0.3 px low-pass filter increases its area; None
            uses the setting with which ``cloud`` was trained.
        geometry: True to add the median depth, the splats at this depth, and normals.
        mask: one bool for each tile of 16 x 16 pixels from the top left; tiles that are False show the background
            alone.
        max_depth: (H * W,) float32, on the device of the cloud: z-depth of an opaque surface at each pixel, which hides
            the Gaussians with deeper means there; 0 where there is none.
        threads: number of CPU threads, by default the number of available cores; the image does not depend on it.

    Raises:
        UserError: a Gaussian is not finite (the message names it), the camera is invalid, or the background or mask
            does not have the camera's size.
    """
    threads = threads or available_threads()
    arguments = {"background": background, "antialiased": antialiased, "mask": mask, "threads": threads}
    pending = enqueue_image(cloud, camera, **arguments, max_depth=max_depth)
    with translate_out_of_memory(cloud, camera):
        pending = pending.result()
        if geometry:
            return add_geometry(pending.image, cloud, pending.projected, pending.lists, pending.view, threads=threads)
    return pending.image


def enqueue_image(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: tuple[float, float, float] | np.ndarray | wp.array = (1.0, 1.0, 1.0),
    antialiased: bool | None = None,
    mask: np.ndarray | None = None,
    max_depth: wp.array | None = None,
    threads: int | None = None,
) -> PendingImage:
    """Queue the image of ``render_gaussians`` without blocking; ``PendingImage.result`` waits for the image."""
    threads = threads or available_threads()
    view = view_from_camera(camera)
    if antialiased is None:
        antialiased = cloud.antialiased
    with translate_out_of_memory(cloud, camera):
        behind = background_of(background, camera, cloud.device)
        tile_mask = tile_mask_array(mask, camera, cloud.device)
        projected = project(cloud, view, antialiased=antialiased, threads=threads)
        return PendingImage(
            projected, view, background=behind, threads=threads, tile_mask=tile_mask, max_depth=max_depth
        )


def render_views(
    cloud: GaussianCloud, cameras: Sequence[Camera], *, backgrounds: Sequence[Any] | None = None, **options: Any
) -> list[RenderedImage]:
    """Render one image of ``cloud`` for each camera, with the options of ``render_gaussians``.

    Args:
        cloud: Gaussians.
        cameras: cameras.
        backgrounds: one background for each camera, instead of one ``background`` for all.

    Raises:
        UserError: the numbers of backgrounds and cameras differ.
    """
    if backgrounds is None:
        return [render_gaussians(cloud, camera, **options) for camera in cameras]
    if len(backgrounds) != len(cameras) or "background" in options:
        raise UserError(
            f"render: {len(backgrounds)} backgrounds for {len(cameras)} cameras"
            f"{' and one background for all' if 'background' in options else ''}; give one for each"
        )
    return [
        render_gaussians(cloud, camera, background=behind, **options)
        for camera, behind in zip(cameras, backgrounds, strict=True)
    ]


@contextmanager
def translate_out_of_memory(cloud: GaussianCloud, camera: Camera) -> Iterator[None]:
    """Convert a failed allocation to a ``UserError`` that states the number of Gaussians and the size of the image."""
    needed = f"render: {cloud.count} Gaussians at {camera.width} x {camera.height}"
    with translate_failed_allocation(cloud.device, needed, "render a smaller image, fewer Gaussians"):
        yield


@contextmanager
def translate_failed_allocation(device: wp.Device, needed: str, advice: str) -> Iterator[None]:
    """Convert a failed allocation on ``device`` to a ``UserError``. It begins with what was ``needed``, after the name
    of the stage, and ends with the ``advice``, followed by "or on another device"."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # When Warp cannot allocate its own scratch memory, it raises errors with many different messages.
        full = device.is_cuda and device.free_memory < 0.05 * device.total_memory
        if isinstance(error, RuntimeError) and not (full or re.search("alloc|out of mem", str(error), re.IGNORECASE)):
            raise
        if device.is_cuda:
            # The error remains in CUDA's state, and Warp's next scan would report it again.
            with suppress(RuntimeError):
                dummy = wp.zeros(1, dtype=wp.int32, device=device)
                wp.utils.array_scan(dummy, dummy)
        raise UserError(f"{needed} do not fit into the memory of {device}; {advice}, or on another device") from error


def _is_finite_number(value: Any) -> bool:
    return isinstance(value, float | int) and math.isfinite(value)


def tile_mask_array(mask: np.ndarray | None, camera: Camera, device: Device) -> wp.array | None:
    """Convert ``mask`` (tile rows, tile columns) bool to the format of ``TileLists.tile_mask``. Raises ``UserError``
    for another shape or type."""
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
    """Convert a colour or an image (H, W, 3) to a background. Raises ``UserError`` for anything else."""
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
