"""A capture from posed photos: what ``egs-warp train`` calls.

Imports torch, so import it only where something is trained.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render import render_gaussians
from egs_warp.training.finetune import Densification, FinetuneOptions, Rates, TrainingView, finetune, psnr, ssim
from egs_warp.training.posed_photos import backdrop_colour, laid_over, read_views
from egs_warp.training.rough_cloud import rough_cloud

_HOLD_OUT_EVERY = 8
"""As published methods do: every eighth photo is judged on and not trained on."""


@dataclass(frozen=True)
class PhotoScore:
    """How well the capture shows one photo."""

    name: str
    held_out: bool
    psnr: float
    """dB."""
    ssim: float
    """Mean structural similarity, 11 x 11 Gaussian window."""


@dataclass(frozen=True)
class TrainResult:
    """What training from photos gave."""

    cloud: GaussianCloud
    losses: np.ndarray
    """(iterations,) float64."""
    views: tuple[TrainingView, ...]
    """Every photo as it was trained or judged on: reduced and laid over the background."""
    scores: tuple[PhotoScore, ...]
    """One for each of ``views``."""
    background: tuple[float, float, float]
    """The colour behind the capture."""

    def mean_score(self, *, held_out: bool) -> tuple[float, float] | None:
        """Mean PSNR and SSIM of the photos held out, or of those trained on; None where there are none."""
        chosen = [(score.psnr, score.ssim) for score in self.scores if score.held_out is held_out]
        if not chosen:
            return None
        psnr_mean, ssim_mean = np.mean(chosen, axis=0)
        return float(psnr_mean), float(ssim_mean)


def train(
    posed: Path | str,
    *,
    iterations: int = 3000,
    max_gaussians: int = 50_000,
    sh_degree: int = 2,
    background: tuple[float, float, float] | None = None,
    max_side: int | None = None,
    seed: int = 0,
    device: str | None = None,
    threads: int | None = None,
    progress: Callable[[int, float], None] | None = None,
    stage: Callable[[str], None] | None = None,
) -> TrainResult:
    """Make a capture from the photos that ``posed`` (COLMAP, ``transforms.json`` or ``cameras.json``) points to.

    Photos larger than ``max_side`` pixels are reduced. Every eighth photo is held out and judged on. Photos with alpha
    or masks (``read_views``) are trained before a random colour each step, so that nothing can pass for the backdrop.
    They are judged before ``background``; without one, it is white for those and the mean colour along the photos'
    borders for others, so that no Gaussians are spent on a plain backdrop. ``progress`` is called with each step's
    number and loss, ``stage`` with what begins. Raises ``UserError`` for missing photos and impossible options.
    """
    if iterations < 1 or max_gaussians < 100 or not 0 <= sh_degree <= 3:
        raise UserError(
            f"train: {iterations} iterations, {max_gaussians} Gaussians and SH degree {sh_degree};"
            " give at least 1, at least 100, and 0 to 3"
        )
    say = stage or (lambda _text: None)
    say(f"reading {posed}")
    photos = read_views(posed, max_side=max_side)
    background = background or backdrop_colour(photos)
    views = tuple(laid_over(view, background) for view in photos)
    held_out = [len(views) >= _HOLD_OUT_EVERY and number % _HOLD_OUT_EVERY == 0 for number in range(len(views))]
    cut_out = all(view.alpha is not None for view in photos)
    chosen = [view for view, out in zip(photos if cut_out else views, held_out, strict=True) if not out]
    start = rough_cloud(chosen, count=max(100, max_gaussians // 3), sh_degree=sh_degree, seed=seed, device=device)
    options = FinetuneOptions(
        iterations=iterations,
        # Short runs cannot wait for the rates of 30,000 steps.
        rates=Rates(means=1.6e-4 * min(4.0, max(1.0, 30_000 / iterations) ** 0.5)),
        background=None if cut_out else background,
        densification=Densification.RELOCATION,
        max_gaussians=max_gaussians,
        seed=seed,
        threads=threads,
    )
    say(f"training on {len(chosen)} photos (the first run compiles kernels: up to a minute)")
    result = finetune(start, chosen, options=options, progress=progress)
    say("judging every photo")
    scores = tuple(
        _score(result.cloud, view, background, held_out=out, threads=threads)
        for view, out in zip(views, held_out, strict=True)
    )
    return TrainResult(result.cloud, result.losses, views, scores, background)


def _score(
    cloud: GaussianCloud,
    view: TrainingView,
    background: tuple[float, float, float],
    *,
    held_out: bool,
    threads: int | None,
) -> PhotoScore:
    picture = np.clip(render_gaussians(cloud, view.camera, background=background, threads=threads).colour.numpy(), 0, 1)
    likeness = float(ssim(torch.as_tensor(picture), torch.as_tensor(view.image)))
    return PhotoScore(view.name, held_out, psnr(picture, view.image), likeness)
