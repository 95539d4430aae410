"""Energy of clicks on four supervoxels without links."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.click_energy import ClickScene, Evidence, minimise
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.surface_graph import SurfaceGraph

RED, GREEN = (0.8, 0.2, 0.1), (0.1, 0.6, 0.2)


@pytest.mark.parametrize(("clicked", "remains"), [(GREEN, True), (RED, False)])
def test_a_click_beside_the_object_removes_only_its_own_colours(
    clicked: tuple[float, float, float], remains: bool
) -> None:
    """The first two supervoxels are red. The first one is clicked as part of the object, the third one as background.
    The second one is nearer to the third one, but it belongs to the object if the third one has another colour."""
    nothing = np.zeros(0, np.int32)
    alone = SplatGraph(4, nothing, nothing, np.zeros(0), np.zeros(0))
    zero, opposition = np.zeros(4), np.array([0.0, 2.0, 0.0, 0.0])
    colours, area = np.array([RED, RED, clicked, GREEN]), np.array([1.0, 1.0, 1.0, 9.0])
    cloud = GaussianCloud.from_numpy(
        np.zeros((1, 3)), np.eye(4)[:1], np.zeros((1, 3)), np.zeros(1), np.zeros((1, 1, 3)), device="cpu"
    )
    scene = ClickScene(SurfaceGraph.of(cloud), alone, alone, zero, zero, zero, zero, zero, colours, area)
    first, third = np.arange(4) == 0, np.arange(4) == 2
    far = np.array([0.0, 0.0, 0.0, 3.0])
    evidence = Evidence(first, third, far[:, None] * np.eye(5)[0], opposition, np.ones(4, bool))
    assert minimise(scene, evidence)[1] == remains
