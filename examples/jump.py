"""The built-in chess pawn jumps: video, contact sheet, report and trajectory."""

from __future__ import annotations

import argparse
from pathlib import Path

from egs_warp.animation import AnimateOptions, animate
from egs_warp.report import summary
from egs_warp.scenes import pawn


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/jump"))
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    scene = pawn(device=arguments.device)
    options = AnimateOptions(distance=0.5, height=0.2, frames=arguments.frames, size=arguments.size)
    report = animate(scene.cloud, arguments.out, plane=scene.plane, options=options, source="pawn")
    print(summary(report))


if __name__ == "__main__":
    main()
