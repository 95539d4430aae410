"""Two figurines duel: the first twists towards the second in a jump and then jumps against it.

Writes the film, the contact sheet, the report, and a trajectory and a report for each body.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import egs_warp as egs


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/duel"))
    parser.add_argument("--distance", type=float, default=0.9, help="distance between the figurines, m")
    parser.add_argument("--nodes", type=int, default=100, help="approximate number of cage nodes of each figurine")
    parser.add_argument("--frames", type=int, help="number of frames (default: until all bodies are at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    built_in = egs.scene("figurine", device=chosen.device)
    options = egs.CreatureOptions(nodes=chosen.nodes)
    figurine = egs.make_creature(built_in.object, plane=built_in.plane, options=options)
    world = egs.World(friction=0.8)
    attacker = world.add(figurine, heading=180.0, name="attacker")
    defender = world.add(figurine, at=(chosen.distance, 0.0), heading=180.0, name="defender")
    motions = {attacker: "twist 180, jump 0.5", defender: "stand"}
    run = egs.simulate(world, motions, frames=chosen.frames, get_up=False)
    report = egs.write_world(run, chosen.out, size=chosen.size, overwrite=True)
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, report.json and a folder for each body to {chosen.out}")
    return report


if __name__ == "__main__":
    with egs.one_line_errors("duel.py"):
        main()
