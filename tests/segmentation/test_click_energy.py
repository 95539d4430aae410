"""Energy of clicks on four supervoxels without links."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.click_energy import ClickScene, Evidence, minimise
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.surface_graph import SurfaceGraph

Colour = tuple[float, float, float]
RED, GREEN, BLUE = (0.8, 0.2, 0.1), (0.1, 0.6, 0.2), (0.1, 0.2, 0.7)


def chosen_of(
    colours: list[Colour], area: list[float], distance: list[float], *, others: int | None = None, opposed: float = 0.0
) -> np.ndarray:
    """Return the mask (4,) bool of the object with a click on the first supervoxel. ``distance`` is the first factor of
    ``EnergyWeights.nodes``. A click beside the object hits the supervoxel ``others`` and opposes the second one by
    ``opposed``."""
    nothing = np.zeros(0, np.int32)
    alone = SplatGraph(4, nothing, nothing, np.zeros(0), np.zeros(0))
    zero, opposition = np.zeros(4), np.array([0.0, opposed, 0.0, 0.0])
    cloud = GaussianCloud.from_numpy(
        np.zeros((1, 3)), np.eye(4)[:1], np.zeros((1, 3)), np.zeros(1), np.zeros((1, 1, 3)), device="cpu"
    )
    surface = SurfaceGraph.of(cloud)
    scene = ClickScene(surface, alone, alone, zero, zero, zero, zero, zero, np.array(colours), np.array(area))
    features = np.outer(distance, np.eye(5)[0])
    included, excluded = np.arange(4) == 0, np.arange(4) == others
    return minimise(scene, Evidence(included, excluded, features, opposition, np.ones(4, bool)))


@pytest.mark.parametrize(("clicked", "remains"), [(GREEN, True), (RED, False)])
def test_a_click_beside_the_object_removes_only_its_own_colours(clicked: Colour, remains: bool) -> None:
    """The first two supervoxels are red. The first one is clicked as part of the object, the third one as background.
    The second one is nearer to the third one, but it belongs to the object if the third one has another colour."""
    colours, area = [RED, RED, clicked, GREEN], [1.0, 1.0, 1.0, 9.0]
    assert chosen_of(colours, area, [0.0, 0.0, 0.0, 3.0], others=2, opposed=2.0)[1] == remains


@pytest.mark.parametrize(("far", "belongs"), [(BLUE, True), (RED, False)])
def test_a_colour_is_evidence_unless_it_is_common_around_the_object(far: Colour, belongs: bool) -> None:
    """The small second supervoxel is rather far from the click. It belongs to the object, which is red like it, unless
    the far surroundings are also red."""
    chosen = chosen_of([RED, RED, far, GREEN], [4.0, 1.0, 4.0, 9.0], [0.0, 1.2, 3.0, 3.0])
    assert chosen[1] == belongs and not chosen[2:].any()
