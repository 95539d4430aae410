"""Captures trained from real photos by our trainer and by gsplat's MCMC strategy: held-out PSNR and SSIM, and time.

Both get the same photos (undistorted, every eighth held out), the same number of iterations and the same cap on
Gaussians. Both are evaluated with the same renderer, without and with an affine colour correction fitted to each whole
held-out photo, the usual way to remove differences in exposure. The means include every held-out photo, even photos
with a wrong pose.

With ``--old``, the benchmark compares the preview on a CPU with that of an older checkout instead.

Aims, in every scene: ``train_third_of_gsplat`` (at least gsplat's held-out PSNR in a third of its time, with 7,000
iterations), ``train_full_quarter`` (the same in a quarter of its time, with 30,000 iterations), ``preview_third`` (the
held-out PSNR of commit f1c9b54 in a third of its processor time).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.cameras import read_points
from egs_warp.io.video import contact_sheet
from egs_warp.pipelines.train_capture import PhotoScore, score_photo, train
from egs_warp.render import render_gaussians
from harness import Row, Table, data_folder, flags, report
from train_peers import has_gsplat, train_with_gsplat
from train_versions import compare_previews, is_third_of_time

OURS, GSPLAT = "egs_warp", "gsplat MCMC"
CASES = ("bonsai", "mouse", "plush_dog", "lego")
_SHOWN = (
    *("case", "method", "gaussians", "seconds", "held_out_psnr", "held_out_ssim"),
    *("held_out_plain_psnr", "held_out_plain_ssim", "trained_on_psnr", "trained_on_ssim"),
)
"""Columns of the table, as keys of the rows."""
AIMS = {"train_third_of_gsplat": (7000, 1 / 3), "train_full_quarter": (30_000, 1 / 4)}
"""For each aim of the comparison with gsplat: the number of iterations and the maximum ratio of times."""
_WARM_UP = 20
"""Number of training steps of both trainers before the first timed case, to compile the kernels."""
_PREVIEW_SEEDS = 3
"""Number of trainings of a preview whose PSNR is averaged, because it varies with the seed."""


def row_of(case: str, method: str, cloud: GaussianCloud, seconds: float, scores: Sequence[PhotoScore]) -> Row:
    """Return the table row of one cloud, with the means of its ``scores`` over the photos."""
    row: Row = {"case": case, "method": method, "gaussians": cloud.count, "seconds": seconds}
    for which, out in (("held_out", True), ("trained_on", False)):
        chosen = [score for score in scores if score.held_out is out]
        for name in ("psnr", "ssim", "plain_psnr", "plain_ssim"):
            row[f"{which}_{name}"] = float(np.mean([getattr(score, name) for score in chosen]))
    row["held_out_photos"] = {score.name: [score.psnr, score.plain_psnr] for score in scores if score.held_out}
    return row


def run_case(case: str, options: argparse.Namespace, table: Table) -> tuple[list[Row], np.ndarray]:
    """Return the rows of both methods, and a strip that shows a photo and its renders."""
    folder = data_folder() / "posed" / case
    stages: list[tuple[str, float]] = []
    has_peer = options.device.startswith("cuda") and has_gsplat()

    def stage(text: str) -> None:
        stages.append((text, time.perf_counter()))

    result = train(
        folder,
        iterations=options.iterations,
        max_gaussians=options.gaussians,
        max_side=options.max_side,
        seed=options.seed,
        device=options.device,
        stage=stage,
    )
    begun = next(number for number, (text, _) in enumerate(stages) if text.startswith("training"))
    seconds = stages[begun + 1][1] - stages[begun][1]
    clouds = {OURS: (result.cloud, result.background)}
    rows = [row_of(case, OURS, result.cloud, seconds, result.scores)]
    rows[0]["left_out"] = [one.name for one in result.excluded]
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
        # Each capture is rendered on its training background. On another one, the background that shows through would
        # be an error.
        behind = result.background if result.cut_out else (0.0, 0.0, 0.0)
        scores = [
            score_photo(peer.cloud, view, behind, held_out=score.held_out)
            for view, score in zip(result.views, result.scores, strict=True)
        ]
        clouds[GSPLAT] = (peer.cloud, behind)
        rows.append(row_of(case, GSPLAT, peer.cloud, peer.seconds, scores))
    for row in rows:
        table.row(*(row[name] for name in _SHOWN))
    shown = next(number for number, score in enumerate(result.scores) if score.held_out)
    view = result.views[shown]
    frames = [np.rint(view.image * 255).astype(np.uint8)]
    frames += [
        render_gaussians(cloud, view.camera, background=behind).colour_srgb8() for cloud, behind in clouds.values()
    ]
    return rows, contact_sheet(frames, len(frames), [f"{case}: photo", *clouds])


def warm_up(options: argparse.Namespace) -> None:
    """Every kernel is compiled before the timed runs."""
    folder = data_folder() / "posed" / options.cases[0]
    result = train(folder, iterations=_WARM_UP, max_gaussians=1000, max_side=120, device=options.device)
    if options.device.startswith("cuda") and has_gsplat():
        train_with_gsplat(
            result.views,
            read_points(folder),
            iterations=_WARM_UP,
            max_gaussians=options.gaussians,
            device=options.device,
        )


def judge(rows: list[Row], iterations: int) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aims from the rows of a run with ``iterations`` training steps."""
    aims: dict[str, bool | None] = dict.fromkeys((*AIMS, "preview_third"))
    why = {"preview_third": "measured with --old"}
    cases = {row["case"] for row in rows if row["method"] == GSPLAT}
    pairs = [
        [next(row for row in rows if row["case"] == case and row["method"] == method) for method in (OURS, GSPLAT)]
        for case in sorted(cases)
    ]
    for name, (number, ratio) in AIMS.items():
        if not pairs:
            why[name] = "gsplat needs a GPU and is not installed"
        elif iterations != number:
            why[name] = f"measured with --iterations {number}"
        else:
            aims[name] = all(
                ours["held_out_psnr"] >= peer["held_out_psnr"] and ours["seconds"] <= ratio * peer["seconds"]
                for ours, peer in pairs
            )
    return aims, why


