"""Backward pass of the renderer: gradients with respect to the Gaussians and the camera pose, from pixel gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.render.backward import pose_backward_kernel, project_backward_kernel
from egs_warp.kernels.render.backward_cpu import project_backward_block_kernel
from egs_warp.kernels.render.compositing import composite_backward_block_kernel, composite_backward_tile_kernel
from egs_warp.kernels.render.ellipse import TILE_PIXELS
from egs_warp.kernels.render.moments import LANES, add_moments_kernel
from egs_warp.kernels.render.pixel_gradients import pixel_gradients_kernel
from egs_warp.kernels.render.projection_cpu import BLOCK
from egs_warp.launching import device_of, empty, empty_pooled, grow_capacity, launch_cached, launch_rows
from egs_warp.render.compositing import RenderedImage
from egs_warp.render.projection import ProjectedGaussians
from egs_warp.render.tiles import TileLists


@dataclass(frozen=True)
class CloudGradients:
    """Gradient of a scalar loss with respect to all inputs of an image."""

    means: wp.array
    """(n,) vec3, with respect to the means."""
    rotations: wp.array
    """(n,) vec4, with respect to the stored quaternions; orthogonal to them, because their length has no effect."""
    log_scales: wp.array
    """(n,) vec3, with respect to the log scales."""
    opacity_logits: wp.array
    """(n,) float32, with respect to the opacity logits."""
    sh: wp.array
    """(n, K) vec3, with respect to the SH coefficients."""
    screen: wp.array | None
    """(n,) vec2, with respect to the screen position in pixels; None if not requested."""
    pose_rotation: wp.array | None
    """(n,) mat33, contribution of each Gaussian to the gradient with respect to the camera's rotation matrix; None if
    not requested."""
    pose_translation: wp.array | None
    """(n,) vec3, contribution of each Gaussian to the gradient with respect to the camera's translation; None if not
    requested."""


def backward(
    cloud: GaussianCloud,
    view: Any,
    projected: ProjectedGaussians,
    lists: TileLists,
    image: RenderedImage,
    *,
    colour_gradient: wp.array | None,
    alpha_gradient: wp.array | None,
    depth_gradient: wp.array | None,
    antialiased: bool,
    want_pose: bool,
    want_screen: bool = False,
    threads: int,
    onto: GaussianCloud | None = None,
) -> CloudGradients:
    """Compute the gradients with respect to the Gaussians.

    Args:
        cloud, view, projected, lists, image: inputs and results of the forward pass.
        colour_gradient: (H, W) vec3, gradient with respect to ``image``'s colour; None for zero.
        alpha_gradient, depth_gradient: (H, W) float32, gradients with respect to ``image``'s alpha and depth; None for
            zero.
        antialiased: as in the forward pass.
        want_pose: True to also compute the gradient with respect to the camera pose.
        want_screen: True to also compute the gradient with respect to the screen positions.
        threads: number of CPU threads.
        onto: cloud whose arrays receive the gradients with respect to the attributes; default: new arrays.
    """
    device, count = cloud.device, cloud.count
    (moments,) = empty_pooled(device, ((grow_capacity(projected.slot_count), 3), wp.vec4))
    composite_backward(
        *(view, projected, lists, image, moments),
        colour_gradient=colour_gradient,
        alpha_gradient=alpha_gradient,
        depth_gradient=depth_gradient,
        threads=threads,
    )
    if onto is None:
        means, rotations, log_scales, opacity_logits, sh = empty_pooled(
            device,
            *((count, wp.vec3), (count, wp.vec4), (count, wp.vec3), (count, wp.float32)),
            (cloud.sh.shape, wp.vec3),
        )
        onto = GaussianCloud(means, rotations, log_scales, opacity_logits, sh)
    gradients = CloudGradients(
        *(onto.means, onto.rotations, onto.log_scales),
        *(onto.opacity_logits, onto.sh),
        screen=empty(count, wp.vec2, device) if want_screen else None,
        pose_rotation=empty(count, wp.mat33, device) if want_pose else None,
        pose_translation=empty(count, wp.vec3, device) if want_pose else None,
    )
    gradient_inputs = [projected.slot_end, moments]
    pose_inputs = [cloud.means, cloud.rotations, cloud.log_scales]
    kernel, rows, work, is_blocked = project_backward_kernel, count, None, [None]
    if device.is_cpu:
        kernel, rows, is_blocked = project_backward_block_kernel, -(-count // int(BLOCK)), []
        work = np.ones(rows)
    launch_rows(
        kernel,
        rows,
        inputs=[view, int(antialiased), *pose_inputs, cloud.opacity_logits, cloud.sh, *gradient_inputs, *is_blocked],
        outputs=[*(gradients.means, gradients.rotations, gradients.log_scales, gradients.opacity_logits, gradients.sh)],
        device=device,
        threads=threads,
        work=work,
    )
    if want_pose or want_screen:
        launch_rows(
            pose_backward_kernel,
            count,
            inputs=[view, int(antialiased), *pose_inputs, cloud.sh, *gradient_inputs],
            outputs=[gradients.screen, gradients.pose_rotation, gradients.pose_translation],
            device=device,
            threads=threads,
        )
    return gradients


def composite_backward(
    view: Any,
    projected: ProjectedGaussians,
    lists: TileLists,
    image: RenderedImage,
    moments: wp.array,
    *,
    colour_gradient: wp.array | None,
    alpha_gradient: wp.array | None,
    depth_gradient: wp.array | None,
    threads: int,
) -> None:
    """Write each splat's sums of the pixel gradients to ``moments`` (slots, 3) vec4, in which a GPU also adds the slots
    of Gaussians that have many. The other arguments are those of ``backward``; only the image size of ``view`` is
    used."""
    device = device_of(projected.ellipse)
    tile_inputs = [
        *(view.width, view.height, lists.tile_start, lists.tile_mask),
        *(lists.gaussian_from_intersection, lists.slot_from_intersection),
        *(projected.ellipse, projected.falloff, projected.colour_depth),
    ]
    pixels = [image.colour, image.alpha, image.depth, colour_gradient, alpha_gradient, depth_gradient]
    if device.is_cuda:
        checkpoints, blocks = [None, None], lists.tile_count
        if lists.checkpoints is not None:
            checkpoints = [lists.checkpoints.sums, lists.checkpoints.passing]
            blocks += lists.checkpoints.count - 1
        launch_cached(
            composite_backward_block_kernel,
            blocks * TILE_PIXELS,
            inputs=[lists.tile_count, *tile_inputs, *checkpoints, *pixels],
            outputs=[moments],
            device=device,
        )
        warps = -(-projected.slot_end.shape[0] // int(LANES))
        launch_cached(
            add_moments_kernel,
            warps * int(LANES),
            inputs=[warps, projected.slot_end],
            outputs=[moments],
            device=device,
        )
    else:
        width, height = int(view.width), int(view.height)
        sum_gradient, remaining = empty_pooled(device, ((height, width), wp.vec4), ((height, width), wp.float32))
        launch_rows(
            pixel_gradients_kernel,
            height,
            inputs=pixels,
            outputs=[sum_gradient, remaining],
            device=device,
            threads=threads,
            work=np.ones(height),
        )
        launch_rows(
            composite_backward_tile_kernel,
            lists.tile_count,
            inputs=[*tile_inputs, sum_gradient.flatten(), remaining.flatten()],
            outputs=[moments],
            device=device,
            threads=threads,
            work=lists.tile_work,
        )
