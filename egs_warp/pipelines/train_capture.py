"""A capture from posed photos: what ``egs-warp train`` calls.

Imports torch, so import it only where something is trained.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.cameras import read_points
from egs_warp.render import render_gaussians
from egs_warp.training.finetune import Densification, FinetuneOptions, TrainingView, finetune
from egs_warp.training.initial_cloud import LEAST_POINTS, cloud_from_points, initial_cloud
from egs_warp.training.metrics import match_tone, psnr, ssim_of
from egs_warp.training.outlier_views import is_outlier
from egs_warp.training.posed_photos import ExcludedPhoto, backdrop_colour, laid_over, read_views

_HOLD_OUT_EVERY = 8
"""As published methods do: every eighth photo is judged on and not trained on."""
_SH_TURNS = 10
"""Parts of the steps; each of the first begins one more degree of SH."""
_FIRST_GAUSSIANS = 30_000
"""Where neither points nor a cap say how many to begin with."""


@dataclass(frozen=True)
class PhotoScore:
    """How well the capture shows one photo."""

    name: str
    held_out: bool
    psnr: float
    """dB, of the render in the photo's exposure and white balance (one affine map of colours, fitted to the photo)."""
    ssim: float
    """Mean structural similarity of the same, 11 x 11 Gaussian window."""
    plain_psnr: float
    """dB, of the render as it is."""
    plain_ssim: float
    is_outlier: bool = False
    """It fits the other photos badly: its pose is wrong, or something moved. It is not counted in the means."""


@dataclass(frozen=True)
class MeanScore:
    """How well the capture shows several photos, each in its own exposure."""

    psnr: float
    """dB."""
    ssim: float


@dataclass(frozen=True)
class TrainResult:
    """What training from photos gave."""

    cloud: GaussianCloud
    losses: np.ndarray
    """(iterations,) float64."""
    views: tuple[TrainingView, ...]
    """Every photo as it is judged on: straightened, reduced and laid over the background."""
    photos: tuple[TrainingView, ...]
    """The same with their alpha, where they have it."""
    cut_out: bool
    """All photos have alpha: they were trained before random colours."""
    scores: tuple[PhotoScore, ...]
    """One for each of ``views``."""
    background: tuple[float, float, float]
    """The colour behind the capture."""
    excluded: tuple[ExcludedPhoto, ...] = ()
    """Photos that are not used, or no longer, and why."""

    def mean_score(self, *, held_out: bool) -> MeanScore | None:
        """Of photos held out, or of those trained on, misfits apart; None where there are none."""
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
    seed: int = 0,
    device: str | None = None,
    threads: int | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, float], None] | None = None,
    stage: Callable[[str], None] | None = None,
) -> TrainResult:
    """Make a capture from the photos that ``posed`` (COLMAP, ``transforms.json`` or ``cameras.json``) points to.

    Photos larger than ``max_side`` pixels are reduced. Every eighth photo is held out and judged on. It begins with the
    points triangulated from the photos where there are any, and ends with at most ``max_gaussians``; None takes as many
    as the photos gain by. Each photo has an exposure and white balance of its own. Photos that cannot be used, or that
    never fit the others, are left out and named.

    Photos with alpha or masks (``read_photo``) are trained before a random colour each step, so that nothing can pass
    for the backdrop. They are judged before ``background``; without one, it is white for those and the mean colour
    along the photos' borders for others, so that no Gaussians are spent on a plain backdrop. ``checkpoint`` names a
    file (.npz) that is written every half a minute and stays; with ``resume`` the training goes on from
    it, with the same arguments on a CPU to the same bits. ``progress`` is called with each step's number and loss,
    ``stage`` with what begins. Raises ``UserError`` where no photo can be used and for impossible options.
    """
    if iterations < 1 or (max_gaussians is not None and max_gaussians < 100) or not 0 <= sh_degree <= 3:
        raise UserError(
            f"train: {iterations} iterations, {max_gaussians} Gaussians and SH degree {sh_degree};"
            " give at least 1, at least 100, and 0 to 3"
        )
    if seed < 0:
        raise ArgumentError("seed", "give a whole number of at least 0", value=seed)
    say = stage or (lambda _text: None)
    say(f"reading {posed}")
    photos = read_views(posed, max_side=max_side)
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
        background=None if cut_out else background,
        densification=Densification.RELOCATION,
        max_gaussians=max_gaussians,
        sh_steps=max(1, iterations // _SH_TURNS),
        fit_exposure=True,
        exclude_outliers=True,
        seed=seed,
        threads=threads,
    )
    say(f"training on {len(chosen)} photos (the first run compiles kernels: up to a minute)")
    result = finetune(start, chosen, options=options, checkpoint=checkpoint, resume=resume, progress=progress)
    say("judging every photo")
    scores = [
        score_photo(result.cloud, view, background, held_out=out, threads=threads)
        for view, out in zip(views, held_out, strict=True)
    ]
    unfit = _unfit(scores) | {trained[number] for number in result.misfits}
    left_out = list(photos.left_out)
    for number in sorted(unfit):
        scores[number] = replace(scores[number], is_outlier=True)
        left_out.append(ExcludedPhoto(views[number].name, _misfit(scores[number])))
        say(f"left out {left_out[-1].name}: {left_out[-1].reason}")
    return TrainResult(
        *(result.cloud, result.losses, views, photos.views, cut_out, tuple(scores), background, tuple(left_out))
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
    """The triangulated points, or Gaussians where the photos agree."""
    points = read_points(posed)
    if points is not None and len(points.positions) >= LEAST_POINTS:
        return cloud_from_points(points, count=max_gaussians, sh_degree=sh_degree, seed=seed, device=device)
    count = max(100, max_gaussians // 3) if max_gaussians is not None else _FIRST_GAUSSIANS
    return initial_cloud(chosen, count=count, sh_degree=sh_degree, seed=seed, device=device)


def score_photo(
    cloud: GaussianCloud,
    view: TrainingView,
    background: tuple[float, float, float],
    *,
    held_out: bool,
    threads: int | None = None,
) -> PhotoScore:
    """How well ``cloud`` shows the photo of ``view``, before and after its exposure and white balance are removed."""
    picture = render_gaussians(cloud, view.camera, background=background, threads=threads).colour.numpy()
    known = None if view.weight is None else view.weight > 0
    plain, toned = np.clip(picture, 0, 1), np.clip(match_tone(view.image, picture, known), 0, 1)
    return PhotoScore(
        view.name,
        held_out,
        psnr=psnr(toned, view.image, known),
        ssim=ssim_of(toned, view.image, known),
        plain_psnr=psnr(plain, view.image, known),
        plain_ssim=ssim_of(plain, view.image, known),
    )


def _unfit(scores: list[PhotoScore]) -> set[int]:
    """Numbers of the held-out photos that no capture would show: their errors lie far above those of the others."""
    judged = [number for number, score in enumerate(scores) if score.held_out]
    errors = np.array([10.0 ** (-scores[number].psnr / 20.0) for number in judged])
    return {judged[i] for i in np.flatnonzero(is_outlier(errors))}


def _misfit(score: PhotoScore) -> str:
    return f"it does not fit the other photos ({score.psnr:.1f} dB): its pose is wrong, or something has moved"
