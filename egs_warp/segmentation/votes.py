"""Votes of masks for each Gaussian: its blending weight inside and outside the masks, summed over pixels.

See docs/concepts/segmentation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import warp as wp

from egs_warp.checked_calls import checked_constructor
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.launching import available_threads
from egs_warp.render.backward import backward
from egs_warp.render.compositing import PendingImage
from egs_warp.render.projection import project, view_from_camera
from egs_warp.render.rasteriser import background_of, translate_out_of_memory
from egs_warp.short_repr import short_repr


@checked_constructor
@dataclass(frozen=True)
class MaskedView:
    """A picture with a mask in which a user or a network has marked the object."""

    __repr__ = short_repr

    camera: Camera
    mask: Annotated[np.ndarray, "H", "W"]
    """(H, W) bool, True on the object."""
    name: str = "mask"
    """Name for messages."""


@dataclass(frozen=True)
class Votes:
    """Blending weights summed over the pixels of all views, in pixels."""

    inside: np.ndarray
    """(n,) float64 blending weight inside the masks."""
    outside: np.ndarray
    """(n,) float64 blending weight outside the masks."""
    unhidden: np.ndarray
    """(n,) float64 blending weight without occlusion."""

    def share_inside(self) -> np.ndarray:
        """Return the share (n,), 0 to 1, of the weight inside the masks; 0.5 for Gaussians that no view shows."""
        total = self.inside + self.outside
        return np.where(total > 0.0, self.inside / np.maximum(total, 1e-30), 0.5)

    def share_seen(self) -> np.ndarray:
        """Return the visible share (n,), 0 to 1, of each Gaussian."""
        return np.minimum((self.inside + self.outside) / np.maximum(self.unhidden, 1e-30), 1.0)


def blending_votes(cloud: GaussianCloud, views: Sequence[MaskedView]) -> Votes:
    """Sum the blending weight of each Gaussian over the pixels inside and outside the masks.

    A Gaussian's blending weight in a pixel is the derivative of the pixel's colour with respect to the Gaussian's
    colour. Therefore, the votes are the colour gradient of a weighted picture, in which the red channel has the weight
    1 inside the mask and the green channel has it outside; the renderer's backward kernels compute this gradient.
    Raises ``UserError`` for masks whose size differs from their cameras'.
    """
    sums = np.zeros((cloud.count, 3))
    # Use the same grey for all Gaussians, because colours are not clipped and SH bands above 0 are not needed.
    grey = replace(cloud, sh=wp.zeros((cloud.count, 1), dtype=wp.vec3, device=cloud.device))
    for view in views:
        check_size(view)
        sums += _votes_of_view(grey, view)
    return Votes(*sums.T)


def votes_of_masks(cloud: GaussianCloud, masks: Sequence[MaskedView]) -> Votes:
    """Sum the votes of all masks that are not empty.

    Raises ``UserError`` for masks whose size differs from their cameras', if all masks are empty, and if their cameras
    see nothing.
    """
    votes = blending_votes(cloud, marked_views(masks))
    if not (votes.inside + votes.outside > 0.0).any():
        raise UserError(
            "object: the masks' cameras see no part of the capture; check that cameras and capture have the same"
            " coordinate frame"
        )
    return votes


def marked_views(views: Sequence[MaskedView]) -> list[MaskedView]:
    """Return the views whose masks are not empty. An empty mask belongs to a view in which the object is not visible.

    Raises ``UserError`` for masks whose size differs from their cameras', and if all masks are empty.
    """
    for view in views:
        check_size(view)
    marked = [view for view in views if view.mask.any()]
    if not marked:
        several = len(views) > 1
        what = "this mask and all others are empty" if several else "the mask is empty"
        raise UserError(f"{views[0].name}: {what}; mark the object in {'them' if several else 'it'}")
    return marked


def check_size(view: MaskedView) -> None:
    """Raise ``UserError`` for a mask whose size differs from the size of its camera's picture."""
    height, width = view.camera.height, view.camera.width
    if view.mask.shape != (height, width):
        raise UserError(
            f"{view.name}: the mask has {view.mask.shape[1]} x {view.mask.shape[0]} pixels, but its camera has"
            f" {width} x {height}; give a mask of the photo's size"
        )


def _votes_of_view(grey: GaussianCloud, masked: MaskedView) -> np.ndarray:
    threads = available_threads()
    view = view_from_camera(masked.camera)
    inside = masked.mask.astype(np.float32)
    colour = np.stack([inside, 1.0 - inside, np.zeros_like(inside)], axis=2)
    with translate_out_of_memory(grey, masked.camera):
        projected = project(grey, view, antialiased=grey.antialiased, threads=threads)
        behind = background_of((0.0, 0.0, 0.0), masked.camera, grey.device)
        rendered = PendingImage(projected, view, background=behind, threads=threads).result()
        gradients = backward(
            *(grey, view, projected, rendered.lists, rendered.image),
            colour_gradient=wp.array(colour, dtype=wp.vec3, device=grey.device),
            alpha_gradient=None,
            depth_gradient=None,
            antialiased=grey.antialiased,
            want_pose=False,
            threads=threads,
        )
    by_colour = gradients.sh.numpy()[:, 0, :2].astype(np.float64) / SH_BAND_0
    visible = np.diff(projected.slot_end.numpy(), prepend=0) > 0
    # -ln(alpha / opacity) = a u^2 + v w^2 integrates to pi / sqrt(a v).
    a, (v, log_opacity) = projected.ellipse.numpy()[visible, 2], projected.falloff.numpy()[visible].T
    unhidden = np.zeros(grey.count)
    unhidden[visible] = np.exp(log_opacity) * np.pi / np.sqrt(a.astype(np.float64) * v)
    return np.column_stack([by_colour, unhidden])
