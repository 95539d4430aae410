"""Pawns on a circle walk to the opposite side at the same time and avoid each other.

Writes the film, the contact sheet, the report, and a trajectory and a report for each pawn.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import egs_warp as egs


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/crowd"))
    parser.add_argument("--count", type=int, default=8, help="number of pawns")
    parser.add_argument("--radius", type=float, default=1.5, help="radius of the circle, m")
    parser.add_argument("--nodes", type=int, default=60, help="approximate number of cage nodes of each pawn")
    parser.add_argument("--frames", type=int, help="number of frames (default: until all pawns are at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    built_in = egs.scene("pawn", device=chosen.device)
    options = egs.CreatureOptions(nodes=chosen.nodes)
    pawn = egs.make_creature(built_in.object, plane=built_in.plane, options=options)
    world = egs.World(friction=0.8)
    motions = {}
    for number in range(chosen.count):
        angle = 2.0 * np.pi * number / chosen.count
        at = (chosen.radius * float(np.cos(angle)), chosen.radius * float(np.sin(angle)))
        walker = world.add(pawn, at=at, heading=float(np.degrees(angle)) + 180.0, name=f"pawn-{number + 1}")
        motions[walker] = f"walk to {2.0 * chosen.radius},0"
    run = egs.simulate(world, motions, frames=chosen.frames)
    report = egs.write_world(run, chosen.out, size=chosen.size, overwrite=True)
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, report.json and a folder for each pawn to {chosen.out}")
    return report


if __name__ == "__main__":
    with egs.one_line_errors("crowd.py"):
        main()
