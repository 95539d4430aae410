"""Level sets of captured bodies."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.gaussians import concatenate
from egs_warp.pipelines.captured_body import CapturedShape
from tests.support.clouds import surface_cloud
from tests.support.meshes import box_mesh


@pytest.mark.parametrize("height", [1.6, 1.06])
def test_a_detached_fragment_does_not_move_the_surface(height: float) -> None:
    """The fragment floats above the top of a box 1 m tall, the lower one inside the lattice of the level set."""
    body = surface_cloud(box_mesh((4, 4, 8), (0.5, 0.5, 1.0)), 6000, scale=0.02)
    fragment = surface_cloud(box_mesh((1, 1, 1), (0.02, 0.02, 0.001)), 3, lowest=height, scale=0.003)
    points = [cloud.means.numpy().astype(float) for cloud in (body, fragment)]
    alone = CapturedShape(body, points[0]).level_set
    both = CapturedShape(concatenate(body, fragment), np.concatenate(points)).level_set
    values = alone.evaluate(points[0])[0]
    assert np.abs(values).mean() < 0.001
    np.testing.assert_allclose(both.evaluate(points[0])[0], values, atol=1e-4)
