"""Training of a capture from posed photos (``egs-warp train``).

This module imports torch; import it only for training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.cameras import read_points
from egs_warp.io.posed_images import ExcludedPhoto
from egs_warp.render import render_gaussians
from egs_warp.short_repr import short_repr
from egs_warp.training.finetune import Densification, FinetuneOptions, LearningRates, finetune
from egs_warp.training.initial_cloud import MIN_POINTS, cloud_from_points, initial_cloud
from egs_warp.training.metrics import match_tone, psnr, ssim_of
from egs_warp.training.outlier_views import is_outlier
from egs_warp.training.posed_photos import PhotoSources, backdrop_colour, laid_over, read_views
from egs_warp.training.training_view import TrainingView

_HOLD_OUT_EVERY = 8
"""Interval of the held-out photos: every eighth photo is used for evaluation instead of training, as is common in the
literature."""
_SH_STAGES = 10
"""Number of parts into which a training run is divided; after each tenth of the iterations, the SH degree is increased,
up to the requested one."""
_FULL_STEPS = 7000
"""Number of iterations for which the learning rates were chosen. In a shorter training run, they are multiplied by the
square root of ``_FULL_STEPS`` / iterations, because the distance that n noisy Adam steps cover grows as rate times
sqrt(n)."""
_MAX_RATE_FACTOR = 4.0
"""Maximum factor on the learning rates. In training runs of 1,000 iterations, rates multiplied by four gave a higher
PSNR than rates multiplied by three in two of three scenes."""
_FIRST_GAUSSIANS = 30_000
"""Initial number of Gaussians if there are no triangulated points; a third of the maximum number if that is lower."""


@dataclass(frozen=True)
class PhotoScore:
    """Image quality of the capture in the view of one photo."""

    name: str
    held_out: bool
    psnr: float
    """Peak signal-to-noise ratio, dB, of the render after an affine map of its colours that is fitted to the exposure
    and white balance of the photo."""
    ssim: float
    """Mean structural similarity of the same render, 11 x 11 Gaussian window."""
    plain_psnr: float
    """Peak signal-to-noise ratio, dB, of the render without the affine map."""
    plain_ssim: float
    """Mean structural similarity of the render without the affine map."""
    is_outlier: bool = False
    """True if the photo does not fit the others, because its pose is wrong or something moved. The mean scores exclude
    such photos."""


@dataclass(frozen=True)
class MeanScore:
    """Mean image quality over several photos."""

    psnr: float
    """Mean peak signal-to-noise ratio, dB."""
    ssim: float


@dataclass(frozen=True)
class TrainResult:
    """Result of a training run on photos."""

    __repr__ = short_repr

    cloud: GaussianCloud
    """The trained capture."""
    losses: np.ndarray
    """(iterations,) float64, loss of each iteration."""
    views: tuple[TrainingView, ...]
    """Photos as used for evaluation: undistorted, downscaled and composited over the background."""
    photos: tuple[TrainingView, ...]
    """The same photos with their alpha, if they have any."""
    cut_out: bool
    """True if all photos have alpha, so that the training used random background colours."""
    scores: tuple[PhotoScore, ...]
    """Score of each of ``views``."""
    background: tuple[float, float, float]
    """Background colour, 0 to 1."""
    sources: PhotoSources
    """Files from which the photos were read, and the numbers of photos."""
    excluded: tuple[ExcludedPhoto, ...] = ()
    """Photos that were not used, or were excluded during the training, and the reasons."""

    def mean_score(self, *, held_out: bool) -> MeanScore | None:
        """Return the mean over the held-out or over the training photos, without outliers; None if there are none."""
        chosen = [(s.psnr, s.ssim) for s in self.scores if s.held_out is held_out and not s.is_outlier]
        return MeanScore(*np.mean(chosen, axis=0).tolist()) if chosen else None


def train(
    posed: Path | str,
    *,
    iterations: int = 3000,
    max_gaussians: int | None = 50_000,
    sh_degree: int = 3,
    background: tuple[float, float, float] | None = None,
    max_side: int | None = None,
    inverted_masks: bool | None = None,
    seed: int = 0,
    device: str | None = None,
    threads: int | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, float], None] | None = None,
    stage: Callable[[str], None] | None = None,
) -> TrainResult:
    """Train a capture from posed photos.

    Every eighth photo is held out for evaluation. The training starts from the triangulated points, if there are any.
    Each photo has its own exposure and white balance. Photos that cannot be used, or that do not fit the others, are
    excluded and named in the result. Photos with alpha or masks (``read_photo``) are trained over a random colour in
    each step, so that no Gaussian can imitate the background.

    Args:
        posed: COLMAP model, ``transforms.json``, ``cameras.json``, or another file of ``read_posed_images``.
        iterations: Number of optimiser steps.
        max_gaussians: Maximum number of Gaussians; None allows as many as fit into half of the memory. Fewer are made
            if more would not improve the renders.
        sh_degree: SH degree of the capture, 0 to 3.
        background: Background colour, 0 to 1; None uses white for photos with alpha, otherwise the mean colour at the
            borders of the photos, so that no Gaussians are used for a plain background.
        max_side: Maximum length of the longer side of a photo, pixels; larger photos are downscaled. None keeps the
            size of the photos.
        inverted_masks: True if the object is black in the masks, False if it is white; None determines it from the
            masks, with False as the fallback.
        seed: Seed of the random numbers.
        device: Warp device; None uses the current one.
        threads: Number of threads; None uses the default.
        checkpoint: File (.npz) to which the state is written every half minute; it is not removed.
        resume: True to continue from ``checkpoint``; on a CPU, the result is bitwise equal to that of an uninterrupted
            run with equal arguments.
        progress: Called after each step with its number and loss.
        stage: Called with a description of each stage as it starts.

    Raises:
        UserError: No photo can be used, or an option is out of range.
    """
    if iterations < 1 or (max_gaussians is not None and max_gaussians < 100) or not 0 <= sh_degree <= 3:
        raise UserError(
            f"train: iterations={iterations}, max_gaussians={max_gaussians}, sh_degree={sh_degree};"
            " give at least 1 iteration, at least 100 Gaussians and a degree from 0 to 3"
        )
    if seed < 0:
        raise ArgumentError("seed", "give a whole number of at least 0", value=seed)
    say = stage or (lambda _text: None)
    say(f"reading {posed}")
    photos = read_views(posed, max_side=max_side, inverted_masks=inverted_masks)
    for note in photos.sources.notes:
        say(note)
    for one in photos.left_out:
        say(f"left out {one.name}: {one.reason}")
    background = background or backdrop_colour(photos.views)
    views = tuple(laid_over(view, background) for view in photos.views)
    held_out = [len(views) >= _HOLD_OUT_EVERY and number % _HOLD_OUT_EVERY == 0 for number in range(len(views))]
    cut_out = all(view.alpha is not None for view in photos.views)
    trained = [number for number, out in enumerate(held_out) if not out]
    chosen = [(photos.views if cut_out else views)[number] for number in trained]
    start = _start(posed, chosen, max_gaussians, sh_degree=sh_degree, seed=seed, device=device)
    options = FinetuneOptions(
        iterations=iterations,
        rates=LearningRates().times(min(max(1.0, (_FULL_STEPS / iterations) ** 0.5), _MAX_RATE_FACTOR)),
        background=None if cut_out else background,
        densification=Densification.RELOCATION,
        max_gaussians=max_gaussians,
        sh_steps=max(1, iterations // _SH_STAGES),
        fit_exposure=True,
        exclude_outliers=True,
        seed=seed,
        threads=threads,
    )
    say(f"training on {len(chosen)} photos (the first run compiles kernels: up to a minute)")
    result = finetune(start, chosen, options=options, checkpoint=checkpoint, resume=resume, progress=progress)
    say("scoring every photo")
    scores = [
        score_photo(result.cloud, view, background, held_out=out, threads=threads)
        for view, out in zip(views, held_out, strict=True)
    ]
    outliers = _held_out_outliers(scores) | {trained[number] for number in result.outliers}
    left_out = list(photos.left_out)
    for number in sorted(outliers):
        scores[number] = replace(scores[number], is_outlier=True)
        left_out.append(ExcludedPhoto(views[number].name, _outlier_reason(scores[number])))
        say(f"left out {left_out[-1].name}: {left_out[-1].reason}")
    return TrainResult(
        *(result.cloud, result.losses, views, photos.views, cut_out, tuple(scores), background, photos.sources),
        excluded=tuple(left_out),
    )


def _start(
    posed: Path | str,
    chosen: list[TrainingView],
    max_gaussians: int | None,
    *,
    sh_degree: int,
    seed: int,
    device: str | None,
) -> GaussianCloud:
    """Return the initial cloud: from the triangulated points if there are any, otherwise from points on which the
    photos agree."""
    points = read_points(posed)
    if points is not None and len(points.positions) >= MIN_POINTS:
        return cloud_from_points(points, count=max_gaussians, sh_degree=sh_degree, seed=seed, device=device)
    count = _FIRST_GAUSSIANS if max_gaussians is None else min(_FIRST_GAUSSIANS, max(100, max_gaussians // 3))
    return initial_cloud(chosen, count=count, sh_degree=sh_degree, seed=seed, device=device)


def score_photo(
    cloud: GaussianCloud,
    view: TrainingView,
    background: tuple[float, float, float],
    *,
    held_out: bool,
    threads: int | None = None,
) -> PhotoScore:
    """Compute the image quality of ``cloud`` in the view of a photo.

    Args:
        cloud: The capture.
        view: The photo.
        background: Background colour, 0 to 1.
        held_out: True if the photo was not used for training.
        threads: Number of threads; None uses the default.
    """
    picture = render_gaussians(cloud, view.camera, background=background, threads=threads).colour.numpy()
    known = None if view.weight is None else view.weight > 0
    plain, toned = np.clip(picture, 0, 1), np.clip(match_tone(view.image, picture, known), 0, 1)
    device = str(cloud.device)
    return PhotoScore(
        view.name,
        held_out,
        psnr=psnr(toned, view.image, known),
        ssim=ssim_of(toned, view.image, known, device=device),
        plain_psnr=psnr(plain, view.image, known),
        plain_ssim=ssim_of(plain, view.image, known, device=device),
    )


def _held_out_outliers(scores: list[PhotoScore]) -> set[int]:
    """Return the indices of the held-out photos whose errors are far above those of the others."""
    judged = [number for number, score in enumerate(scores) if score.held_out]
    errors = np.array([10.0 ** (-scores[number].psnr / 20.0) for number in judged])
    return {judged[i] for i in np.flatnonzero(is_outlier(errors))}


def _outlier_reason(score: PhotoScore) -> str:
    return f"it does not fit the other photos ({score.psnr:.1f} dB): its pose is wrong, or something has moved"
