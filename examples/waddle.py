"""The built-in pawn waddles on its base, like a wardrobe being walked: video, contact sheet, report and trajectory."""

from __future__ import annotations

import argparse
from pathlib import Path

import egs_warp as egs


def main(arguments: list[str] | None = None) -> egs.Report:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/waddle"))
    parser.add_argument("--distance", type=float, default=0.6, help="body heights")
    parser.add_argument("--frames", type=int, help="number of frames (default: until the body is at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    built_in = egs.scene("pawn", device=chosen.device)
    options = egs.AnimateOptions(frames=chosen.frames, size=chosen.size, source="pawn")
    report = egs.animate(
        built_in.object,
        chosen.out,
        motion=f"walk {chosen.distance}",
        plane=built_in.plane,
        options=options,
        overwrite=True,
    )
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, plots.png, report.json and trajectory.npz to {chosen.out}")
    return report


if __name__ == "__main__":
    with egs.one_line_errors("waddle.py"):
        main()
