"""A pawn hops up three steps.

Writes the film, the contact sheet, the report, and a trajectory and a report of the pawn.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import egs_warp as egs

DEPTH, RISE, WIDTH, STEPS = 0.8, 0.12, 1.6, 3
"""Depth, height and width of a step, m, and the number of steps."""
FIRST_EDGE = 0.4
"""Distance of the first step from the middle of the pawn, m."""


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/stairs"))
    parser.add_argument("--nodes", type=int, default=100, help="approximate number of cage nodes of the pawn")
    parser.add_argument("--frames", type=int, help="number of frames (default: until the pawn is at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    built_in = egs.scene("pawn", device=chosen.device)
    options = egs.CreatureOptions(nodes=chosen.nodes)
    pawn = egs.make_creature(built_in.object, plane=built_in.plane, options=options)
    world = egs.World(friction=0.8, solids=tuple(step(number) for number in range(STEPS)))
    climber = world.add(pawn, heading=0.0, name="climber")
    run = egs.simulate(world, {climber: f"hop {DEPTH} height=0.3 x{STEPS}"}, frames=chosen.frames)
    report = egs.write_world(run, chosen.out, size=chosen.size, view_from=(0.35, -1.0, 0.45), overwrite=True)
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, report.json and a folder for the pawn to {chosen.out}")
    return report


def step(number: int) -> egs.Solid:
    """Return the solid of a step: a box from its front edge to the end of the stairs."""
    front, end, top = FIRST_EDGE + number * DEPTH, FIRST_EDGE + STEPS * DEPTH, (number + 1) * RISE
    along, across, up = np.eye(3)
    return egs.Solid(
        (
            egs.Plane(up, -top),
            egs.Plane(-along, front),
            egs.Plane(along, -end),
            egs.Plane(across, -0.5 * WIDTH),
            egs.Plane(-across, -0.5 * WIDTH),
        )
    )


if __name__ == "__main__":
    with egs.one_line_errors("stairs.py"):
        main()
