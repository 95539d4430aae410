"""A ball on a floor, for the tests of scenes."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


def ball_on_floor(lift: float = 0.0) -> tuple[GaussianCloud, np.ndarray]:
    """A hollow ball with loose matter inside, on a square of floor, with a floater above; and which are the ball's."""
    random = np.random.default_rng(1)
    shell = random.normal(size=(1500, 3))
    shell = 0.5 * shell / np.linalg.norm(shell, axis=1, keepdims=True) + [0.0, 0.0, 0.5 + lift]
    inner = random.normal(scale=0.05, size=(20, 3)) + [0.0, 0.0, 0.5 + lift]
    grid = np.stack(np.meshgrid(*[np.linspace(-1.5, 1.5, 60)] * 2), axis=-1).reshape(-1, 2)
    floor = np.column_stack([grid, random.normal(0.0, 0.002, len(grid))])
    floater = np.array([[0.55, 0.0, 1.0]])
    means = np.concatenate([shell, inner, floater, floor])
    scales = np.full((len(means), 3), np.log(0.025))
    scales[len(shell) + len(inner) + 1 :, 2] = np.log(0.004)
    cloud = GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        scales,
        np.full(len(means), 3.0),
        random.uniform(-1.0, 1.0, (len(means), 1, 3)),
    )
    return cloud, np.arange(len(means)) < len(shell) + len(inner)
