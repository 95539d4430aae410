"""World of one scene: an object that stands on another one starts at rest on its flat top."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from egs_warp.assets import pawn
from egs_warp.geometry.gaussians import GaussianCloud, concatenate, with_degree
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.creature import Creature, CreatureOptions, initial_stance, make_creature
from egs_warp.pipelines.locate_plane import LocatedPlane
from egs_warp.pipelines.prepare_objects import PreparedObjects
from egs_warp.pipelines.prepare_scene import PreparedScene
from egs_warp.pipelines.scene_world import SceneBody, SceneWorldOptions, make_scene_world
from egs_warp.segmentation.object_spec import Segmentation
from tests.support.scenes import blocks, round_ones

UP = np.array([0.0, 0.0, 1.0])
TOP, GROUND = Plane(UP, 0.0), Plane(UP, 0.4)


def rough_block() -> GaussianCloud:
    """Return a block of height 0.4 below z = 0, whose top has the relief of a capture: noise of 3 mm, Gaussians that
    reach 0.06 above it, and a fragment on each side of the middle 0.1 above it."""
    block = blocks(((-0.6, -0.6, -0.4), (0.6, 0.6, 0.0)))
    means = block.means.numpy()
    on_top = means[:, 2] > -0.01
    means[on_top, 2] += np.random.default_rng(0).normal(0.0, 0.003, int(on_top.sum()))
    fragments = round_ones(np.array([[0.1, 0.0, 0.1], [-0.1, 0.05, 0.1]]), 0.005)
    return concatenate(replace(block, means=wp.array(means, dtype=wp.vec3)), fragments)


@pytest.mark.slow
def test_an_object_starts_as_captured_on_the_flat_top_of_another_one() -> None:
    none = np.zeros(1, bool)
    thing = with_degree(pawn(gaussian_count=3000, device="cpu").cloud, 0)
    size = float(thing.means.numpy()[:, 2].max())
    scenes, planes = {}, {"pawn": TOP, "block": GROUND}
    for name, cloud in (("pawn", thing), ("block", rough_block())):
        middle = cloud.means.numpy().astype(np.float64).mean(axis=0)
        located = LocatedPlane(planes[name], None, middle, size, Segmentation(none, none, none, 1.0), ())
        scenes[name] = PreparedScene(cloud, thing, thing, planes[name], None, located, ())
    prepared = PreparedObjects(scenes, planes, ())
    bodies = {"pawn": SceneBody(nodes=50), "block": SceneBody(is_prop=True)}
    world = make_scene_world(prepared, bodies, options=SceneWorldOptions(1.0, measures_obstacles=False)).world
    placed = world.member("pawn").body
    assert isinstance(placed, Creature) and placed.support is not None
    level = make_creature(thing, plane=TOP, options=CreatureOptions(metres_per_unit=1.0, nodes=50))
    captured = level.frame.capture_points(level.mesh.nodes)
    now = placed.frame.capture_points(placed.start.positions)
    assert np.abs(now - captured).max() < 0.01 * size
    stance = initial_stance(placed)
    assert stance.ground.surface_normal[2] > np.cos(np.radians(1.0))
    np.testing.assert_allclose(stance.contact_points[:, 2], 0.4, atol=0.012)
    extents = [np.ptp(one.ground.local(one.contact_points)[:, :2], axis=0) for one in (stance, initial_stance(level))]
    assert (extents[0] > 0.7 * extents[1]).all()
