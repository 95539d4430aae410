"""The pawn hops across the chess board of its scene, a square at a time:
video, contact sheet, report and trajectory.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import warp as wp

from egs_warp.assets import scene
from egs_warp.assets.rooms import SQUARE
from egs_warp.commands.flags import check_device
from egs_warp.errors import one_line_errors
from egs_warp.pipelines.animate import AnimateOptions, animate
from egs_warp.pipelines.report import summary


def main(arguments: list[str] | None = None) -> dict:
    """Run the example; returns the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/hop"))
    parser.add_argument("--hops", type=int, default=5)
    parser.add_argument("--frames", type=int, help="default: until it rests")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    check_device(chosen.device)
    chess = scene("pawn", device=chosen.device)
    report = animate(
        chess.object,
        chosen.out,
        motion=f"hop x{chosen.hops}",
        plane=chess.plane,
        background=chess.background,
        forward=np.array([1.0, 0.0, 0.0]),
        options=AnimateOptions(distance=SQUARE, frames=chosen.frames, size=chosen.size),
        source="pawn",
    )
    print(summary(report))
    print(f"wrote the video, sheet.png, report.json, trajectory.npz into {chosen.out}")
    return report


if __name__ == "__main__":
    with one_line_errors("hop.py"):
        main()
