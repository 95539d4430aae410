"""A pawn walks behind a box and pushes it up a ramp.

Writes the film, the contact sheet, the report, and a trajectory and a report for each body.
"""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path

import numpy as np

import egs_warp as egs

SIZE = LENGTH, _, HEIGHT = 0.7, 0.5, 0.3
"""Length, width and height of the box, m."""
RAMP_AT, RAMP_LENGTH, RAMP_HEIGHT = 1.4, 1.2, 0.25
"""Distance of the foot of the ramp, its length along the ground and its rise, m."""

UP_AT = RAMP_AT + 0.4 * LENGTH
"""Position of the middle of the box, m, from which the box counts as up the ramp, with at most a tenth of it still
before the ramp."""


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/push"))
    parser.add_argument("--seed", type=int, help="seed of random deviations from the default start")
    parser.add_argument("--nodes", type=int, default=100, help="approximate number of cage nodes of the pawn")
    parser.add_argument("--frames", type=int, help="number of frames (default: until all bodies are at rest)")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    world, motions = start(chosen.seed, nodes=chosen.nodes, device=chosen.device)
    run = egs.simulate(world, motions, frames=chosen.frames)
    report = egs.write_world(run, chosen.out, size=chosen.size, view_from=(0.35, -1.0, 0.45), overwrite=True)
    print(report.summary())
    print(f"wrote {report.film}, sheet.png, report.json and a folder for each body to {chosen.out}")
    return report


def start(seed: int | None, *, nodes: int = 100, device: str = "cpu") -> tuple[egs.World, dict[str, str]]:
    """Return the world and the motion of the pusher.

    Args:
        seed: seed of the random position of the box (up to 0.05 m along and 0.1 m across the ramp), its heading (up to
            10 degrees) and its density (30 to 90 kg/m^3), and the heading of the pawn (up to 20 degrees); None gives
            the start without deviations.
        nodes: approximate number of cage nodes of the pawn.
        device: Warp device.
    """
    random = np.zeros(5) if seed is None else np.random.default_rng(seed).uniform(-1.0, 1.0, 5)
    cloud = egs.box_cloud(SIZE, paint, spacing=0.012, device=device)
    box = egs.make_prop(cloud, up="z", height=HEIGHT, density=60.0 + 30.0 * float(random[0]))
    world = egs.World(friction=0.5, solids=(ramp(),))
    world.add(pawn(nodes, device), heading=20.0 * float(random[1]), name="pusher")
    at = (0.9 + 0.05 * float(random[2]), 0.1 * float(random[3]))
    world.add(box, at=at, heading=10.0 * float(random[4]), name="box")
    # At this position, the whole box is on the ramp.
    return world, {"pusher": f"push box to {RAMP_AT + 0.5 * LENGTH:g},0"}


@cache
def pawn(nodes: int, device: str) -> egs.Creature:
    """Return the pawn as a creature."""
    scene = egs.scene("pawn", device=device)
    return egs.make_creature(scene.object, plane=scene.plane, options=egs.CreatureOptions(nodes=nodes))


def ramp() -> egs.Solid:
    """Return the ramp, which rises along x."""
    slope = np.array([-RAMP_HEIGHT, 0.0, RAMP_LENGTH]) / np.hypot(RAMP_HEIGHT, RAMP_LENGTH)
    end, side = RAMP_AT + RAMP_LENGTH, 0.6
    along, across = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    return egs.Solid(
        (
            egs.Plane(slope, -float(slope[0]) * RAMP_AT),
            egs.Plane(along, -end),
            egs.Plane(across, -side),
            egs.Plane(-across, -side),
        )
    )


def paint(points: np.ndarray) -> np.ndarray:
    """Return the colours of wood: the box has planks along its length, which are darker at their joints and edges."""
    half = 0.5 * np.array(SIZE)
    joint = np.abs((points[:, 1] + points[:, 2]) / 0.1 % 1.0 - 0.5)
    edge = (np.abs(points) > half - 0.02).sum(axis=1) > 1
    shade = np.where(edge, 0.55, np.where(joint < 0.06, 0.6, 1.0)) * (0.8 + 0.2 * (points[:, 2] > half[2] - 1e-6))
    return shade[:, None] * np.array([0.72, 0.5, 0.28])


if __name__ == "__main__":
    with egs.one_line_errors("push.py"):
        main()
