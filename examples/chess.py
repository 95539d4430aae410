"""A pawn jumps three squares, strikes another piece in passing, and lands beside it; the piece topples.

Writes the film, the contact sheet, the report, and a trajectory and a report for each body.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import egs_warp as egs

SQUARE = 0.4
"""Side of a square, in heights of the pawn: three squares are a jump that the pawn can make."""


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/chess"))
    parser.add_argument("--density", type=float, default=60.0, help="density of the other piece, kg/m^3")
    parser.add_argument("--nodes", type=int, default=100, help="approximate number of cage nodes of the pawn")
    parser.add_argument("--frames", type=int, help="number of frames (default: until all bodies are at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    built_in = egs.scene("pawn", device=chosen.device)
    options = egs.CreatureOptions(nodes=chosen.nodes)
    pawn = egs.make_creature(built_in.object, plane=built_in.plane, options=options)
    piece = egs.make_prop(built_in.object, plane=built_in.plane, density=chosen.density, height=0.6)
    # Lacquered wood on a lacquered board.
    world = egs.World(friction=0.4)
    attacker = world.add(pawn, heading=0.0, name="attacker")
    world.add(piece, at=(1.6 * SQUARE, 0.8 * SQUARE), name="target")
    motions = {attacker: f"kick target distance={3.0 * SQUARE}"}
    run = egs.simulate(world, motions, frames=chosen.frames)
    report = egs.write_world(run, chosen.out, size=chosen.size, overwrite=True)
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, report.json and a folder for each body to {chosen.out}")
    return report


if __name__ == "__main__":
    with egs.one_line_errors("chess.py"):
        main()
