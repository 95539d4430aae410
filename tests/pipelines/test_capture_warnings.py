"""Warnings about captures whose body may not be what the user expects."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.capture_warnings import capture_warnings
from tests.support.meshes import block_mesh


def block(count: int, shift: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    nodes = block_mesh().nodes
    return rng.uniform(nodes.min(axis=0), nodes.max(axis=0), (count, 3)) + [shift, 0.0, 0.0]


def cloud_at(means: np.ndarray) -> GaussianCloud:
    count = len(means)
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return GaussianCloud.from_numpy(
        means, rotations, np.full((count, 3), -4.0), np.full(count, 2.0), np.zeros((count, 1, 3)), device="cpu"
    )


def test_an_ordinary_body_has_none() -> None:
    assert capture_warnings(cloud_at(block(400)), block_mesh(), 1.0) == ()


def test_few_gaussians_cause_a_warning() -> None:
    assert capture_warnings(cloud_at(block(2)), block_mesh(), 1.0) == ("only 2 Gaussians: most of the body is guessed",)


def test_another_object_is_reported() -> None:
    both = cloud_at(np.concatenate([block(300), block(100, shift=2.0)]))
    (note,) = capture_warnings(both, block_mesh(), 1.0)
    assert note.startswith("25 % of the capture lies apart from the body, up to ")
    assert note.endswith("remove other objects first")
