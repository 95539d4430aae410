"""``egs-warp pose``: camera poses of photos or of a video."""

from __future__ import annotations

import argparse
import sys
import time

from egs_warp.commands.flags import Commands, named_path, seed
from egs_warp.commands.scene_flags import add_overwrite_flag
from egs_warp.errors import UserError

_NAMED = 5
"""Photos without a pose that are named; the rest is counted."""


EXAMPLES = (
    "photos --out posed",
    "walkaround.mp4 --frames 200 --out posed",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    pose = commands.add_parser("pose", help="find where photos were taken from")
    pose.add_argument("photos", help="folder of photos, or a video")
    pose.add_argument(
        "--out", required=True, type=named_path, help="new folder for images and sparse/0, which train reads"
    )
    add_overwrite_flag(pose, "--out")
    pose.add_argument("--frames", type=int, default=150, help="of a video, the sharpest evenly in time (150)")
    pose.add_argument("--max-side", type=int, default=1600, help="pixels at which features are found (1600)")
    pose.add_argument("--seed", type=seed, default=0, help="of the reconstruction (0)")
    pose.set_defaults(run=_pose)


def _pose(chosen: argparse.Namespace) -> int:
    from egs_warp.io.run_folder import check_run_folder
    from egs_warp.pipelines.pose_photos import pose_photos

    for flag, value, least in (("--frames", chosen.frames, 3), ("--max-side", chosen.max_side, 64)):
        if value < least:
            raise UserError(f"{flag} {value}: give a whole number of at least {least}")
    check_run_folder(chosen.out, overwrite=chosen.overwrite)
    shown = _Progress()
    result = pose_photos(
        chosen.photos,
        chosen.out,
        frames=chosen.frames,
        max_side=chosen.max_side,
        seed=chosen.seed,
        overwrite=chosen.overwrite,
        stage=shown.say,
        progress=shown.step,
    )
    shown.end()
    print(
        f"posed {result.registered} of {result.photos} photos ({100 * result.registered / result.photos:.0f} %),"
        f" {result.points} points, reprojection error {result.error:.2f} pixels"
    )
    if result.without_pose:
        names = ", ".join(result.without_pose[:_NAMED])
        more = len(result.without_pose) - _NAMED
        print(f"without a pose: {names}{f' and {more} more' if more > 0 else ''}")
    print(f"wrote {chosen.out}; next: egs-warp train {chosen.out} --out capture.ply")
    return 0


class _Progress:
    """One line on stderr that is rewritten on a terminal, a line every fifth of a stage elsewhere."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._open = False
        self._fifth = -1
        self._began = time.perf_counter()

    def say(self, stage: str) -> None:
        """A new stage."""
        self.end()
        self._fifth = -1
        print(f"egs-warp: {stage}", file=sys.stderr)

    def step(self, stage: str, done: int, of: int) -> None:
        """How far the stage is."""
        fifth = 5 * done // max(of, 1)
        if not self._terminal and fifth == self._fifth:
            return
        self._fifth = fifth
        seconds = round(time.perf_counter() - self._began)
        text = f"egs-warp: {stage} {done}/{of}, {seconds // 60}:{seconds % 60:02d}"
        end = "" if self._terminal else "\n"
        print(f"\r{text}\x1b[K" if self._terminal else text, end=end, file=sys.stderr, flush=True)
        self._open = self._terminal

    def end(self) -> None:
        """Leave the line that is rewritten."""
        if self._open:
            print(file=sys.stderr)
            self._open = False
