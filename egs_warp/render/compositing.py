"""Compositing of the tile lists into pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.render.compositing import composite_tile_kernel
from egs_warp.kernels.render.ellipse import TILE_PIXELS
from egs_warp.kernels.render.geometry import composite_geometry_kernel, splat_normals_kernel
from egs_warp.kernels.render.quantise import quantise_kernel
from egs_warp.launching import device_of, empty, empty_pooled, launch_rows
from egs_warp.render.projection import ProjectedGaussians
from egs_warp.render.tiles import TileLists, build_tile_lists, lists_fit
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class Background:
    """Background behind the Gaussians."""

    flat: wp.vec3
    """Uniform colour, used if there is no image."""
    image: wp.array | None = None
    """(H * W,) vec3, colour of each pixel; None for the uniform colour."""


@dataclass(frozen=True)
class RenderedImage:
    """Rendered image. Pixel (row, column) has its centre at (column + 0.5, row + 0.5)."""

    __repr__ = short_repr

    colour: wp.array
    """(H, W) vec3 float32, including the background; display-referred like the colours of the capture, and not clipped
    above 1."""
    alpha: wp.array
    """(H, W) float32, 0 to 1, one minus the transmittance to the background."""
    depth: wp.array
    """(H, W) float32: alpha-weighted mean z-depth divided by alpha, scene units; 0 where alpha is 0."""
    median_depth: wp.array | None = None
    """(H, W) float32, z-depth of the splat at which the transmittance falls to half, 0 where there is none; None unless
    requested."""
    median_gaussian: wp.array | None = None
    """(H, W) int32, index of that splat, -1 where there is none; None unless requested."""
    normal: wp.array | None = None
    """(H, W) vec3 in camera axes, blended thinnest axis of each splat, pointing towards the camera; None unless
    requested."""

    def colour_srgb8(self) -> np.ndarray:
        """Return (H, W, 3) uint8 on the host for PNG or video, clipped and quantised; SH colours are sRGB already."""
        levels = empty((*self.colour.shape, 3), wp.uint8, device_of(self.colour))
        self.quantise(levels)
        return levels.numpy()

    def quantise(self, levels: wp.array) -> None:
        """Write the quantised colours to ``levels`` (H, W, 3) uint8 on the device."""
        height, width = self.colour.shape
        launch_rows(
            quantise_kernel,
            width * height,
            inputs=[self.colour.flatten()],
            outputs=[levels.reshape((width * height, 3))],
            device=device_of(self.colour),
        )


class PendingImage:
    """Image and tile lists that are queued on the device.

    The GPU would be idle while the host waits for the number of (Gaussian, tile) pairs. Therefore this number is
    guessed, and ``result`` checks the guess.
    """

    def __init__(
        self,
        projected: ProjectedGaussians,
        view: Any,
        *,
        background: Background,
        threads: int,
        onto: RenderedImage | None = None,
        tile_mask: wp.array | None = None,
        max_depth: wp.array | None = None,
        guess: bool = True,
        for_gradients: bool = False,
    ) -> None:
        self.projected, self.view = projected, view
        lists = build_tile_lists(projected, view, threads=threads, guess=guess, for_gradients=for_gradients)
        self.lists = replace(lists, tile_mask=tile_mask)
        options: dict[str, Any] = {"background": background, "threads": threads, "max_depth": max_depth}
        self.image = composite(projected, self.lists, view, **options, onto=onto)
        self._fit = partial(lists_fit, self.lists, projected)
        options |= {"tile_mask": tile_mask, "for_gradients": for_gradients}
        self._render_again = partial(PendingImage, projected, view, onto=self.image, guess=False, **options)

    def result(self) -> PendingImage:
        """Wait for the number of pairs; return this image, or one rendered again into the same arrays if the guess was
        too small."""
        return self if self._fit() else self._render_again()


def composite(
    projected: ProjectedGaussians,
    lists: TileLists,
    view: Any,
    *,
    background: Background,
    threads: int,
    onto: RenderedImage | None = None,
    max_depth: wp.array | None = None,
) -> RenderedImage:
    """Blend every tile's Gaussians from front to back over ``background``, into the arrays of ``onto`` if given.

    Gaussians beyond ``max_depth`` (H * W,) are hidden; see ``render_gaussians``.
    """
    device = device_of(projected.ellipse)
    width, height = int(view.width), int(view.height)
    shape = (height, width)
    image = onto or RenderedImage(*empty_pooled(device, (shape, wp.vec3), (shape, wp.float32), (shape, wp.float32)))
    inputs = [
        width,
        height,
        lists.tile_start,
        lists.tile_mask,
        lists.gaussian_from_intersection,
        projected.ellipse,
        projected.falloff,
        projected.colour_depth,
        background.flat,
        background.image,
        max_depth,
    ]
    checkpoints = [None, None] if lists.checkpoints is None else [lists.checkpoints.sums, lists.checkpoints.passing]
    launch_rows(
        composite_tile_kernel,
        lists.tile_count * (TILE_PIXELS if device.is_cuda else 1),
        inputs=inputs,
        outputs=[image.colour, image.alpha, image.depth, *checkpoints],
        device=device,
        threads=threads,
        work=lists.tile_work,
    )
    return image


def add_geometry(
    image: RenderedImage,
    cloud: GaussianCloud,
    projected: ProjectedGaussians,
    lists: TileLists,
    view: Any,
    *,
    threads: int,
) -> RenderedImage:
    """Return ``image`` with median depth, the splats at this depth, and normals."""
    device = cloud.device
    width, height = int(view.width), int(view.height)
    splat_normals = empty(cloud.count, wp.vec3, device)
    launch_rows(
        splat_normals_kernel,
        cloud.count,
        inputs=[view, cloud.means, cloud.rotations, cloud.log_scales],
        outputs=[splat_normals],
        device=device,
        threads=threads,
    )
    median_depth = empty(width * height, wp.float32, device)
    median_gaussian = empty(width * height, wp.int32, device)
    normal = empty(width * height, wp.vec3, device)
    launch_rows(
        composite_geometry_kernel,
        lists.tile_count * TILE_PIXELS,
        inputs=[
            *(width, height, lists.tile_start, lists.tile_mask, lists.gaussian_from_intersection),
            *(projected.ellipse, projected.falloff, projected.colour_depth, splat_normals),
        ],
        outputs=[median_depth, median_gaussian, normal],
        device=device,
        threads=threads,
    )
    shape = (height, width)
    return replace(
        image,
        median_depth=median_depth.reshape(shape),
        median_gaussian=median_gaussian.reshape(shape),
        normal=normal.reshape(shape),
    )
