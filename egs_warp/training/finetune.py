"""The training loop, which fits Gaussians to pictures (Kerbl et al. 2023; relocation after Kheradmand et al. 2024).

This module imports torch; import it only where a training runs.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.checked_calls import Count, Fraction, NonNegative, PositiveCount, Seed, checked_constructor
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.render import render_gaussians
from egs_warp.training.checkpoint import Checkpoint, State, digest_of
from egs_warp.training.exposure import ExposureModel
from egs_warp.training.fused_steps import MAX_GROUPS, FusedSteps, count_groups
from egs_warp.training.gaussian_tensors import cloud_of, tensors_of
from egs_warp.training.growth import Growth
from egs_warp.training.outlier_views import OutlierViews
from egs_warp.training.planned_step import AutogradSteps, ExtraLoss, PlannedStep
from egs_warp.training.relocation import Population
from egs_warp.training.resolution import ResolutionSchedule
from egs_warp.training.training_view import TrainingView

_BLACK = (0.0, 0.0, 0.0)
_FUSED_ON = ("cuda",)
"""Types of the devices on which steps without autograd are used. On a CPU, autograd is a small part of a step."""
_UNSEEN_STEPS = {"cpu": 1, "cuda": 20}
"""Number of steps after which the losses of these steps are downloaded together, by type of the device."""


class Densification(enum.Enum):
    """Way in which the number and the positions of Gaussians change."""

    NONE = "none"
    """The number and order of Gaussians do not change."""
    RELOCATION = "relocation"
    """Faint Gaussians move to opaque ones, the number grows to a cap, and means are perturbed by noise (MCMC)."""


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Learning rates of Adam by attribute. The learning rate of the means is multiplied by the scene's extent, and it
    decays to a hundredth."""

    means: NonNegative = 1.6e-4
    rotations: NonNegative = 1e-3
    log_scales: NonNegative = 5e-3
    opacity_logits: NonNegative = 5e-2
    sh_band_0: NonNegative = 2.5e-3
    sh_rest: NonNegative = 1.25e-4

    def times(self, factor: float) -> LearningRates:
        """Return all rates multiplied by ``factor``."""
        return LearningRates(**{name: factor * rate for name, rate in vars(self).items()})


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class FinetuneOptions:
    """Options of a training run."""

    iterations: PositiveCount = 1000
    rates: LearningRates = field(default_factory=LearningRates)
    ssim_weight: Fraction = 0.2
    """Weight w of SSIM in the loss (1 - w) L1 + w (1 - SSIM)."""
    background: tuple[Fraction, Fraction, Fraction] | None = (1.0, 1.0, 1.0)
    """Background colour. None draws a random one in each step, which requires views with alpha."""
    densification: Densification = Densification.NONE
    max_gaussians: PositiveCount | None = 100_000
    """Number of Gaussians to which relocation grows the cloud. With None, the cloud grows for as long as growth
    decreases the loss."""
    sh_steps: Count = 0
    """Number of steps after which the next SH band is added to the training; with 0, all bands are trained from the
    start."""
    fit_exposure: bool = False
    """True to optimise an exposure and a white balance for each view together with the cloud."""
    exclude_outliers: bool = False
    """True to exclude views that do not fit the others during the training."""
    antialiased: bool | None = None
    """True to render with antialiasing, and to mark the result as trained with it; None uses ``cloud.antialiased``."""
    seed: Seed = 0
    threads: PositiveCount | None = None


@dataclass(frozen=True)
class FinetuneResult:
    """Result of a training run."""

    cloud: GaussianCloud
    losses: np.ndarray
    """(iterations,) float64, loss of each step."""
    tones: np.ndarray | None = None
    """(views, 3, 4) float64 colour maps: the colours of each view are its map times (the cloud's colours, 1). None
    without ``fit_exposure``."""
    outliers: tuple[int, ...] = ()
    """Indices of the excluded views."""


