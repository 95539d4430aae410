"""The renderer as a differentiable function of torch tensors. This is the only module of ``render`` that imports
torch."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.launching import available_threads, warp_stream
from egs_warp.render.backward import backward
from egs_warp.render.compositing import PendingImage, RenderedImage
from egs_warp.render.projection import ProjectedGaussians, project, view_from_camera
from egs_warp.render.rasteriser import background_of, tile_mask_array, translate_out_of_memory
from egs_warp.render.tiles import TileLists


@dataclass(frozen=True)
class TorchImage:
    """Differentiable image; the tensors share memory with the renderer's arrays."""

    colour: torch.Tensor
    """(H, W, 3) float32, colour over the background."""
    alpha: torch.Tensor
    """(H, W) float32, one minus the transmittance."""
    depth: torch.Tensor
    """(H, W) float32, expected z-depth divided by alpha."""
    slot_end: wp.array
    """(n,) int64, cumulative number of tiles reached by the Gaussians, inclusive."""

    def visible(self) -> torch.Tensor:
        """Return the mask (n,) bool of Gaussians that reach a tile."""
        slot_end = wp.to_torch(self.slot_end)
        return torch.diff(slot_end, prepend=slot_end.new_zeros(1)) > 0


def render_torch(
    means: torch.Tensor,
    rotations: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: Camera,
    *,
    rotation: torch.Tensor | None = None,
    translation: torch.Tensor | None = None,
    screen: torch.Tensor | None = None,
    background: Any = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    mask: np.ndarray | None = None,
    threads: int | None = None,
) -> TorchImage:
    """Render Gaussians given as float32 tensors on one device: means (n, 3), rotations (n, 4), log scales (n, 3),
    opacity logits (n,) and SH coefficients (n, K, 3).

    Gradients flow to all five tensors, and to the camera pose if it is given as tensors. On CUDA the work is queued on
    torch's current stream.

    Args:
        rotation: (3, 3), replaces the rotation of the camera; its gradient is with respect to the nine entries,
            treated as independent.
        translation: (3,), replaces the translation of the camera; given together with ``rotation`` or not at all.
        screen: (n, 2), values are ignored; it receives the gradient with respect to the screen positions in pixels,
            which densification uses.
        background, antialiased, threads: as for ``render_gaussians``.
        mask: as for ``render_gaussians``; tiles that it excludes do not contribute to the gradients.

    Raises:
        UserError: as for ``render_gaussians``, and if a tensor does not have the required shape, type or device.
    """
    attributes = (means, rotations, log_scales, opacity_logits, sh)
    _check_tensors(*attributes)
    if (rotation is None) != (translation is None):
        given = "translation" if rotation is None else "rotation"
        raise UserError(f"render: only the pose's {given} is given; give rotation and translation together, or neither")
    # Threads are not used on a GPU, and counting them requires a system call.
    threads = 1 if means.is_cuda else threads or available_threads()
    task = _Task(camera, background, antialiased, mask, threads)
    inputs = (*attributes, rotation, translation, screen)
    # Without gradients, skip the overhead of autograd.
    if torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in inputs):
        colour, alpha, depth = _Render.apply(*inputs, task)
        assert task.slot_end is not None
        return TorchImage(colour, alpha, depth, task.slot_end)
    (colour, alpha, depth), forward_pass = _draw(attributes, rotation, translation, task, for_gradients=False)
    return TorchImage(colour, alpha, depth, forward_pass.projected.slot_end)


def _check_tensors(*attributes: torch.Tensor) -> None:
    """Raise ``UserError`` if a tensor does not have the shape, type or device that ``render_torch`` requires."""
    means, _, _, _, sh = attributes
    count, device = means.shape[0], means.device
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, sh.shape[1], 3))
    for number, (tensor, shape) in enumerate(zip(attributes, shapes, strict=True)):
        if tensor.shape != shape or tensor.dtype != torch.float32 or tensor.device != device:
            raise UserError(
                f"render: {ARRAYS[number]} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device},"
                f" expected {shape} float32 on {device}; convert it"
            )


@dataclass
class _Task:
    """Non-tensor arguments of ``_Render``, and its additional output ``slot_end``."""

    camera: Camera
    background: Any
    antialiased: bool
    mask: np.ndarray | None
    threads: int
    slot_end: wp.array | None = None


@dataclass(frozen=True)
class _Forward:
    """Results of the forward pass that the backward pass needs."""

    owners: tuple[torch.Tensor, ...]
    """Tensors that own the memory of the cloud and of the image."""
    cloud: GaussianCloud
    view: Any
    projected: ProjectedGaussians
    lists: TileLists
    image: RenderedImage


def torch_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Return a context in which Warp uses torch's current stream, on devices with streams."""
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(warp_stream(torch.cuda.current_stream(device)), sync_enter=False)


def _cloud_of(tensors: tuple[torch.Tensor, ...]) -> GaussianCloud:
    """Return a cloud that shares the memory of the contiguous ``tensors``; ``wp.from_torch`` would take twice as
    long."""
    addresses = tuple(tensor.data_ptr() for tensor in tensors)
    return _cloud_at(addresses, tensors[0].shape[0], tensors[4].shape[1], wp.device_from_torch(tensors[0].device).alias)


