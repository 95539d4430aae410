"""Steps of a training run whose parameters are known in advance, and the autograd implementation of these steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.geometry.camera import Camera
from egs_warp.render.autograd import render_torch
from egs_warp.training.exposure import ExposureModel
from egs_warp.training.gaussian_tensors import MIN_LOG_SCALE, GaussianTensors
from egs_warp.training.metrics import ssim
from egs_warp.training.photo_loss import PhotoLoss, Target
from egs_warp.training.relocation import Population
from egs_warp.training.training_view import TrainingView

ExtraLoss = Callable[[GaussianTensors], torch.Tensor]
_BLACK = (0.0, 0.0, 0.0)
_MAX_SIZES = 8
"""Maximum number of image sizes whose buffers of the loss remain allocated."""


@dataclass(frozen=True)
class PlannedStep:
    """Everything that a step needs besides the tensors."""

    step: int
    view: int
    """Index of the view."""
    factor: int
    """Factor by which the sides of the image are divided."""
    background: tuple[float, float, float]
    coefficients: int
    """Number of SH coefficients that are trained."""
    rates: Mapping[str, float]
    """Learning rates by tensor."""
    tone_rate: float = 0.0
    """Learning rate and bias correction of the view's colour map (``ExposureModel.visit``)."""
    tone_bias: float = 1.0


class AutogradSteps:
    """Steps with PyTorch's autograd and optimiser, on any device and with any loss."""

    def __init__(
        self,
        views: Sequence[TrainingView],
        factors: set[int],
        population: Population,
        tones: ExposureModel | None,
        *,
        ssim_weight: float,
        antialiased: bool,
        relocating: bool,
        frozen: torch.Tensor | None,
        extra_loss: ExtraLoss | None,
        threads: int | None,
    ) -> None:
        self._population, self._tones = population, tones
        device = str(population.tensors["means"].device)
        self._pictures = {factor: [_picture(view.reduced(factor), device) for view in views] for factor in factors}
        self._photo_loss = PhotoLoss(ssim_weight, device, threads, max_sizes=_MAX_SIZES)
        self._antialiased, self._relocating, self._threads = antialiased, relocating, threads
        self._frozen, self._extra_loss = frozen, extra_loss

    def run(self, plans: Sequence[PlannedStep]) -> list[float]:
        """Take the steps and return their losses."""
        return torch.stack([self._take(plan) for plan in plans]).tolist()

    def store(self) -> None:
        """Do nothing; the tensors of the population are always up to date."""

    def _take(self, plan: PlannedStep) -> torch.Tensor:
        population, tones = self._population, self._tones
        tensors = GaussianTensors(**population.tensors)
        camera, target = self._pictures[plan.factor][plan.view]
        # A photo with alpha is compared over the background, with a colour map that applies to the object only.
        over_black = tones is not None and target.alpha is not None
        image = render_torch(
            *(tensors.means, tensors.rotations, tensors.log_scales, tensors.opacity_logits),
            torch.cat([tensors.sh_band_0, tensors.sh_rest[:, : plan.coefficients - 1]], dim=1),
            camera,
            background=_BLACK if over_black else plan.background,
            antialiased=self._antialiased,
            threads=self._threads,
        )
        if tones is None:
            loss = _loss(target, image.colour, plan.background, self._photo_loss.ssim_weight)
        else:
            loss = self._photo_loss(image.colour, image.alpha, tones.tensor_for(plan.view), target, plan.background)
        value = loss.detach()
        if self._extra_loss is not None:
            loss = loss + self._extra_loss(tensors)
        loss.backward()
        if self._relocating:
            population.add_regularization()
        if self._frozen is not None:
            for tensor in population.tensors.values():
                if tensor.grad is not None:
                    tensor.grad[self._frozen] = 0.0
        population.step(plan.rates)
        if tones is not None:
            tones.step(plan.view, plan.tone_rate, plan.tone_bias)
        with torch.no_grad():
            population.tensors["log_scales"].clamp_(min=MIN_LOG_SCALE)
        if self._relocating:
            population.jitter(plan.rates["means"])
        return value


def _picture(view: TrainingView, device: str) -> tuple[Camera, Target]:
    def upload(values: np.ndarray | None) -> torch.Tensor | None:
        return None if values is None else torch.as_tensor(values, dtype=torch.float32, device=device).contiguous()

    image = upload(view.image)
    assert image is not None
    return view.camera, Target(image, upload(view.alpha), upload(view.weight))


def _loss(target: Target, picture: torch.Tensor, background: Sequence[float], ssim_weight: float) -> torch.Tensor:
    image = target.image
    if target.alpha is not None:
        alpha = target.alpha[:, :, None]
        image = image * alpha + (1 - alpha) * torch.tensor(background, device=image.device)
    difference = (picture - image).abs()
    if target.weight is not None:
        difference = difference * target.weight[:, :, None]
        # Pixels of weight 0 must not contribute to the windows of SSIM either.
        picture = torch.where(target.weight[:, :, None] > 0, picture, image)
    loss = (1 - ssim_weight) * difference.mean()
    if ssim_weight > 0:
        loss = loss + ssim_weight * (1 - ssim(picture, image))
    return loss
