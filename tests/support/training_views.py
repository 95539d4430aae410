"""A ball of Gaussians and cameras around it, for the tests of training."""

from __future__ import annotations

from typing import Any

import numpy as np

from egs_warp.geometry.camera import Camera


def ring(count: int = 6, size: int = 40) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        Camera.look_at(
            np.array([3 * np.cos(a), -1.0, 3 * np.sin(a)]), np.zeros(3), np.array([0, -1.0, 0]), width=size, height=size
        )
        for a in angles
    ]


def ball(count: int = 150, seed: int = 0) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return {
        "means": 0.7 * directions,
        "rotations": random.normal(size=(count, 4)),
        "log_scales": np.full((count, 3), -1.9) + random.normal(0, 0.2, (count, 3)),
        "opacity_logits": np.full(count, 2.0),
        "sh": np.concatenate([directions[:, None], random.normal(0, 0.05, (count, 3, 3))], axis=1),
    }
