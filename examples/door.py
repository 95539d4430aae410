"""A pawn jumps against a door, which turns on its hinge and lets the pawn through.

Writes the film, the contact sheet, the report, and a trajectory and a report for each body.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import egs_warp as egs

SIZE = (0.08, 1.0, 1.3)
"""Thickness, width and height of the door, m."""
FRONT = 0.55
"""Distance from the middle of the pawn to the middle of the door, m."""
LIFT = 0.02
"""Gap between the door and the ground, m."""


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/door"))
    parser.add_argument("--nodes", type=int, default=100, help="approximate number of cage nodes of the pawn")
    parser.add_argument("--frames", type=int, default=100, help="number of frames")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    egs.use_device(chosen.device)
    scene = egs.scene("pawn", device=chosen.device)
    pawn = egs.make_creature(scene.object, plane=scene.plane, options=egs.CreatureOptions(nodes=chosen.nodes))
    cloud = egs.box_cloud(SIZE, paint, device=chosen.device)
    panel = egs.make_prop(cloud, up="z", height=SIZE[2], density=40.0)
    world = egs.World(friction=0.6)
    world.add(pawn, heading=0.0, name="pawn")
    # Thickness and width of the capture are along the y axis and the -x axis of the frame of the prop.
    door = world.add(panel, at=(FRONT, 0.0), above=LIFT, heading=90.0, name="door")
    for height in (0.2, 1.1):
        world.add_joint(door, at=(FRONT, 0.5 * SIZE[1] - 0.03, LIFT + height))
    run = egs.simulate(world, {"pawn": "jump 0.8"}, frames=chosen.frames, get_up=False)
    report = egs.write_world(run, chosen.out, size=chosen.size, view_from=(-0.6, -1.0, 0.7), overwrite=True)
    print(report.summary())
    print(f"the door opens by {opening(run['door'].trajectory):.0f} degrees")
    print(f"wrote {report.film}, sheet.png, report.json and a folder for each body to {chosen.out}")
    return report


def opening(door: egs.Trajectory) -> float:
    """Return the largest angle of the door, degrees."""
    edge = door.positions @ np.array([1.0, 1.0j, 0.0])
    arms = edge - edge.mean(axis=1, keepdims=True)
    angles = np.unwrap(np.angle((arms * arms[0].conj()).sum(axis=1)))
    return float(np.degrees(np.abs(angles).max()))


def paint(points: np.ndarray) -> np.ndarray:
    """Return the colours of wood: the door has two panels with darker frames."""
    half = 0.5 * np.array(SIZE)
    across, up = np.abs(points[:, 1]), np.abs(points[:, 2])
    inside = (across < half[1] - 0.12) & (np.abs(up - 0.5 * half[2]) < 0.5 * half[2] - 0.1)
    return np.where(inside, 1.0, 0.7)[:, None] * np.array([0.62, 0.44, 0.28])


if __name__ == "__main__":
    with egs.one_line_errors("door.py"):
        main()
