"""A pawn jumps three squares, strikes another piece in passing, and lands beyond it; the piece topples.

Writes the film, the contact sheet, the report, and a trajectory and a report for each body.
"""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import egs_warp as egs

SQUARE = 0.4
"""Side of a square, in heights of the pawn, chosen so that the pawn can jump three squares."""


PIECE_HEIGHT, SLENDERNESS = 0.7, 0.6
"""Height of the other piece, m, and the ratio of its width to that of a pawn of this height."""
BASE_FRICTION = 0.4
"""Coulomb coefficient of lacquered wood on a lacquered board."""


def main(arguments: list[str] | None = None) -> egs.WorldReport:
    """Run the example and return the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/chess"))
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
    """Return the world and the motion of the attacker.

    Args:
        seed: seed of the random position of the piece (up to a tenth of a square off), its density (40 to 90 kg/m^3)
            and the heading of the pawn (up to 20 degrees off); None gives the start without deviations.
        nodes: approximate number of cage nodes of the pawn.
        device: Warp device.
    """
    random = np.zeros(4) if seed is None else np.random.default_rng(seed).uniform(-1.0, 1.0, 4)
    aside = 0.1 * SQUARE * random[:2]
    density = 65.0 + 25.0 * float(random[2])
    piece = egs.make_prop(slender(pawn_scene(device).object), up="z", density=density, height=PIECE_HEIGHT)
    world = egs.World(friction=BASE_FRICTION)
    world.add(pawn(nodes, device), heading=20.0 * float(random[3]), name="attacker")
    world.add(piece, at=(1.6 * SQUARE + float(aside[0]), 0.8 * SQUARE + float(aside[1])), name="target")
    return world, {"attacker": f"kick target distance={3.0 * SQUARE:g}"}


def slender(cloud: egs.GaussianCloud) -> egs.GaussianCloud:
    """Return the capture of a pawn as a slender piece: its width multiplied by ``SLENDERNESS``, in grey."""
    factors = np.array([SLENDERNESS, SLENDERNESS, 1.0])
    rotations = Rotation.from_quat(cloud.rotations.numpy().astype(float), scalar_first=True).as_matrix()
    # Covariance factor F R S of the deformed Gaussians, decomposed into a rotation and scales.
    axes, scales, _ = np.linalg.svd(factors[:, None] * rotations * np.exp(cloud.log_scales.numpy())[:, None, :])
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]
    return egs.GaussianCloud.from_numpy(
        cloud.means.numpy() * factors,
        Rotation.from_matrix(axes).as_quat(scalar_first=True),
        np.log(scales),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy().mean(axis=2, keepdims=True).repeat(3, axis=2),
        device=str(cloud.means.device),
    )


@cache
def pawn_scene(device: str) -> egs.Scene:
    """Return the capture of a pawn."""
    return egs.scene("pawn", device=device)


@cache
def pawn(nodes: int, device: str) -> egs.Creature:
    """Return the pawn as a creature."""
    scene = pawn_scene(device)
    return egs.make_creature(scene.object, plane=scene.plane, options=egs.CreatureOptions(nodes=nodes))


if __name__ == "__main__":
    with egs.one_line_errors("chess.py"):
        main()
