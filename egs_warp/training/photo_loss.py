"""Loss of a render compared with a photo, at the photo's exposure: L1 and SSIM, and their gradients, in six kernel
launches.

The kernels are in ``egs_warp/kernels/training/photo_loss.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.kernels.training import ssim_cpu, ssim_cuda
from egs_warp.kernels.training.photo_loss import gradient_kernel, tone_kernel
from egs_warp.kernels.training.ssim import PADDING, REACH
from egs_warp.launching import device_of, launch_rows
from egs_warp.render.autograd import torch_stream

_PADDED = (
    *("toned", "photo", "mean_a", "mean_b", "aa", "bb", "ab", "similarity"),
    *("by_mean", "by_square", "by_product", "by_mean_rows", "by_square_rows", "by_product_rows", "by_similarity"),
)
"""Names of the images with padded rows."""


@dataclass(frozen=True)
class Target:
    """A photo on the device of the training."""

    image: torch.Tensor
    """(H, W, 3) float32, colours of the photo, 0 to 1."""
    alpha: torch.Tensor | None
    """(H, W) float32; if given, the photo is composited over the backdrop of the step."""
    weight: torch.Tensor | None
    """(H, W) float32, weight of each pixel in L1; pixels of weight 0 are excluded from SSIM, too."""


class PhotoLoss:
    """The loss (1 - w) L1 + w (1 - SSIM). Its buffers are reused in every step; with ``max_sizes``, only those of this
    number of image sizes remain allocated."""

    def __init__(self, ssim_weight: float, device: str, threads: int | None, *, max_sizes: int | None = None) -> None:
        wp.init()
        self.ssim_weight = ssim_weight
        self.threads = threads
        line = torch.exp(-(torch.arange(-5.0, 6.0) ** 2) / (2 * 1.5**2))
        self.window = (line / line.sum()).to(device)
        self._none = torch.zeros(3, device=device)
        self._max_sizes = max_sizes
        self._scratch: dict[tuple[int, int], LossScratch] = {}

    def __call__(
        self,
        colour: torch.Tensor,
        alpha: torch.Tensor,
        tone: torch.Tensor,
        target: Target,
        backdrop: tuple[float, ...],
    ) -> torch.Tensor:
        """Compute the scalar loss of a render.

        Gradients flow to ``colour``, ``alpha`` and ``tone``. If the photo has alpha, the colour map is applied to the
        render before it is composited over the backdrop.

        Args:
            colour: (H, W, 3) render; over black if the photo has alpha.
            alpha: (H, W) alpha of the render.
            tone: (3, 4) colour map of the view.
            target: the photo.
            backdrop: colour behind the render and the photo, if the photo has alpha.
        """
        return _Loss.apply(colour, alpha, tone, target, backdrop, self)  # type: ignore[return-value]

    def launch(self, arrays: LossArrays, height: int, width: int) -> LossScratch:
        """Launch the kernels of the loss and its gradients for images of ``height`` x ``width`` pixels.

        Returns:
            The buffers that contain the results until the next call.
        """
        pixels, w, pitch = height * width, self.ssim_weight, self.pitch(width)
        cut_out = int(arrays.image_alpha is not None)
        scratch = self.scratch(height, width)
        at, device = scratch.arrays, device_of(arrays.colour)
        kernels = (ssim_cpu if device.is_cpu else ssim_cuda).KERNELS
        blocks = -(-3 * width // kernels.lanes)
        products = [at[name] for name in ("mean_a", "mean_b", "aa", "bb", "ab")]
        derivatives = [at[name] for name in ("by_mean", "by_square", "by_product")]
        rows = [at[name] for name in ("by_mean_rows", "by_square_rows", "by_product_rows")]
        window, nothing = _array(self.window, wp.float32), _array(self._none[:1], wp.float32)
        backdrop = _array(self._none, wp.vec3) if arrays.backdrop is None else arrays.backdrop
        # The kernels recognise an absent weight by its length of 1.
        weight = nothing if arrays.weight is None else arrays.weight

        def launch(kernel: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
            launch_rows(kernel, count, inputs=inputs, outputs=outputs, device=device, threads=self.threads)

        # A thread of a CPU processes a row of pixels, a thread of a GPU one pixel.
        run = width if device.is_cpu else 1
        work = np.ones(height) if device.is_cpu else None

        def launch_runs(kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
            options: dict[str, Any] = {"device": device, "threads": self.threads, "work": work}
            launch_rows(kernel, pixels // run, inputs=[run, *inputs], outputs=outputs, **options)

        image_alpha = nothing if arrays.image_alpha is None else arrays.image_alpha
        launch_runs(
            tone_kernel,
            [
                *(width, pitch, cut_out, backdrop, arrays.tone, arrays.colour, arrays.alpha),
                *(arrays.image, image_alpha, weight),
            ],
            [at["toned"], at["photo"], at["front"], at["off"]],
        )
        count, images = height * blocks, [at["toned"], at["photo"]]
        launch(kernels.blur_products, count, [blocks, pitch, window, *images], products)
        launch(kernels.similarity, count, [blocks, pitch, width, window, *products], [at["similarity"], *derivatives])
        launch(kernels.blur_derivatives, count, [blocks, pitch, window, *derivatives], rows)
        launch(kernels.gradient, count, [blocks, pitch, window, *images, *rows], [at["by_similarity"]])
        launch_runs(
            gradient_kernel,
            [width, height, pitch, w, cut_out, backdrop, arrays.tone, weight, *images, at["by_similarity"]],
            [at["by_toned"], arrays.by_colour, nothing if arrays.by_alpha is None else arrays.by_alpha],
        )
        return scratch

    def scratch(self, height: int, width: int) -> LossScratch:
        """Return the buffers for images of ``height`` x ``width`` pixels."""
        if (height, width) not in self._scratch:
            if len(self._scratch) == self._max_sizes:
                del self._scratch[next(iter(self._scratch))]
            device = self.window.device
            pixels, padded = height * width, PADDING + (height + 2 * REACH) * self.pitch(width)
            tensors = {
                # The kernels read the padding but never write it, so it remains zero.
                **{name: torch.zeros(padded, device=device) for name in _PADDED},
                "front": torch.empty((pixels, 4), device=device),
                "by_toned": torch.empty((pixels, 3), device=device),
                "off": torch.empty(pixels, device=device),
            }
            types = {"front": wp.vec4, "by_toned": wp.vec3}
            arrays = {name: _array(tensor, types.get(name, wp.float32)) for name, tensor in tensors.items()}
            self._scratch[height, width] = LossScratch(tensors, arrays)
        return self._scratch[height, width]

    @staticmethod
    def pitch(width: int) -> int:
        """Return the number of floats in a padded row of ``width`` pixels, a multiple of ``PADDING``."""
        return -(-(3 * width + PADDING) // PADDING) * PADDING


@dataclass(frozen=True)
class LossArrays:
    """Inputs and outputs of the loss on the device, as Warp arrays."""

    colour: wp.array
    """(H * W,) vec3, the render."""
    alpha: wp.array
    """(H * W,) float32, alpha of the render."""
    tone: wp.array
    """(12,) float32, colour map of the view, by rows."""
    image: wp.array
    """(H * W,) vec3, the photo."""
    image_alpha: wp.array | None
    """(H * W,) float32, alpha of the photo; None if it is opaque."""
    weight: wp.array | None
    """(H * W,) float32, weight of each pixel; None weights all pixels equally."""
    backdrop: wp.array | None
    """(1,) vec3, colour behind the photo; None if it is opaque."""
    by_colour: wp.array
    """(H * W,) vec3, receives the gradient with respect to ``colour``."""
    by_alpha: wp.array | None
    """(H * W,) float32, receives the gradient with respect to ``alpha``; None if the photo is opaque."""


@dataclass(frozen=True)
class LossScratch:
    """Buffers by name, as tensors and as Warp arrays of the same memory."""

    tensors: dict[str, torch.Tensor]
    arrays: dict[str, wp.array]


def _array(tensor: torch.Tensor, dtype: Any) -> wp.array:
    """View the contiguous ``tensor`` as a Warp array of one dimension, without a copy."""
    device = wp.device_from_torch(tensor.device)
    return _array_at(tensor.data_ptr(), dtype, tensor.numel() // wp.types.type_size(dtype), device.alias)


@lru_cache(maxsize=1024)
def _array_at(address: int, dtype: Any, count: int, device: str) -> wp.array:
    """Return the array at this address. The array does not own its memory, so it can be cached."""
    return wp.array(ptr=address, dtype=dtype, shape=(count,), device=device)


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        colour: torch.Tensor,
        alpha: torch.Tensor,
        tone: torch.Tensor,
        target: Target,
        backdrop: tuple[float, ...],
        task: PhotoLoss,
    ) -> torch.Tensor:
        height, width = colour.shape[:2]
        pixels = height * width
        cut_out = target.alpha is not None
        by_colour = torch.empty((pixels, 3), device=colour.device)
        by_alpha = torch.empty(pixels, device=colour.device) if cut_out else None
        behind = torch.tensor([backdrop], device=colour.device) if cut_out else None
        colour, alpha, tone = (value.detach().contiguous() for value in (colour, alpha, tone))

        def of(value: torch.Tensor | None, dtype: Any = wp.float32) -> wp.array | None:
            return None if value is None else _array(value, dtype)

        arrays = LossArrays(
            *(_array(colour, wp.vec3), _array(alpha, wp.float32), _array(tone, wp.float32)),
            *(_array(target.image, wp.vec3), of(target.alpha), of(target.weight), of(behind, wp.vec3)),
            *(_array(by_colour, wp.vec3), of(by_alpha)),
        )
        with torch_stream(colour.device):
            buffers = task.launch(arrays, height, width).tensors
        # New tensors hold these gradients, because the next call overwrites the buffers.
        ctx.gradients = (
            by_colour.reshape(height, width, 3),
            None if by_alpha is None else by_alpha.reshape(height, width),
            buffers["by_toned"].T @ buffers["front"],
        )
        return (1.0 - task.ssim_weight) * buffers["off"].mean() + task.ssim_weight * (
            1.0 - buffers["similarity"].sum() / (3 * pixels)
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *by_loss: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        by_colour, by_alpha, by_tone = ctx.gradients
        (by,) = by_loss
        return by_colour * by, None if by_alpha is None else by_alpha * by, by_tone * by, None, None, None