def report_previews(options: argparse.Namespace) -> None:
    """Compare the previews of this version and of the checkout ``options.old``."""
    seeds = range(options.seed, options.seed + (1 if options.quick else _PREVIEW_SEEDS))
    table = Table(case="<10", version="<13", seed="5d", seconds="8.1f", whole="8.1f", held_out="9.2f", SSIM="6.3f")
    rows: list[Row] = []
    for case in options.cases:
        rows += compare_previews(case, data_folder() / "posed" / case, old=options.old.resolve(), seeds=seeds)
        for row in rows[-2 * len(seeds) :]:
            names = ("case", "method", "seed", "seconds", "whole_seconds", "held_out_psnr", "held_out_ssim")
            table.row(*(row[name] for name in names))
    aims: dict[str, bool | None] = dict.fromkeys(AIMS)
    why = dict.fromkeys(aims, "measured without --old")
    aims["preview_third"] = is_third_of_time(rows) if rows else None
    report(
        options,
        rows,
        aims=aims,
        why_null=why if rows else why | {"preview_third": "no photos"},
        packages=("torch",),
        conditions={"seeds": list(seeds)},
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(
        __doc__,
        quick="300 iterations, 3,000 Gaussians, 120 pixels; with --old, one seed",
        plot="file for an image of photos and renders",
    )
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--iterations", type=int, help="training steps (default 7000)")
    parser.add_argument("--gaussians", type=int, help="maximum number of Gaussians of both trainers (default 200000)")
    parser.add_argument(
        "--max-side", type=int, help="reduce the longer side of photos to this many pixels (default full size)"
    )
    parser.add_argument(
        "--old", type=Path, help="checkout of commit f1c9b54, to compare the previews on a CPU with, and nothing else"
    )
    options = parser.parse_args(arguments)
    options.iterations = options.iterations or (300 if options.quick else 7000)
    options.gaussians = options.gaussians or (3000 if options.quick else 200_000)
    options.max_side = options.max_side or (120 if options.quick else None)
    missing = [case for case in options.cases if not (data_folder() / "posed" / case).is_dir()]
    if missing:
        print(f"not on this machine: {', '.join(missing)}")
    options.cases = [case for case in options.cases if case not in missing]
    if options.old:
        report_previews(options)
        return
    rows: list[Row] = []
    strips = []
    if options.cases:
        warm_up(options)
    formats = ("<10", "<12", "9d", "8.1f", "8.2f", "6.3f", "8.2f", "6.3f", "8.2f", "6.3f")
    heads = ("case", "method", "Gaussians", "seconds", "held_out", "SSIM", "as_it_is", "SSIM_", "trained_on", "SSIM__")
    table = Table(**dict(zip(heads, formats, strict=True)))
    for case in options.cases:
        part, strip = run_case(case, options, table)
        rows += part
        strips.append(strip)
    aims, why_null = judge(rows, options.iterations)
    report(
        options,
        rows,
        picture=contact_sheet(strips, 1, [""] * len(strips)) if strips else None,
        aims=aims,
        why_null=why_null,
        packages=("torch", "gsplat") if has_gsplat() else ("torch",),
        conditions={
            "iterations": options.iterations,
            "gaussians": options.gaussians,
            "max_side": options.max_side,
            "missing": missing,
        },
    )


if __name__ == "__main__":
    main()
