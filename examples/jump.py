"""The built-in chess pawn jumps: video, contact sheet, report and trajectory."""

from __future__ import annotations

import argparse
from pathlib import Path

import warp as wp

from egs_warp.assets import pawn
from egs_warp.commands.flags import one_line_errors
from egs_warp.launching import use_device
from egs_warp.pipelines.animate import AnimateOptions, animate
from egs_warp.pipelines.report import Report


def main(arguments: list[str] | None = None) -> Report:
    """Run the example; returns the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/jump"))
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    use_device(chosen.device)
    thing = pawn(device=chosen.device)
    options = AnimateOptions(distance=0.5, height=0.2, frames=chosen.frames, size=chosen.size)
    report = animate(thing.cloud, chosen.out, plane=thing.plane, options=options, source="pawn")
    print(report.summary())
    print(f"wrote the video, sheet.png, report.json, trajectory.npz into {chosen.out}")
    return report


if __name__ == "__main__":
    with one_line_errors("jump.py"):
        main()
