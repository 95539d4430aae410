"""Warning about a body that ends outside the captured ground."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from egs_warp.contact.terrain import Solid
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.height_field import HeightField
from egs_warp.motions.planned_legs import Leg
from egs_warp.pipelines.ground_coverage import (
    ground_coverage_warning,
    ground_edge_note,
    overhang_note,
    planned_end_note,
    share_over_ground,
)
from tests.support.grounds import level
from tests.support.scenes import lying
from tests.support.stances import block_place

FLAT = Solid((GROUND,))
TABLE = lying(np.concatenate([level((-1.0, -1.0), (1.0, 1.0), 0.0, 0.03), level((1.0, -1.0), (4.0, 1.0), -0.6, 0.03)]))


def box(x: float, lift: float = 0.0) -> np.ndarray:
    """Return the nodes (n, 3) of a box of one unit that stands at ``x``."""
    corners = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 5)] * 2, np.linspace(0.0, 1.0, 6)), axis=-1)
    return corners.reshape(-1, 3) + [x, 0.0, lift]


@pytest.mark.parametrize(("x", "share"), [(0.0, 1.0), (0.99, 0.6), (1.6, 0.0)])
def test_fraction_of_the_feet_over_ground(x: float, share: float) -> None:
    """The box is on the table, over the table's edge with three of the five columns of its nodes on the table, or
    beyond the table, over a floor far below."""
    assert share_over_ground(box(x), TABLE, FLAT, 1.0) == pytest.approx(share)


def test_messages() -> None:
    assert (
        ground_coverage_warning(box(0.0), TABLE, FLAT, 1.0)
        == ground_coverage_warning(box(0.99), TABLE, FLAT, 1.0)
        == ()
    )
    (line,) = ground_coverage_warning(box(1.6), TABLE, FLAT, 1.0)
    assert line.startswith("it ends beyond the edge of the captured ground, in the air; choose a shorter distance")
    # A body in the air at the end, or without a scene, causes no warning; a scene without ground does.
    assert (
        ground_coverage_warning(box(1.6, 0.3), TABLE, FLAT, 1.0)
        == ground_coverage_warning(box(1.6), None, FLAT, 1.0)
        == ()
    )
    above = lying(level((-1.0, -1.0), (1.0, 1.0), 0.5, 0.03))
    assert len(ground_coverage_warning(box(0.0), above, FLAT, 1.0)) == 1


def test_a_partial_overhang_has_a_note() -> None:
    """Two of the five columns of nodes are beyond the edge; a body inside, or wholly outside, has no such note."""
    (line,) = overhang_note(box(0.99), TABLE, FLAT, 1.0)
    assert line.startswith("at the end, 40 % of its soles are beyond the edge of the captured ground")
    assert overhang_note(box(0.0), TABLE, FLAT, 1.0) == overhang_note(box(1.6), TABLE, FLAT, 1.0) == ()


@pytest.mark.parametrize(("x", "share"), [(1.6, 1.0), (1.8, 0.6), (2.5, 0.0)])
def test_the_ground_that_the_body_hid_counts_as_captured(x: float, share: float) -> None:
    """The box stands at x = 1.6 at the start, where no ground was captured, and stays there or moves away."""
    assert share_over_ground(box(x), TABLE, FLAT, 1.0, start=box(1.6)) == pytest.approx(share)


def test_coverage_on_uneven_ground() -> None:
    """The ground is a slope, on which body and splats are higher to the right."""
    heights = np.tile(0.2 * np.linspace(-2.0, 2.0, 41), (41, 1))
    field = HeightField.through(np.eye(3), np.array([-2.0, -2.0, 0.0]), 0.1, heights)
    points = level((-2.0, -1.0), (1.0, 1.0), 0.0, 0.03)
    points[:, 2] = 0.2 * points[:, 0]
    for x, share in ((0.5, 1.0), (1.6, 0.0)):
        nodes = box(x)
        nodes[:, 2] += 0.2 * nodes[:, 0]
        assert share_over_ground(nodes, lying(points), field, 1.0) == pytest.approx(share)


@pytest.mark.parametrize("slope", [0.0, -0.3, 0.3])
def test_a_displacement_beyond_the_edge_is_noted_in_advance(slope: float) -> None:
    """The captured ground ends at x = 1. The second leg goes from 0.5 to 1.7, and nine tenths of the soles are
    on the ground up to about 0.8. The ground is level, or falls or rises ahead of the body."""
    heights = np.tile(slope * np.linspace(-2.0, 2.0, 41)[:, None], (1, 41))
    field = HeightField.through(np.eye(3), np.array([-2.0, -2.0, 0.0]), 0.1, heights)
    points = level((-1.0, -1.0), (1.0, 1.0), 0.0, 0.03)
    points[:, 2] = field.ground_height(points)
    stance = block_place()
    nodes = stance.standing.copy()
    nodes[:, 2] += field.ground_height(nodes)
    stance = replace(stance, standing=nodes)
    legs = [
        Leg("walk", np.zeros(2), np.array([0.5, 0.0]), 0.0),
        Leg("walk to", np.array([0.5, 0.0]), np.array([1.2, 0.0]), 0.0),
    ]
    ground = FLAT if slope == 0.0 else field
    assert planned_end_note(legs[:1], stance, lying(points), ground) == ()
    assert planned_end_note(legs, stance, None, ground) == ()
    (note,) = planned_end_note(legs, stance, lying(points), ground)
    assert note.startswith("'walk to' would end beyond the edge of the captured ground, in the air: at most ")
    assert 0.2 <= float(note.split("at most ")[1].split()[0]) <= 0.4
    (note,) = planned_end_note([replace(legs[1], step=np.array([0.45, 0.0]))], stance, lying(points), ground)
    assert re.match(
        r"'walk to' would end with [1-4]\d % of the soles beyond the edge of the captured ground: at ", note
    )


@pytest.mark.parametrize(
    ("x", "note"),
    [(0.0, ()), (0.9, "beside 5"), (1.6, "beside 100 %")],
)
def test_an_object_over_an_edge_of_the_ground_is_noted(x: float, note: str | tuple[()]) -> None:
    """The box stands in the middle of the table, with a fourth of its foot over the edge, or beyond the table."""
    scene = TABLE.subset(TABLE.means.numpy()[:, 2] > -0.1)
    found = ground_edge_note(box(x), scene, GROUND)
    if isinstance(note, tuple):
        assert found == note
    else:
        assert found[0].startswith(note) and "no ground was captured at its level" in found[0]


@pytest.mark.parametrize(("x", "is_noted"), [(0.0, False), (1.6, True)])
def test_the_ground_of_faint_captures_is_found(x: float, is_noted: bool) -> None:
    """The table consists of many faint Gaussians; only a few stray ones, in one corner, are opaque."""
    scene = TABLE.subset(TABLE.means.numpy()[:, 2] > -0.1)
    logits = np.full(scene.count, -3.0, np.float32)
    logits[:5] = 2.0
    faint = replace(scene, opacity_logits=wp.array(logits, dtype=wp.float32))
    assert bool(ground_edge_note(box(x), faint, GROUND)) == is_noted


@pytest.mark.parametrize(("side", "is_noted"), [(3.0, False), (0.6, True)])
def test_the_rim_of_a_flat_object_is_as_wide_as_its_foot_requires(side: float, is_noted: bool) -> None:
    """A plate is 1 wide and 0.1 high. The ground within 0.1 of it was removed together with it; the table is large, or
    ends just beyond the rim."""
    plate = box(0.0) * [2.5, 2.5, 0.1]
    table = level((-side, -side), (side, side), 0.0, 0.03)
    rest = table[np.abs(table[:, :2]).max(axis=1) > 0.6 - 1e-9]
    far = level((4.0, 4.0), (5.0, 5.0), 0.0, 0.03)
    scene = lying(np.concatenate([rest, far]) if side > 0.6 else far)
    assert bool(ground_edge_note(plate, scene, GROUND)) == is_noted
