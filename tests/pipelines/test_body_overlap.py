"""Relative places of two bodies at the start: distance of their boxes, depth of overlap, the body below, and thin
parts."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest

from egs_warp.assets.box import box_cloud
from egs_warp.contact.terrain import surface_above
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.body_overlap import boxes_overlap, column_below, depth, is_below, thin_part_note
from egs_warp.pipelines.prop import Prop, make_prop
from egs_warp.pipelines.world import World
from tests.support.scenes import blocks

pytestmark = pytest.mark.slow
"""The level set of a cube takes seconds."""


@cache
def cube() -> Prop:
    """Return a cube of 1 m on z = 0 above the origin. Its Gaussians extend up to 0.06 m beyond it on each side."""
    cloud = blocks(((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)))
    prop = make_prop(cloud, plane=Plane(np.array([0.0, 0.0, 1.0]), 0.0), metres_per_unit=1.0)
    # Turn the axes of the cube to those of the world.
    x, y = prop.frame.axes[:2, 0]
    return prop.moved((0.0, 0.0, 0.0), -float(np.degrees(np.arctan2(y, x))))


def test_the_depth_is_that_of_the_deepest_point_inside_the_other_body() -> None:
    for distance in (0.9, 0.8):
        other = cube().moved((distance, 0.0, 0.0), 0.0)
        found = depth(cube(), other)
        assert 1.0 - distance < found < 1.12 - distance
        assert depth(other, cube()) == pytest.approx(found, abs=1e-3)
    assert depth(cube(), cube().moved((1.2, 0.0, 0.0), 0.0)) == 0.0
    # The boxes of a turned cube and its neighbour overlap, but not the cubes: their corners pass each other.
    turned = cube().moved((1.15, 1.15, 0.0), 45.0)
    assert boxes_overlap(cube(), turned, 0.0) and depth(cube(), turned) == depth(turned, cube()) == 0.0


def test_boxes_are_close_within_the_margin() -> None:
    other = cube().moved((1.3, 0.0, 0.0), 0.0)
    assert not boxes_overlap(cube(), other, 0.1) and boxes_overlap(cube(), other, 0.3)


def test_a_body_stands_on_the_body_whose_top_is_at_its_base() -> None:
    assert is_below(cube(), cube().moved((0.3, 0.0, 1.02), 0.0))
    assert not is_below(cube(), cube().moved((0.3, 0.0, 1.2), 0.0)), "it is above"
    assert not is_below(cube(), cube().moved((1.3, 0.0, 1.02), 0.0)), "it is beside"
    assert not is_below(cube().moved((0.3, 0.0, 1.02), 0.0), cube())


def test_the_column_below_has_the_outline_of_the_top() -> None:
    column = column_below(cube(), 1.0, 0.05)
    assert surface_above((column,), np.array([0.4, 0.4, 0.0]), GROUND.normal) == pytest.approx(1.0, abs=1e-9)
    assert surface_above((column,), np.array([0.7, 0.0, 0.0]), GROUND.normal) < 1.0


def test_overlapping_bodies_are_refused() -> None:
    """A cube may be up to 0.005 of its height inside another one."""
    world = World()
    world.add(cube(), name="box")
    message = r"^king at \(0\.9\d*, .*\) overlaps box at \(.*\) by 0\.(0[7-9]|1)\d* m; move one of them$"
    with pytest.raises(UserError, match=message):
        world.add(cube(), at=(0.9, 0.0), name="king")
    world.add(cube(), at=(1.2, 0.0), name="king")
    assert [placed.name for placed in world.members] == ["box", "king"]


def test_a_long_part_that_the_level_set_does_not_resolve_is_named_with_its_place() -> None:
    def box(width: float, height: float) -> GaussianCloud:
        return box_cloud((width, width, height), lambda points: (0.5, 0.5, 0.5), spacing=min(width, 0.02), device="cpu")

    block, mast = box(0.5, 0.5), box(0.004, 0.5)
    mast.means.assign(mast.means.numpy() + np.array([0.0, 0.0, 0.5], np.float32))
    prop = make_prop(concatenate(block, mast), up="z").moved((2.0, 0.0, 0.0))
    note = thin_part_note("ship", prop)
    assert note is not None
    assert re.fullmatch(
        r"ship: a part of it, 0\.4[89] m long, is thinner than 0\.02 m; other bodies may pass through it at "
        r"2\.00,-?0\.00,0\.7\d",
        note,
    )
    assert thin_part_note("block", make_prop(block, up="z")) is None
    world = World()
    world.add(prop, name="ship")
    assert world.thin_parts == (), "it is alone"
    world.add(prop, at=(3.0, 0.0), name="copy")
    world.add(cube(), at=(-4.0, 0.0), name="box")
    assert len(world.thin_parts) == 1 and world.thin_parts[0].startswith("ship: a part of it"), "one note for copies"
