"""High jump of a pawn: the cross-entropy method optimises a crouch and a thrust in many worlds at once.

Each world of a Gymnasium vector environment tries its own parameters: the durations of the crouch and of the thrust,
and the target velocity of the centre of mass in each of them. The next generation is drawn from the distribution of the
best quarter. The example needs the extra gymnasium. On a GPU, use more worlds: --device cuda:0 --worlds 512.
"""

from __future__ import annotations

import argparse

import numpy as np

import egs_warp as egs

NAMES = "crouch frames", "crouch speed", "thrust frames", "thrust speed"
MEAN, SPREAD = np.array([8.0, -0.3, 8.0, 0.6]), np.array([3.0, 0.1, 3.0, 0.3])
"""Mean and standard deviation of the parameters of the first generation; speeds are in sqrt(g H)."""
LOWEST, HIGHEST = np.array([2.0, -0.8, 2.0, 0.1]), np.array([20.0, 0.0, 20.0, 2.0])
"""Bounds of the parameters."""


def main(arguments: list[str] | None = None) -> list[float]:
    """Run the example and return the greatest height of each generation, body heights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=8, help="number of worlds, each a candidate of a generation")
    parser.add_argument("--generations", type=int, default=4)
    parser.add_argument("--frames", type=int, default=30, help="frames of each candidate, at 60 Hz")
    parser.add_argument("--nodes", type=int, default=50, help="requested number of nodes of the cage")
    parser.add_argument("--device", default="cpu")
    chosen = parser.parse_args(arguments)
    if chosen.worlds < 4:
        raise egs.UserError(f"--worlds {chosen.worlds}: give at least 4, because the best quarter continues")
    egs.use_device(chosen.device)
    scene = egs.scene("pawn", device=chosen.device)
    creature = egs.make_creature(scene.object, plane=scene.plane, options=egs.CreatureOptions(nodes=chosen.nodes))
    worlds = egs.CreatureVectorEnv(creature, chosen.worlds, actions="targets", frames=chosen.frames + 1)
    rng, mean, spread = np.random.default_rng(0), MEAN, SPREAD
    best = []
    for generation in range(chosen.generations):
        candidates = np.clip(rng.normal(mean, spread, (chosen.worlds, len(mean))), LOWEST, HIGHEST)
        heights = greatest_heights(worlds, candidates, chosen.frames)
        elite = candidates[np.argsort(heights)[-max(2, chosen.worlds // 4) :]]
        # A tenth of the initial standard deviation is added, so that the search does not end before the mean has
        # reached the optimum.
        mean, spread = elite.mean(axis=0), elite.std(axis=0) + 0.1 * SPREAD
        best.append(float(heights.max()))
        found = ", ".join(f"{name} {value:.2f}" for name, value in zip(NAMES, mean, strict=True))
        print(f"generation {generation + 1}: rises {best[-1]:.3f} body heights; {found}")
    return best


def greatest_heights(worlds: egs.CreatureVectorEnv, candidates: np.ndarray, frames: int) -> np.ndarray:
    """Return the greatest rise (B,), in body heights, of the centre of mass above its start with each of the
    ``candidates`` (B, 4), or 0 for a world whose step cannot be solved."""
    crouch_frames, crouch_speed, thrust_frames, thrust_speed = candidates.T
    worlds.reset()
    greatest, is_valid = np.zeros(len(candidates)), np.ones(len(candidates), bool)
    for frame in range(frames):
        speed = np.where(frame < crouch_frames, crouch_speed, 0.0)
        is_thrust = (frame >= crouch_frames) & (frame < crouch_frames + thrust_frames)
        actions = np.zeros((len(candidates), 3))
        actions[:, 2] = np.where(is_thrust, thrust_speed, speed)
        _, _, failed, _, _ = worlds.step(actions)
        is_valid &= ~failed
        greatest = np.maximum(greatest, np.where(is_valid, worlds.measurement.displacement[:, 2], 0.0))
    return np.where(is_valid, greatest, 0.0)


if __name__ == "__main__":
    with egs.one_line_errors("optimise_jump.py"):
        main()
