"""The renderer as a function of torch tensors, with gradients. The only module of ``render`` that imports torch."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import torch
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.launching import available_threads
from egs_warp.render.backward import backward
from egs_warp.render.compositing import RenderedImage, composite
from egs_warp.render.projection import ProjectedGaussians, project, view_from_camera
from egs_warp.render.rasteriser import background_of, refusing_what_does_not_fit
from egs_warp.render.tiles import TileLists, build_tile_lists


@dataclass(frozen=True)
class TorchImage:
    """One differentiable picture; the tensors share memory with the renderer's arrays."""

    colour: torch.Tensor
    """(H, W, 3) float32."""
    alpha: torch.Tensor
    """(H, W) float32."""
    depth: torch.Tensor
    """(H, W) float32, expected z-depth divided by alpha."""
    slot_end: wp.array
    """(n,) int64: number of tiles reached by the Gaussians up to and including this one."""

    def visible(self) -> torch.Tensor:
        """(n,) bool: Gaussians that reach a tile."""
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
    threads: int | None = None,
) -> TorchImage:
    """Picture of Gaussians given as float32 tensors (n, 3), (n, 4), (n, 3), (n,), (n, K, 3), all on one device.

    Gradients flow to all five, and to the camera's pose where ``rotation`` (3, 3) and ``translation`` (3,) are given
    (they then replace the camera's; the gradient by ``rotation`` is by its nine entries, taken as free). ``screen``
    (n, 2), any values, receives the gradient by the screen positions in pixels, which densification by splitting
    watches. On CUDA the work is queued on torch's current stream. Raises ``UserError`` as ``render_gaussians`` does.
    """
    tensors = {
        "means": (means, (len(means), 3)),
        "rotations": (rotations, (len(means), 4)),
        "log_scales": (log_scales, (len(means), 3)),
        "opacity_logits": (opacity_logits, (len(means),)),
        "sh": (sh, (len(means), sh.shape[1], 3)),
    }
    for name, (tensor, shape) in tensors.items():
        if tuple(tensor.shape) != shape or tensor.dtype != torch.float32 or tensor.device != means.device:
            raise UserError(
                f"render: {name} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device},"
                f" expected {shape} float32 on {means.device}"
            )
    if (rotation is None) != (translation is None):
        raise UserError("render: give the pose's rotation and translation together, or neither")
    task = _Task(camera, background, antialiased, threads or available_threads())
    colour, alpha, depth = _Render.apply(
        *(means, rotations, log_scales, opacity_logits, sh, rotation, translation, screen, task)
    )
    assert task.slot_end is not None
    return TorchImage(colour, alpha, depth, task.slot_end)


@dataclass
class _Task:
    """What goes into and comes out of ``_Render`` besides tensors."""

    camera: Camera
    background: Any
    antialiased: bool
    threads: int
    slot_end: wp.array | None = None


@dataclass(frozen=True)
class _Forward:
    """What the backward pass needs of the forward pass."""

    tensors: tuple[torch.Tensor, ...]
    """Owners of the cloud's memory."""
    cloud: GaussianCloud
    view: Any
    projected: ProjectedGaussians
    lists: TileLists
    image: RenderedImage


def torch_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Warp works on the stream that torch works on, where there are streams."""
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(_warp_stream(torch.cuda.current_stream(device)), sync_enter=False)


@cache
def _warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """Made once: there are few streams, and each is used at every step."""
    return wp.stream_from_torch(stream)


def _cloud_of(tensors: tuple[torch.Tensor, ...]) -> GaussianCloud:
    """The contiguous ``tensors`` as a capture without a copy; ``wp.from_torch`` would take twice as long."""
    places = tuple(tensor.data_ptr() for tensor in tensors)
    return _cloud_at(places, tensors[0].shape[0], tensors[4].shape[1], wp.device_from_torch(tensors[0].device).alias)


@lru_cache(maxsize=16)
def _cloud_at(places: tuple[int, ...], count: int, coefficients: int, device: str) -> GaussianCloud:
    """The capture whose attributes begin at these addresses; it owns no memory, so it may be made once for all."""

    def wrapped(place: int, dtype: Any, *shape: int) -> wp.array:
        return wp.array(ptr=place, dtype=dtype, shape=shape, device=device)

    means, rotations, log_scales, opacity_logits, sh = places
    return GaussianCloud(
        means=wrapped(means, wp.vec3, count),
        rotations=wrapped(rotations, wp.vec4, count),
        log_scales=wrapped(log_scales, wp.vec3, count),
        opacity_logits=wrapped(opacity_logits, wp.float32, count),
        sh=wrapped(sh, wp.vec3, count, coefficients),
    )


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[torch.Tensor, ...]:
        *attributes, rotation, translation, _screen, task = arguments
        camera = task.camera
        if rotation is not None:
            camera = replace(
                camera,
                rotation=rotation.detach().double().cpu().numpy(),
                translation=translation.detach().double().cpu().numpy(),
            )
        wp.init()
        tensors = tuple(tensor.detach().contiguous() for tensor in attributes)
        with torch_stream(tensors[0].device):
            cloud = _cloud_of(tensors)
            view = view_from_camera(camera)
            threads = task.threads
            with refusing_what_does_not_fit(cloud, camera):
                projected = project(cloud, view, antialiased=task.antialiased, threads=threads)
                lists = build_tile_lists(projected, view, threads=threads)
                behind = background_of(task.background, camera, cloud.device)
                image = composite(projected, lists, view, background=behind, threads=threads)
            ctx.forward_pass = _Forward(tensors, cloud, view, projected, lists, image)
            ctx.task = task
            ctx.want_pose = rotation is not None and (ctx.needs_input_grad[5] or ctx.needs_input_grad[6])
            ctx.set_materialize_grads(False)
            task.slot_end = projected.slot_end
            return wp.to_torch(image.colour), wp.to_torch(image.alpha), wp.to_torch(image.depth)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *pixel_gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        done: _Forward = ctx.forward_pass
        device = wp.device_to_torch(done.cloud.device)
        with torch_stream(torch.device(device)):
            by_colour, by_alpha, by_depth = (
                None if gradient is None else wp.from_torch(gradient.detach().contiguous(), dtype=dtype)
                for gradient, dtype in zip(pixel_gradients[:3], (wp.vec3, wp.float32, wp.float32), strict=True)
            )
            with refusing_what_does_not_fit(done.cloud, ctx.task.camera):
                gradients = backward(
                    *(done.cloud, done.view, done.projected, done.lists, done.image),
                    colour_gradient=by_colour,
                    alpha_gradient=by_alpha,
                    depth_gradient=by_depth,
                    antialiased=ctx.task.antialiased,
                    want_pose=ctx.want_pose,
                    want_screen=ctx.needs_input_grad[7],
                    threads=ctx.task.threads,
                )
            names = ("means", "rotations", "log_scales", "opacity_logits", "sh", "pose_rotation", "pose_translation")
            arrays = [getattr(gradients, name) for name in (*names, "screen")]
            tensors = [None if array is None else wp.to_torch(array) for array in arrays]
            # The pose's gradient is the sum of every Gaussian's part.
            for index in (5, 6):
                part = tensors[index]
                tensors[index] = None if part is None else part.sum(dim=0)
            return (*tensors, None)
