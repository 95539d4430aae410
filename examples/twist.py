"""The built-in chess pawn jumps and turns about: video, contact sheet, report and trajectory."""

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
    parser.add_argument("--out", type=Path, default=Path("out/twist"))
    parser.add_argument("--degrees", type=float, default=180.0)
    parser.add_argument("--frames", type=int, help="default: until it rests")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    use_device(chosen.device)
    thing = pawn(device=chosen.device)
    options = AnimateOptions(heading_degrees=chosen.degrees, frames=chosen.frames, size=chosen.size)
    report = animate(thing.cloud, chosen.out, motion="twist", plane=thing.plane, options=options, source="pawn")
    print(report.summary())
    print(f"wrote the video, sheet.png, report.json, trajectory.npz into {chosen.out}")
    return report


if __name__ == "__main__":
    with one_line_errors("twist.py"):
        main()
