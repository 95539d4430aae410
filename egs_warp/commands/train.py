"""``egs-warp train``: train a capture on photos with known camera poses."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from egs_warp.commands.camera_flags import COLOURS, parse_colour
from egs_warp.commands.flags import Commands, add_out_flag, capture_name, seed
from egs_warp.commands.scene_flags import add_overwrite_flag
from egs_warp.errors import UserError
from egs_warp.installation import install_command

if TYPE_CHECKING:
    import numpy as np

    from egs_warp.pipelines.train_capture import TrainResult

_SHEET_PHOTOS = 6
"""Maximum number of photos in the comparison sheet."""
_DEFAULTS = {"cpu": (1300, 20_000, 360), "cuda": (7000, None, 1600)}
"""Number of iterations, maximum number of Gaussians, and longer side of the photos in pixels: for a preview on two
cores, and for a capture on a GPU."""


EXAMPLES = (
    "posed --out capture.ply",
    "posed --out capture.spz --device cuda:0 --iterations 7000",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    train = commands.add_parser("train", help="train a capture on posed photos")
    train.add_argument(
        "posed",
        type=capture_name,
        help="COLMAP model, transforms.json, cameras.json, RealityScan's camera parameters (.csv) or Metashape's "
        "cameras (.xml), or a folder that contains one",
    )
    add_out_flag(
        train,
        "output file for the capture: .ply, .compressed.ply, .spz, .sog, .splat or .glb",
    )
    add_overwrite_flag(train, "--out")
    train.add_argument(
        "--resume", action="store_true", help="continue an interrupted training; give the same flags again"
    )
    train.add_argument("--iterations", type=int, help="optimiser steps, one photo each (cpu 1300, cuda 7000)")
    train.add_argument("--gaussians", type=int, help="maximum number of Gaussians (cpu 20000, cuda unlimited)")
    train.add_argument(
        "--max-side", type=int, help="longer side in pixels to which photos are reduced (cpu 360, cuda 1600)"
    )
    train.add_argument(
        "--sh-degree", type=int, default=3, help="degree of the spherical harmonics of the colours, 0 to 3 (3)"
    )
    train.add_argument(
        "--background",
        help="background colour: r,g,b from 0 to 1, #rrggbb or a CSS name (default: white for photos with "
        "alpha, otherwise the colour of "
        "their borders)",
    )
    train.add_argument(
        "--mask-object",
        choices=("white", "black"),
        help="colour of the object in masks (default: white, unless the masks clearly show that it is black)",
    )
    train.add_argument(
        "--seed", type=seed, default=0, help="seed of the initial Gaussians and of the order of photos (0)"
    )
    train.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    train.set_defaults(run=_train)


def _train(args: argparse.Namespace) -> int:
    progress = _Progress()
    try:
        lines = run_train(args, say=progress.say, show_step=progress.step)
    except BaseException as error:
        from egs_warp.io.writing import capture_stem

        if args.out.with_name(f"{capture_stem(args.out)}.training.npz").is_file():
            error.add_note("continue with --resume and the same flags")
        raise
    print(*lines, sep="\n")
    return 0


def run_train(
    args: argparse.Namespace, *, say: Callable[[str], None], show_step: Callable[[TrainStep], None]
) -> list[str]:
    """Run ``egs-warp train`` and return the lines of its summary.

    Args:
        args: the flags.
        say: called with a description of each stage as it starts.
        show_step: called after each step.
    """
    background = parse_colour(args.background) if args.background is not None else None
    if background is None and args.background is not None:
        raise UserError(f"--background {args.background}: give a colour: {COLOURS}")
    for flag, value, minimum in (
        ("--iterations", args.iterations, 1),
        ("--gaussians", args.gaussians, 100),
        ("--max-side", args.max_side, 16),
    ):
        if value is not None and value < minimum:
            raise UserError(f"{flag} {value}: give a whole number of at least {minimum}")
    if not 0 <= args.sh_degree <= 3:
        raise UserError(f"--sh-degree {args.sh_degree}: give 0, 1, 2 or 3")
    from egs_warp.io.named_files import check_named_files, named_files
    from egs_warp.io.writing import capture_stem, writer_of

    write = writer_of(args.out)
    stem = capture_stem(args.out)
    sheet, report_path = args.out.with_name(f"{stem}.sheet.png"), args.out.with_name(f"{stem}.report.json")
    checkpoint = args.out.with_name(f"{stem}.training.npz")
    if args.resume and args.out.exists() and not checkpoint.exists():
        return [f"{args.out}: this training has finished"]
    if checkpoint.exists() and not (args.resume or args.overwrite):
        raise UserError(
            f"--out {args.out}: its training was interrupted; give --resume to continue it, or --overwrite to start"
            " again"
        )
    outputs = (args.out, sheet, report_path)
    # With --resume, existing outputs belong to the interrupted run, or that run was allowed to overwrite them.
    overwrite = args.overwrite or (args.resume and checkpoint.exists())
    check_named_files(*outputs, overwrite=overwrite)
    import warp as wp

    from egs_warp.launching import use_device

    use_device(args.device)
    wp.config.log_level = wp.LOG_ERROR
    try:
        from egs_warp.pipelines.train_capture import train
    except ImportError as error:
        raise UserError(f"train: PyTorch is not installed; {install_command('torch')}") from error
    from egs_warp.io import read_cameras
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.train_report import TrainReport

    # Read the poses first, so that an error does not leave a new folder.
    read_cameras(args.posed)
    iterations, gaussians, side = _DEFAULTS["cuda" if args.device.startswith("cuda") else "cpu"]
    iterations = args.iterations or iterations
    pace = _Pace(iterations, show_step)
    began = time.perf_counter()
    with named_files(*outputs, overwrite=overwrite) as files:
        result = train(
            args.posed,
            iterations=iterations,
            max_gaussians=args.gaussians or gaussians,
            sh_degree=args.sh_degree,
            background=background,
            max_side=args.max_side or side,
            inverted_masks=None if args.mask_object is None else args.mask_object == "black",
            seed=args.seed,
            device=args.device,
            checkpoint=checkpoint,
            resume=args.resume,
            progress=pace.step,
            stage=say,
        )
        say(f"writing {args.out}")
        report = TrainReport.of(
            result,
            seconds=time.perf_counter() - began,
            frames_per_second=pace.frames_per_second,
            device=args.device,
            seed=args.seed,
            sh_degree=args.sh_degree,
        )
        comparison = _sheet(result)
        files.begin()
        write(args.out, result.cloud)
        report.write(report_path)
        write_png(sheet, comparison)
        # The checkpoint is only needed for resuming.
        checkpoint.unlink(missing_ok=True)
    wrote = f"wrote {args.out} ({result.cloud.count} Gaussians), {stem}.sheet.png, {stem}.report.json"
    return [*report.summary(), wrote]


@dataclass(frozen=True)
class TrainStep:
    """Progress of a training run."""

    done: int
    """Number of finished steps."""
    iterations: int
    loss: float
    frames_per_second: float
    """Training steps per second."""


class _Pace:
    """Speed of a training run. The first step is not timed, because it may compile kernels."""

    def __init__(self, iterations: int, show_step: Callable[[TrainStep], None]) -> None:
        self._iterations, self._show_step = iterations, show_step
        self._first: float | None = None
        self._before = 0
        self.frames_per_second = 0.0
        """Training steps per second."""

    def step(self, step: int, loss: float) -> None:
        """Show step ``step`` and its ``loss``."""
        now = time.perf_counter()
        if self._first is None:
            self._first, self._before = now, step
            return
        self.frames_per_second = (step - self._before) / max(now - self._first, 1e-9)
        self._show_step(TrainStep(step + 1, self._iterations, loss, self.frames_per_second))


class _Progress:
    """Progress on stderr: one line, updated in place, on a terminal, otherwise a line for every tenth of the run."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._shown = 0.0

    def say(self, stage: str) -> None:
        """Report the start of ``stage``."""
        print(f"egs-warp: {stage}", file=sys.stderr)

    def step(self, step: TrainStep) -> None:
        """Report a step."""
        now = time.perf_counter()
        last = step.done == step.iterations
        due = now - self._shown > 0.5 if self._terminal else step.done % max(1, step.iterations // 10) == 0
        if not (due or last):
            return
        self._shown = now
        left = round((step.iterations - step.done) / step.frames_per_second)
        text = (
            f"egs-warp: training {step.done}/{step.iterations}, loss {step.loss:.4f},"
            f" {step.frames_per_second:.1f} frames/s, {left // 60}:{left % 60:02d} left"
        )
        end = "\n" if last or not self._terminal else ""
        print(f"\r{text}\x1b[K" if self._terminal else text, end=end, file=sys.stderr, flush=True)


def _sheet(result: TrainResult) -> np.ndarray:
    """Return the comparison sheet (H, W, 3) uint8: photos next to their renders, of held-out photos if there are
    any."""
    import numpy as np

    from egs_warp.io.video import contact_sheet
    from egs_warp.render import render_gaussians

    pairs = list(zip(result.views, result.scores, strict=True))
    judged = [pair for pair in pairs if pair[1].held_out] or pairs
    picked = [judged[i] for i in np.unique(np.linspace(0, len(judged) - 1, _SHEET_PHOTOS).round().astype(int))]
    frames, labels = [], []
    for view, score in picked:
        for kind, picture in (
            (f"photo {score.name}", np.rint(view.image * 255).astype(np.uint8)),
            (
                f"{score.psnr:.1f} dB, SSIM {score.ssim:.3f}",
                render_gaussians(result.cloud, view.camera, background=result.background).colour_srgb8(),
            ),
        ):
            frames.append(picture)
            labels.append(kind)
    return contact_sheet(frames, 4 if len(picked) > 2 else 2, labels)
