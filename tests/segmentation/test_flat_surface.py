"""Flat surface around a footprint: a pedestal in a bowl, beside a step."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.gaussians import concatenate
from egs_warp.segmentation.flat_surface import bounded_by_surface
from tests.support.scenes import FLOOR, blocks, round_ones


def test_only_the_surface_that_continues_from_the_footprint_is_flat() -> None:
    """An object stood on a pedestal 1 wide. The tops of a step and of a bowl's rim are in the same plane, 0.4 away.
    Gaussians of the pedestal count down to its base, also those below a hole in its captured top; a fragment above its
    top does not count."""
    block = blocks(((-0.5, -0.5, -0.4), (0.5, 0.5, 0.0)))
    means = block.means.numpy()
    in_hole = (np.hypot(means[:, 0] + 0.2, means[:, 1]) < 0.13) & (means[:, 2] > -0.01)
    pedestal = concatenate(block.subset(~in_hole), round_ones(np.array([[-0.2, 0.0, -0.1]]), 0.02))
    step = blocks(((0.9, -0.5, -0.4), (1.3, 0.5, 0.0)))
    angles = np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False)
    rim = round_ones(1.9 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(300)]), 0.02)
    fragment = round_ones(np.array([[0.1, 0.1, 0.1]]), 0.005)
    cloud = concatenate(concatenate(pedestal, step), concatenate(rim, fragment))
    footprint = np.array([[-0.1, 0.0, 0.01], [0.1, 0.0, 0.02]])
    found = bounded_by_surface(cloud, FLOOR, footprint, 0.03)
    assert found[: pedestal.count].all() and not found[pedestal.count :].any()
    nowhere = bounded_by_surface(cloud, FLOOR, footprint + [0.0, 1.2, 0.0], 0.03)
    assert not nowhere.any()
