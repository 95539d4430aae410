"""From tile lists to pixels."""

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


@dataclass(frozen=True)
class Background:
    """What shows where the Gaussians let light through."""

    flat: wp.vec3
    """One colour, where there is no image."""
    image: wp.array | None = None
    """(H * W,) vec3."""


@dataclass(frozen=True)
class RenderedImage:
    """One picture. Pixel (row, column) has its centre at (column + 0.5, row + 0.5)."""

    colour: wp.array
    """(H, W) vec3 float32, background included; display-referred as the capture's colours are, not clipped above 1."""
    alpha: wp.array
    """(H, W) float32, 0 to 1: one minus the light that the background sends through."""
    depth: wp.array
    """(H, W) float32: alpha-weighted mean z-depth divided by alpha, scene units; 0 where alpha is 0."""
    median_depth: wp.array | None = None
    """(H, W) float32: z-depth of the splat that stops half of the light, 0 where none does; only if asked for."""
    median_gaussian: wp.array | None = None
    """(H, W) int32: which splat that is, -1 where none does; only if asked for."""
    normal: wp.array | None = None
    """(H, W) vec3 in camera axes: blended thinnest axis of each splat, on the camera's side; only if asked for."""

    def colour_srgb8(self) -> np.ndarray:
        """(H, W, 3) uint8 on the host, ready for PNG or video: clipped and quantised; SH colours are sRGB already."""
        levels = empty((*self.colour.shape, 3), wp.uint8, device_of(self.colour))
        self.quantise(levels)
        return levels.numpy()

    def quantise(self, levels: wp.array) -> None:
        """The same into ``levels`` (H, W, 3) uint8 on the device."""
        height, width = self.colour.shape
        launch_rows(
            quantise_kernel,
            width * height,
            inputs=[self.colour.flatten()],
            outputs=[levels.reshape((width * height, 3))],
            device=device_of(self.colour),
        )


class PendingImage:
    """A picture and its tile lists, queued: a GPU that waited for the number of pairs would stand still meanwhile, so
    that is guessed, and looked at later."""

    def __init__(
        self,
        projected: ProjectedGaussians,
        view: Any,
        *,
        background: Background,
        threads: int,
        onto: RenderedImage | None = None,
        drawn: wp.array | None = None,
        guess: bool = True,
    ) -> None:
        self.projected, self.view = projected, view
        self.lists = replace(build_tile_lists(projected, view, threads=threads, guess=guess), tile_mask=drawn)
        self.image = composite(projected, self.lists, view, background=background, threads=threads, onto=onto)
        self._fit = partial(lists_fit, self.lists, projected)
        given = {"background": background, "threads": threads, "drawn": drawn}
        self._anew = partial(PendingImage, projected, view, onto=self.image, guess=False, **given)

    def result(self) -> PendingImage:
        """This, once it is known that all pairs had room; where they had not, another into the same arrays."""
        return self if self._fit() else self._anew()


def composite(
    projected: ProjectedGaussians,
    lists: TileLists,
    view: Any,
    *,
    background: Background,
    threads: int,
    onto: RenderedImage | None = None,
) -> RenderedImage:
    """Blend every tile's Gaussians from front to back over ``background``, into the arrays of ``onto`` where given."""
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
    ]
    launch_rows(
        composite_tile_kernel,
        lists.tile_count * (TILE_PIXELS if device.is_cuda else 1),
        inputs=inputs,
        outputs=[image.colour, image.alpha, image.depth],
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
    """``image`` with median depth, the splats it is of, and normals."""
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