def finetune(
    cloud: GaussianCloud,
    views: Sequence[TrainingView],
    *,
    options: FinetuneOptions | None = None,
    extra_loss: ExtraLoss | None = None,
    trainable: np.ndarray | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, float], None] | None = None,
) -> FinetuneResult:
    """Fit ``cloud`` to ``views`` with Adam, one view per step in shuffled rounds.

    Args:
        cloud: initial cloud, which is not modified.
        views: pictures with cameras.
        options: see ``FinetuneOptions``.
        extra_loss: function that computes an additional loss from the parameters, for example ``L_seg`` of Eq. (21).
        trainable: (n,) bool, Gaussians that may change; it cannot be combined with relocation.
        checkpoint: .npz file for the state, which is written about every half minute.
        resume: True to continue from ``checkpoint``; on a CPU, the result is bitwise equal to the result of an
            uninterrupted run.
        progress: called with the index and loss of each step.

    Returns:
        The new cloud, on the same device, and the losses.

    Raises:
        UserError: a view does not fit its camera, the loss is not finite, or the checkpoint belongs to another training
            run.
    """
    options = options or FinetuneOptions()
    antialiased = cloud.antialiased if options.antialiased is None else options.antialiased
    _check(cloud, views, options, trainable)
    device = wp.device_to_torch(cloud.device)
    generator = torch.Generator(device=device).manual_seed(options.seed)
    order = np.random.default_rng(options.seed)
    relocating = options.densification is Densification.RELOCATION
    cameras = [view.camera for view in views]
    extent = cameras_extent(cameras) if relocating else scene_extent(cameras, cloud)
    population = Population(
        *(tensors_of(cloud, device), vars(options.rates)), extent=extent, generator=generator, threads=options.threads
    )
    resolution = ResolutionSchedule(views, options.iterations if relocating else 0)
    tones = ExposureModel(len(views), options.iterations, device) if options.fit_exposure else None
    # Reading a loss requires synchronisation with the GPU, so the losses of many steps are downloaded at once.
    steps_per_download = _UNSEEN_STEPS[torch.device(device).type]
    shared: dict[str, Any] = {
        "ssim_weight": options.ssim_weight,
        "antialiased": antialiased,
        "relocating": relocating,
        "threads": options.threads,
    }
    steps: AutogradSteps | FusedSteps
    background = options.background or _BLACK
    if tones is not None and _can_fuse(views, options, device, trainable, extra_loss):
        steps = FusedSteps(
            *(views, resolution.factors, population, tones),
            background=background,
            max_steps=steps_per_download,
            seed=options.seed,
            **shared,
        )
    else:
        frozen = None if trainable is None else torch.as_tensor(~np.asarray(trainable, bool), device=device)
        steps = AutogradSteps(
            *(views, resolution.factors, population, tones), frozen=frozen, extra_loss=extra_loss, **shared
        )
    outlier_views = OutlierViews(len(views))
    growth = Growth(len(views), options.max_gaussians, device)
    losses = np.zeros(options.iterations)
    queue: list[int] = []
    stateful = {"population": population, "misfits": outlier_views, "growth": growth} | (
        {"tones": tones} if tones else {}
    )
    checkpoint_file = None if checkpoint is None else Checkpoint(Path(checkpoint), resume=resume)
    saved = None if checkpoint_file is None else checkpoint_file.begin(_digest(cloud, views, options))
    if saved is not None:
        order.bit_generator.state, queue = saved["order"], list(saved["queue"])
        losses[: saved["step"]] = saved["losses"]
        for name, part in stateful.items():
            part.restore(_part_of(saved, name))
    all_coefficients = cloud.sh.shape[1]

    def plan(step: int) -> PlannedStep:
        nonlocal queue
        if not queue:
            fitting = [number for number in range(len(views)) if number not in outlier_views.indices]
            queue = [fitting[i] for i in order.permutation(len(fitting))]
        number = queue.pop()
        drawn = background
        if options.background is None:
            red, green, blue = order.random(3).tolist()
            drawn = (red, green, blue)
        bands = step // options.sh_steps + 1 if options.sh_steps > 0 else all_coefficients
        return PlannedStep(
            *(step, number, resolution.factor(step), drawn, min(bands**2, all_coefficients)),
            population.rates(done=step / max(options.iterations, 1), settling=relocating),
            *((0.0, 1.0) if tones is None else tones.visit(number, step)),
        )

    step = 0 if saved is None else int(saved["step"])
    while step < options.iterations:
        end = min((step // steps_per_download + 1) * steps_per_download, options.iterations)
        plans = [plan(number) for number in range(step, end)]
        count = len(population.tensors["means"])
        for planned, value in zip(plans, steps.run(plans), strict=True):
            at = planned.step
            losses[at] = value
            if not np.isfinite(value):
                raise UserError(f"finetune: the loss is not finite at step {at}; lower the rates or check the views")
            outlier_views.update(planned.view, value)
            if resolution.factor(at) != resolution.factor(max(at - 1, 0)):
                growth.restart()
            growth.see(value, count)
            if progress is not None:
                progress(at, value)
        if options.exclude_outliers:
            outlier_views.find((end - 1) / options.iterations)
        step = end
        if relocating and population.is_relocation_due(step - 1, options.iterations):
            steps.store()
            population.relocate(step - 1, options.iterations, growth)
        if checkpoint_file is not None and checkpoint_file.due():
            steps.store()
            state = {"step": step, "losses": losses[:step], "order": order.bit_generator.state, "queue": queue}
            for name, part in stateful.items():
                state |= {f"{name}/{key}": value for key, value in part.state().items()}
            checkpoint_file.write(state)
    steps.store()
    return FinetuneResult(
        replace(cloud_of(population.tensors), antialiased=antialiased),
        losses,
        None if tones is None else tones.matrices(),
        tuple(outlier_views.indices),
    )


def _can_fuse(
    views: Sequence[TrainingView],
    options: FinetuneOptions,
    device: str,
    trainable: np.ndarray | None,
    extra_loss: ExtraLoss | None,
) -> bool:
    """Return True if ``FusedSteps`` can take the steps of this training run."""
    has_background = options.background is not None or all(view.alpha is not None for view in views)
    is_plain = trainable is None and extra_loss is None and has_background
    return torch.device(device).type in _FUSED_ON and is_plain and count_groups(views) <= MAX_GROUPS


def _digest(cloud: GaussianCloud, views: Sequence[TrainingView], options: FinetuneOptions) -> str:
    """Return a digest that identifies this training run by its input."""
    first = [getattr(cloud, name).numpy() for name in ARRAYS]
    pictures = [array for view in views for array in (view.image, view.alpha, view.weight)]
    return digest_of([*first, *pictures], [view.camera for view in views], options)


def _part_of(state: State, name: str) -> State:
    """Return the entries that belong to the part ``name`` from the whole ``state``."""
    return {key.removeprefix(f"{name}/"): value for key, value in state.items() if key.startswith(f"{name}/")}


def render_views(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    antialiased: bool | None = None,
) -> list[TrainingView]:
    """Render ``cloud`` through ``cameras`` as training views, which can be used instead of photos."""
    return [
        TrainingView(
            camera,
            np.clip(
                render_gaussians(cloud, camera, background=background, antialiased=antialiased).colour.numpy(), 0, 1
            ),
        )
        for camera in cameras
    ]


def cameras_extent(cameras: Sequence[Camera]) -> float:
    """Return 1.1 times the radius that contains nine tenths of the cameras, so that a few wrong, distant poses do not
    enlarge it."""
    centres = np.array([camera.centre for camera in cameras])
    radius = float(np.quantile(np.linalg.norm(centres - np.median(centres, axis=0), axis=1), 0.9))
    return 1.1 * radius if radius > 0 else 1.0


def scene_extent(cameras: Sequence[Camera], cloud: GaussianCloud) -> float:
    """Return the length by which the learning rate of the means is multiplied. It is the smaller of two lengths: 1.1
    times the largest distance of a camera from the cameras' mean position, and twice the mean distance of the Gaussians
    from their median position."""
    centres = np.array([camera.centre for camera in cameras])
    of_cameras = 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    means = cloud.means.numpy()
    of_cloud = 2.0 * float(np.linalg.norm(means - np.median(means, axis=0), axis=1).mean())
    candidates = [value for value in (of_cameras, of_cloud) if value > 0]
    return min(candidates) if candidates else 1.0


def _check(
    cloud: GaussianCloud, views: Sequence[TrainingView], options: FinetuneOptions, trainable: np.ndarray | None
) -> None:
    if not views:
        raise UserError("finetune: there are no views; give at least one picture with its camera")
    for number, view in enumerate(views):
        shape = (view.camera.height, view.camera.width)
        for name, values, expected in (
            ("image", view.image, (*shape, 3)),
            ("alpha", view.alpha, shape),
            ("weight", view.weight, shape),
        ):
            if values is None:
                continue
            if values.shape != expected:
                raise UserError(
                    f"finetune: {name} of view {number} has shape {values.shape}, expected {expected}; resize it"
                )
            if wrong := int(np.count_nonzero(~np.isfinite(values))):
                raise UserError(f"finetune: {name} of view {number} has {wrong} values that are not finite; correct it")
    if trainable is not None and np.shape(trainable) != (cloud.count,):
        raise UserError(f"finetune: trainable has shape {np.shape(trainable)}, expected ({cloud.count},)")
    if trainable is not None and options.densification is not Densification.NONE:
        raise UserError("finetune: relocation moves every Gaussian; give either trainable or a densification")
