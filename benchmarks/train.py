"""Captures trained from real photos, ours and gsplat's MCMC strategy side by side: held-out PSNR and SSIM, and time.

Both get the same photos (straightened, every eighth held out), the same iterations and the same cap on Gaussians, and
are judged by the same renderer: once as they are, once after one affine map of colours was fitted to each whole
held-out photo, the usual way to remove exposure. The means count every held-out photo, a wrongly posed one, too.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.train_peers import has_gsplat, train_with_gsplat
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.cameras import read_points
from egs_warp.io.video import contact_sheet, write_png
from egs_warp.pipelines.train_capture import TrainResult, score_photo, train
from egs_warp.render import render

OURS, GSPLAT = "egs_warp", "gsplat MCMC"
CASES = ("bonsai", "mouse", "plush_dog", "lego")
_WARM_UP = 20
"""Steps of both before the first timed case, so that kernels are compiled."""


def data_folder() -> Path:
    """Of the posed photos."""
    return Path(os.environ.get("EGS_WARP_DATA", Path(__file__).parents[2] / "shared" / "data")) / "posed"


def row_of(case: str, method: str, cloud: GaussianCloud, seconds: float, result: TrainResult) -> dict[str, Any]:
    """Scores of one cloud on the photos of ``result``."""
    scores = [
        score_photo(cloud, view, result.background, held_out=score.held_out)
        for view, score in zip(result.views, result.scores, strict=True)
    ]
    row: dict[str, Any] = {"case": case, "method": method, "gaussians": cloud.count, "seconds": seconds}
    for which, out in (("held_out", True), ("trained_on", False)):
        chosen = [score for score in scores if score.held_out is out]
        for name in ("psnr", "ssim", "plain_psnr", "plain_ssim"):
            row[f"{which}_{name}"] = float(np.mean([getattr(score, name) for score in chosen]))
    row["held_out_photos"] = {score.name: [score.psnr, score.plain_psnr] for score in scores if score.held_out}
    return row


def run_case(case: str, options: argparse.Namespace) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Rows of both methods, and a strip of photo and renders."""
    folder = data_folder() / case
    marks: dict[str, float] = {}
    has_peer = options.device.startswith("cuda") and has_gsplat()

    def stage(text: str) -> None:
        marks[text.split()[0]] = time.perf_counter()

    result = train(
        folder,
        iterations=options.iterations,
        max_gaussians=options.gaussians,
        max_side=options.max_side,
        seed=options.seed,
        device=options.device,
        stage=stage,
    )
    clouds = {OURS: result.cloud}
    rows = [row_of(case, OURS, result.cloud, marks["judging"] - marks["training"], result)]
    rows[0]["left_out"] = [one.name for one in result.left_out]
    if has_peer:
        trained = [
            view
            for view, score in zip(result.photos if result.cut_out else result.views, result.scores, strict=True)
            if not score.held_out
        ]
        peer = train_with_gsplat(
            trained,
            read_points(folder),
            iterations=options.iterations,
            max_gaussians=options.gaussians,
            seed=options.seed,
            device=options.device,
        )
        clouds[GSPLAT] = peer.cloud
        rows.append(row_of(case, GSPLAT, peer.cloud, peer.seconds, result))
    for row in rows:
        print(
            f"{row['case']:10} {row['method']:12} {row['gaussians']:8d} {row['seconds']:7.1f} s"
            f"  held out {row['held_out_psnr']:.2f} dB / {row['held_out_ssim']:.3f}"
            f"  as it is {row['held_out_plain_psnr']:.2f} / {row['held_out_plain_ssim']:.3f}"
            f"  trained on {row['trained_on_psnr']:.2f} / {row['trained_on_ssim']:.3f}",
            flush=True,
        )
    shown = next(number for number, score in enumerate(result.scores) if score.held_out)
    view = result.views[shown]
    frames = [np.rint(view.image * 255).astype(np.uint8)]
    frames += [render(cloud, view.camera, background=result.background).colour_srgb8() for cloud in clouds.values()]
    return rows, contact_sheet(frames, len(frames), [f"{case}: photo", *clouds])


def warm_up(options: argparse.Namespace) -> None:
    """Compile every kernel outside of the timed runs."""
    folder = data_folder() / options.cases[0]
    result = train(folder, iterations=_WARM_UP, max_gaussians=1000, max_side=120, device=options.device)
    if options.device.startswith("cuda") and has_gsplat():
        train_with_gsplat(
            result.views,
            read_points(folder),
            iterations=_WARM_UP,
            max_gaussians=options.gaussians,
            device=options.device,
        )


def judge(rows: list[dict[str, Any]]) -> tuple[dict[str, bool | None], dict[str, str]]:
    """The aims, from the rows."""
    aims: dict[str, bool | None] = {"psnr_vs_gsplat": None, "not_slower": None}
    cases = {row["case"] for row in rows if row["method"] == GSPLAT}
    if not cases:
        return aims, dict.fromkeys(aims, "gsplat needs a GPU and is not installed here")
    pairs = [
        [next(row for row in rows if row["case"] == case and row["method"] == method) for method in (OURS, GSPLAT)]
        for case in sorted(cases)
    ]
    aims["psnr_vs_gsplat"] = all(a["held_out_psnr"] >= b["held_out_psnr"] for a, b in pairs)
    aims["not_slower"] = all(a["seconds"] <= b["seconds"] for a, b in pairs)
    return aims, {}


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    wp.init()
    parser.add_argument("--quick", action="store_true", help="300 iterations, 3,000 Gaussians, 120 pixels")
    parser.add_argument("--device", default="cuda:0" if wp.is_cuda_available() else "cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--iterations", type=int, help="7000")
    parser.add_argument("--gaussians", type=int, help="cap for both (200000)")
    parser.add_argument("--max-side", type=int, help="photos are reduced to this many pixels (as they are)")
    options = parser.parse_args()
    options.iterations = options.iterations or (300 if options.quick else 7000)
    options.gaussians = options.gaussians or (3000 if options.quick else 200_000)
    options.max_side = options.max_side or (120 if options.quick else None)
    rows: list[dict[str, Any]] = []
    strips = []
    missing = [case for case in options.cases if not (data_folder() / case).is_dir()]
    options.cases = [case for case in options.cases if case not in missing]
    if options.cases:
        warm_up(options)
    for case in options.cases:
        if case not in missing:
            part, strip = run_case(case, options)
            rows += part
            strips.append(strip)
    aims, why_null = judge(rows)
    if missing:
        print(f"not on this machine: {', '.join(missing)}")
    print(json.dumps({"aims": aims, "why_null": why_null}, indent=1))
    result = {
        "rows": rows,
        "environment": {
            "device": str(wp.get_device(options.device)),
            "name": wp.get_device(options.device).name,
            "python": platform.python_version(),
            "warp": wp.config.version,
            "torch": torch.__version__,
            "threads": os.cpu_count(),
            "seed": options.seed,
            "iterations": options.iterations,
            "gaussians": options.gaussians,
            "max_side": options.max_side,
            "missing": missing,
        },
        "aims": aims,
        "why_null": why_null,
    }
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    if options.plot:
        write_png(options.plot, contact_sheet(strips, 1, [""] * len(strips)))


if __name__ == "__main__":
    main()
