"""``NAME.report.json`` of ``egs-warp train``: photos, their scores, options and timing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egs_warp.pipelines.report import versions, write_report

if TYPE_CHECKING:
    from egs_warp.io.posed_images import ExcludedPhoto
    from egs_warp.pipelines.train_capture import MeanScore, PhotoScore, TrainResult
    from egs_warp.training.posed_photos import PhotoSources

_LAST_STEPS = 100
"""Number of steps at the end of a training run over which the final loss is averaged."""


@dataclass(frozen=True)
class TrainReport:
    """Contents of the report."""

    photos: int
    """Number of photos used, including those held out."""
    sources: PhotoSources
    left_out: tuple[ExcludedPhoto, ...]
    photo_size: tuple[int, int]
    """Width and height of the first photo, pixels."""
    gaussians: int
    iterations: int
    final_loss: float
    background: tuple[float, float, float]
    held_out: MeanScore | None
    """Mean score of the held-out photos; None if there are none."""
    trained_on: MeanScore | None
    scores: tuple[PhotoScore, ...]
    """Score of each photo."""
    seconds: float
    frames_per_second: float
    """Optimiser steps per second, excluding the first step."""
    device: str
    seed: int
    sh_degree: int
    versions: Mapping[str, str]

    @classmethod
    def of(
        cls, result: TrainResult, *, seconds: float, frames_per_second: float, device: str, seed: int, sh_degree: int
    ) -> TrainReport:
        """Create the report from the result and the options of a training run."""
        photo = result.views[0].camera
        return cls(
            photos=len(result.views),
            sources=result.sources,
            left_out=result.excluded,
            photo_size=(photo.width, photo.height),
            gaussians=result.cloud.count,
            iterations=len(result.losses),
            final_loss=float(np.mean(result.losses[-_LAST_STEPS:])),
            background=result.background,
            held_out=result.mean_score(held_out=True),
            trained_on=result.mean_score(held_out=False),
            scores=result.scores,
            seconds=seconds,
            frames_per_second=frames_per_second,
            device=device,
            seed=seed,
            sh_degree=sh_degree,
            versions=versions(("warp-lang", "numpy", "torch")),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the whole report, ready for JSON, with both means under ``mean``."""
        means = ("held_out", "trained_on")
        # ``misfit`` is the key of ``is_outlier`` in the report's schema.
        scores = [{"misfit" if k == "is_outlier" else k: v for k, v in asdict(score).items()} for score in self.scores]
        values: dict[str, Any] = {}
        for name, value in asdict(self).items():
            if name in means:
                values.setdefault("mean", {})[name] = value
            else:
                values[name] = list(value) if isinstance(value, tuple) else value
        return {**values, "scores": scores}

    def write(self, path: Path) -> None:
        """Write the report atomically."""
        write_report(path, self.to_json())

    def summary(self) -> list[str]:
        """Return lines for the terminal: the number of photos, and the means of held-out and of training photos."""
        means = {"held out": self.held_out, "trained on": self.trained_on}
        return [self.sources.summary()] + [
            f"{which}: {mean.psnr:.2f} dB, SSIM {mean.ssim:.3f} in each photo's exposure"
            for which, mean in means.items()
            if mean is not None
        ]
