"""``egs-warp pose``: estimate the camera poses of photos or of a video."""

from __future__ import annotations

import argparse
import sys
import time

from egs_warp.commands.flags import Commands, add_out_flag, seed
from egs_warp.commands.scene_flags import add_overwrite_flag
from egs_warp.errors import UserError

EXAMPLES = (
    "photos --out posed",
    "walkaround.mp4 --frames 200 --out posed",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    pose = commands.add_parser("pose", help="estimate the camera poses of photos")
    pose.add_argument("photos", help="folder of photos, or a video")
    add_out_flag(pose, "new folder for images and sparse/0, the input of train", metavar="FOLDER")
    add_overwrite_flag(pose, "--out")
    pose.add_argument(
        "--frames", type=int, default=150, help="number of frames taken from a video, sharp and evenly spaced (150)"
    )
    pose.add_argument(
        "--max-side", type=int, default=1600, help="longer side in pixels at which features are detected (1600)"
    )
    pose.add_argument("--seed", type=seed, default=0, help="seed of the reconstruction (0)")
    pose.set_defaults(run=_pose)


def _pose(args: argparse.Namespace) -> int:
    from egs_warp.io.run_folder import check_run_folder
    from egs_warp.pipelines.pose_photos import pose_photos

    for flag, value, minimum in (("--frames", args.frames, 3), ("--max-side", args.max_side, 64)):
        if value < minimum:
            raise UserError(f"{flag} {value}: give a whole number of at least {minimum}")
    check_run_folder(args.out, overwrite=args.overwrite)
    progress = _Progress()
    result = pose_photos(
        args.photos,
        args.out,
        frames=args.frames,
        max_side=args.max_side,
        seed=args.seed,
        overwrite=args.overwrite,
        stage=progress.say,
        progress=progress.step,
    )
    progress.end()
    print(*result.summary(), sep="\n")
    print(f"wrote {args.out}; next step: egs-warp train {args.out} --out capture.ply")
    return 0


class _Progress:
    """Progress on stderr: one line, updated in place, on a terminal, otherwise a line for every fifth of a stage."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._open = False
        self._fifth = -1
        self._began = time.perf_counter()

    def say(self, stage: str) -> None:
        """Report the start of ``stage``."""
        self.end()
        self._fifth = -1
        print(f"egs-warp: {stage}", file=sys.stderr)

    def step(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` items of ``stage`` are done."""
        fifth = 5 * done // max(total, 1)
        if not self._terminal and fifth == self._fifth:
            return
        self._fifth = fifth
        seconds = round(time.perf_counter() - self._began)
        text = f"egs-warp: {stage} {done}/{total}, {seconds // 60}:{seconds % 60:02d}"
        end = "" if self._terminal else "\n"
        print(f"\r{text}\x1b[K" if self._terminal else text, end=end, file=sys.stderr, flush=True)
        self._open = self._terminal

    def end(self) -> None:
        """End the line that is updated in place."""
        if self._open:
            print(file=sys.stderr)
            self._open = False
