"""Preview training on a CPU by this version and by an older checkout, each in its own process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from harness import Row

OLD, NEW = "older version", "this version"
_WORKER = "from train_versions import train_preview; train_preview()"
_WARM_UP = 20
"""Number of training steps before the timed training, to compile the kernels."""


def compare_previews(case: str, folder: Path, *, old: Path, seeds: Sequence[int]) -> list[Row]:
    """Train the preview with both versions, with one thread and the default settings of each.

    Args:
        case: name of the scene in the rows.
        folder: its posed photos.
        old: checkout of the older version, whose ``train`` must have the same arguments.
        seeds: seeds of the trainings.

    Returns:
        The rows of the older and of this version, alternately.
    """
    checkouts = {OLD: old, NEW: Path(__file__).resolve().parents[1]}
    return [
        {"case": case, "method": name, "seed": seed, **_run(checkout, folder, seed)}
        for seed in seeds
        for name, checkout in checkouts.items()
    ]


def is_third_of_time(rows: Sequence[Row]) -> bool:
    """Return True if, in each case, the mean PSNR of this version is at least that of the older version, and its time
    is at most a third."""

    def mean(case: str, method: str, name: str) -> float:
        return float(np.mean([row[name] for row in rows if row["case"] == case and row["method"] == method]))

    return all(
        mean(case, NEW, "held_out_psnr") >= mean(case, OLD, "held_out_psnr")
        and mean(case, NEW, "seconds") <= mean(case, OLD, "seconds") / 3
        for case in {row["case"] for row in rows}
    )


def _run(checkout: Path, folder: Path, seed: int) -> Row:
    path = os.pathsep.join([str(checkout), str(Path(__file__).resolve().parent)])
    environment = {**os.environ, "PYTHONPATH": path, "EGS_WARP_THREADS": "1", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, "-c", _WORKER, str(folder), str(seed)],
        cwd=checkout,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    # Lines that Warp prints to the same stream are skipped.
    return json.loads(next(line for line in result.stdout.splitlines() if line.startswith("{")))


def train_preview() -> None:
    """Train the preview of the folder and with the seed that the arguments of the process give, and print its row."""
    from egs_warp.commands.train import _DEFAULTS
    from egs_warp.pipelines.train_capture import train

    folder, seed = sys.argv[1], int(sys.argv[2])
    iterations, gaussians, side = _DEFAULTS["cpu"]
    train(folder, iterations=_WARM_UP, max_gaussians=1000, max_side=120, device="cpu", threads=1)
    stages: list[tuple[str, float]] = []

    def stage(text: str) -> None:
        stages.append((text, time.process_time()))

    started = time.process_time()
    result = train(
        folder,
        iterations=iterations,
        max_gaussians=gaussians,
        max_side=side,
        seed=seed,
        device="cpu",
        threads=1,
        stage=stage,
    )
    whole = time.process_time() - started
    begun = next(number for number, (text, _) in enumerate(stages) if text.startswith("training"))
    scores = [score for score in result.scores if score.held_out]
    row: Row = {
        "gaussians": result.cloud.count,
        "seconds": stages[begun + 1][1] - stages[begun][1],
        "whole_seconds": whole,
        **{f"held_out_{name}": float(np.mean([getattr(score, name) for score in scores])) for name in ("psnr", "ssim")},
    }
    print(json.dumps(row), flush=True)
