"""``NAME.report.json`` of ``egs-warp train``: what was trained on, how well each photo is shown, and what it cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egs_warp.pipelines.report import versions, write_report

if TYPE_CHECKING:
    from egs_warp.pipelines.train_capture import MeanScore, PhotoScore, TrainResult
    from egs_warp.training.posed_photos import ExcludedPhoto

_LAST_STEPS = 100
"""Steps whose mean loss is the final one."""


@dataclass(frozen=True)
class TrainReport:
    """Everything that the report says."""

    photos: int
    """Used, those held out included."""
    left_out: tuple[ExcludedPhoto, ...]
    photo_size: tuple[int, int]
    """Width and height of the first, pixels."""
    gaussians: int
    iterations: int
    final_loss: float
    background: tuple[float, float, float]
    held_out: MeanScore | None
    """None where no photo was held out."""
    trained_on: MeanScore | None
    scores: tuple[PhotoScore, ...]
    """Of each photo."""
    seconds: float
    frames_per_second: float
    """Optimiser steps a second, the first apart."""
    device: str
    seed: int
    sh_degree: int
    versions: Mapping[str, str]

    @classmethod
    def of(
        cls, result: TrainResult, *, seconds: float, frames_per_second: float, device: str, seed: int, sh_degree: int
    ) -> TrainReport:
        """Of what training gave, and how it was asked."""
        photo = result.views[0].camera
        return cls(
            photos=len(result.views),
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
        """The whole report, ready for JSON; both means under ``mean``."""
        means = ("held_out", "trained_on")
        said: dict[str, Any] = {}
        for name, value in asdict(self).items():
            if name in means:
                said.setdefault("mean", {})[name] = value
            else:
                said[name] = list(value) if isinstance(value, tuple) else value
        return said

    def write(self, path: Path) -> None:
        """The report, whole or not at all."""
        write_report(path, self.to_json())

    def summary(self) -> list[str]:
        """For the terminal: a line for the photos held out, one for those trained on."""
        means = {"held out": self.held_out, "trained on": self.trained_on}
        return [
            f"{which}: {mean.psnr:.2f} dB, SSIM {mean.ssim:.3f} in each photo's exposure"
            for which, mean in means.items()
            if mean is not None
        ]