@lru_cache(maxsize=16)
def _cloud_at(addresses: tuple[int, ...], count: int, coefficients: int, device: str) -> GaussianCloud:
    """Return the cloud whose attributes start at these addresses. The cloud owns no memory, so it can be cached."""

    def wrapped(address: int, dtype: Any, *shape: int) -> wp.array:
        return wp.array(ptr=address, dtype=dtype, shape=shape, device=device)

    means, rotations, log_scales, opacity_logits, sh = addresses
    return GaussianCloud(
        means=wrapped(means, wp.vec3, count),
        rotations=wrapped(rotations, wp.vec4, count),
        log_scales=wrapped(log_scales, wp.vec3, count),
        opacity_logits=wrapped(opacity_logits, wp.float32, count),
        sh=wrapped(sh, wp.vec3, count, coefficients),
    )


@lru_cache(maxsize=64)
def _array_at(address: int, dtype: Any, shape: tuple[int, ...], device: str) -> wp.array:
    """Return the array that starts at this address. Like the result of ``_cloud_at``, the array owns no memory."""
    return wp.array(ptr=address, dtype=dtype, shape=shape, device=device)


_PIXEL_TYPES = (wp.vec3, wp.float32, wp.float32)
"""Element types of an image's colour, alpha and depth."""


def _draw(
    attributes: Sequence[torch.Tensor],
    rotation: torch.Tensor | None,
    translation: torch.Tensor | None,
    task: _Task,
    *,
    for_gradients: bool,
) -> tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], _Forward]:
    """Render the Gaussians. Return colour, alpha and depth, and the results of the forward pass that a backward pass
    needs."""
    camera = task.camera
    if rotation is not None and translation is not None:
        camera = replace(
            camera,
            rotation=rotation.detach().double().cpu().numpy(),
            translation=translation.detach().double().cpu().numpy(),
        )
    wp.init()
    tensors = tuple(tensor.detach().contiguous() for tensor in attributes)
    device = tensors[0].device
    with torch_stream(device):
        cloud = _cloud_of(tensors)
        view = view_from_camera(camera)
        threads = task.threads
        with translate_out_of_memory(cloud, camera):
            projected = project(cloud, view, antialiased=task.antialiased, threads=threads)
            shape = (camera.height, camera.width)
            # Allocate with torch, because converting a Warp array to a tensor takes as long as three launches.
            picture = (
                torch.empty((*shape, 3), dtype=torch.float32, device=device),
                torch.empty(shape, dtype=torch.float32, device=device),
                torch.empty(shape, dtype=torch.float32, device=device),
            )
            alias = cloud.device.alias
            onto = RenderedImage(
                *(_array_at(t.data_ptr(), d, shape, alias) for t, d in zip(picture, _PIXEL_TYPES, strict=True))
            )
            behind = background_of(task.background, camera, cloud.device)
            tile_mask = tile_mask_array(task.mask, camera, cloud.device)
            pending = PendingImage(
                *(projected, view),
                background=behind,
                threads=threads,
                onto=onto,
                tile_mask=tile_mask,
                for_gradients=for_gradients,
            ).result()
    # These tensors own the memory that the Warp arrays refer to.
    owners = (*tensors, *(tensor.detach() for tensor in picture))
    return picture, _Forward(owners, cloud, view, projected, pending.lists, pending.image)


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[torch.Tensor, ...]:
        *attributes, rotation, translation, _screen, task = arguments
        picture, ctx.forward_pass = _draw(attributes, rotation, translation, task, for_gradients=True)
        ctx.task = task
        ctx.want_pose = rotation is not None and (ctx.needs_input_grad[5] or ctx.needs_input_grad[6])
        ctx.set_materialize_grads(False)
        task.slot_end = ctx.forward_pass.projected.slot_end
        return picture

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *pixel_gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        forward_pass: _Forward = ctx.forward_pass
        device = forward_pass.owners[0].device
        with torch_stream(device):
            alias = forward_pass.cloud.device.alias
            # Keep these tensors alive until the kernels that read them are queued.
            inputs = tuple(None if gradient is None else gradient.detach().contiguous() for gradient in pixel_gradients)
            shape = forward_pass.image.alpha.shape
            by_colour, by_alpha, by_depth = (
                None if gradient is None else _array_at(gradient.data_ptr(), dtype, shape, alias)
                for gradient, dtype in zip(inputs, _PIXEL_TYPES, strict=True)
            )
            with translate_out_of_memory(forward_pass.cloud, ctx.task.camera):
                by_attributes = tuple(torch.empty_like(tensor) for tensor in forward_pass.owners[:5])
                gradients = backward(
                    *(
                        forward_pass.cloud,
                        forward_pass.view,
                        forward_pass.projected,
                        forward_pass.lists,
                        forward_pass.image,
                    ),
                    colour_gradient=by_colour,
                    alpha_gradient=by_alpha,
                    depth_gradient=by_depth,
                    antialiased=ctx.task.antialiased,
                    want_pose=ctx.want_pose,
                    want_screen=ctx.needs_input_grad[7],
                    threads=ctx.task.threads,
                    onto=_cloud_of(by_attributes),
                )
            # The gradient with respect to the pose is the sum over the Gaussians.
            by_pose = (
                None if part is None else wp.to_torch(part).sum(dim=0)
                for part in (gradients.pose_rotation, gradients.pose_translation)
            )
            by_screen = None if gradients.screen is None else wp.to_torch(gradients.screen)
            return (*by_attributes, *by_pose, by_screen, None)
