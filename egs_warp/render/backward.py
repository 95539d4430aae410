"""From gradients of pixels to gradients of Gaussians and of the camera's pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from egs_warp.gaussians import GaussianCloud
from egs_warp.kernels.render_backward import (
    pixel_gradients_kernel,
    project_backward_kernel,
)
from egs_warp.launching import launch_rows
from egs_warp.render.arrays import empty, zeros
from egs_warp.render.compositing import RenderedImage
from egs_warp.render.projection import ProjectedGaussians
from egs_warp.render.tiles import TileLists


@dataclass(frozen=True)
class CloudGradients:
    """Gradient of a scalar loss by everything that shaped the picture."""

    means: wp.array
    """(n,) vec3."""
    rotations: wp.array
    """(n,) vec4, by the quaternion as stored; orthogonal to it, because its length does not matter."""
    log_scales: wp.array
    """(n,) vec3."""
    opacity_logits: wp.array
    """(n,) float32."""
    sh: wp.array
    """(n, K) vec3."""
    screen: wp.array
    """(n,) vec2, by the centre on the screen in pixels; densification watches it."""
    pose_rotation: wp.array
    """(n,) mat33: each Gaussian's part of the gradient by the camera's rotation matrix; (0,) where not asked for."""
    pose_translation: wp.array
    """(n,) vec3, likewise for the translation."""


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
    threads: int,
) -> CloudGradients:
    """From gradients (H, W) by ``image``'s colour (vec3), alpha and depth (float32); None stands for zero."""
    device, count = cloud.device, cloud.count
    pixels = int(view.width) * int(view.height)
    sum_gradient = empty(pixels, wp.vec4, device)
    remaining = empty(pixels, wp.float32, device)
    wp.launch(
        pixel_gradients_kernel,
        dim=(view.height, view.width),
        inputs=[image.colour, image.alpha, image.depth, colour_gradient, alpha_gradient, depth_gradient],
        outputs=[sum_gradient, remaining],
        device=device,
    )
    # Zero, because pairs behind the last open pixel of a tile are never visited.
    moments = zeros((max(projected.slot_count, 1), 3), wp.vec4, device)
    inputs = [
        *(view.width, view.height, lists.tile_start, lists.gaussian_from_intersection, lists.slot_from_intersection),
        *(projected.ellipse, projected.falloff, projected.colour_depth, sum_gradient, remaining),
    ]
    if device.is_cuda:
        # Imported here because this module holds CUDA code that a CPU cannot compile.
        from egs_warp.kernels.render_cuda import composite_backward_block_kernel

        wp.launch(
            composite_backward_block_kernel,
            dim=lists.tile_count * 256,
            inputs=inputs,
            outputs=[moments],
            device=device,
            block_dim=256,
        )
    else:
        # Likewise: a GPU's compiler would refuse this one.
        from egs_warp.kernels.render_cpu import composite_backward_tile_kernel

        launch_rows(
            composite_backward_tile_kernel,
            lists.tile_count,
            inputs=inputs,
            outputs=[moments],
            device=device,
            threads=threads,
            work=lists.work,
        )
    poses = count if want_pose else 0
    gradients = CloudGradients(
        means=empty(count, wp.vec3, device),
        rotations=empty(count, wp.vec4, device),
        log_scales=empty(count, wp.vec3, device),
        opacity_logits=empty(count, wp.float32, device),
        sh=empty(cloud.sh.shape, wp.vec3, device),
        screen=empty(count, wp.vec2, device),
        pose_rotation=empty(poses, wp.mat33, device),
        pose_translation=empty(poses, wp.vec3, device),
    )
    launch_rows(
        project_backward_kernel,
        count,
        inputs=[
            *(view, int(antialiased), cloud.means, cloud.rotations, cloud.log_scales, cloud.opacity_logits, cloud.sh),
            *(projected.ellipse, projected.slot_end, moments),
        ],
        outputs=[getattr(gradients, name) for name in gradients.__dataclass_fields__],
        device=device,
        threads=threads,
    )
    return gradients
