"""Detection of the feet of simple bodies, and slip, displacement and landings of feet in a trajectory."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.body import make_body
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import find_feet, foot_of_node, no_slip_feet, order_counterclockwise, split_base
from egs_warp.motions.footfalls import footfalls
from tests.support.meshes import block_mesh, figure, stool

STOOL = stool()
FEET = find_feet(STOOL, STOOL.nodes[:, 2], 0.8)


def test_a_stool_has_four_feet_with_their_legs() -> None:
    """Each foot is one corner of the base; its leg extends up to the seat, with weights that decrease upwards."""
    corners = {tuple(np.sign(STOOL.nodes[foot.sole, :2].mean(axis=0)).astype(int)) for foot in FEET}
    assert corners == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    for foot in FEET:
        assert np.all(STOOL.nodes[foot.sole, 2] == 0.0) and np.all(foot.leg[foot.sole] == 1.0)
        assert foot.length == pytest.approx(0.6, abs=0.11)
        along = np.flatnonzero(foot.leg)
        assert np.all(np.sign(STOOL.nodes[along, :2]) == np.sign(STOOL.nodes[foot.sole, :2].mean(axis=0)))
        order = along[np.argsort(STOOL.nodes[along, 2])]
        assert np.all(np.diff(foot.leg[order]) <= 1e-12)
    assert np.all(np.sum([foot.leg > 0 for foot in FEET], axis=0) <= 1)


def test_feet_are_named_around_the_body() -> None:
    """The numbering is counterclockwise seen from above, so that every other foot is opposite."""
    order = order_counterclockwise(np.array([STOOL.nodes[foot.sole, :2].mean(axis=0) for foot in FEET]))
    centres = [STOOL.nodes[FEET[index].sole, :2].mean(axis=0) for index in order]
    turns = [np.cross([*a, 0.0], [*b, 0.0])[2] for a, b in zip(centres, [*centres[1:], centres[0]], strict=True)]
    assert min(turns) > 0.0
    assert np.allclose(centres[0], -centres[2], atol=1e-12) and np.allclose(centres[1], -centres[3], atol=1e-12)


@pytest.mark.parametrize(("mesh", "height", "count"), [(block_mesh(), 1.0, 1), (figure(), 1.4, 2)])
def test_other_bodies_have_other_numbers_of_feet(mesh: TetMesh, height: float, count: int) -> None:
    assert len(find_feet(mesh, mesh.nodes[:, 2], height)) == count


def test_a_base_has_a_left_and_a_right_side() -> None:
    """The base is divided into two feet with a gap between them. The weights of the nodes above a foot decrease
    sideways and upwards."""
    mesh = block_mesh(5, 5, 5)
    heights, sole = mesh.nodes[:, 2], np.flatnonzero(mesh.nodes[:, 2] == 0.0)
    left, right = split_base(mesh.nodes[:, :2], heights, sole, 1.0)
    assert mesh.nodes[left.sole, 1].min() > 0.02 and mesh.nodes[right.sole, 1].max() < -0.02
    assert len(left.sole) == len(right.sole) and set(left.sole) | set(right.sole) <= set(sole)
    assert np.all(left.leg[left.sole] > 0.5) and np.all(left.leg[right.sole] < 0.5)
    assert np.all(left.leg[heights >= 0.3] == 0.0)
    low = heights == 0.0
    assert np.allclose((left.leg + right.leg)[low], 1.0)


def made_trajectory() -> Trajectory:
    """Return six steps of a stool of 100 kg. Foot 0 slides by 1 mm per step under load for three steps, swings by 50 mm
    in one, and stands still for two.
    """
    strides = np.array([0.0, 0.001, 0.001, 0.001, 0.05, 0.0, 0.0]).cumsum()
    leg = FEET[0].leg[:, None] > 0
    positions = STOOL.nodes + strides[:, None, None] * leg * [1.0, 0.0, 0.0]
    loaded = [0, 1, 2, 4, 5]
    return cast(
        Trajectory,
        SimpleNamespace(
            time=np.arange(7) / 60.0,
            positions=positions,
            node_mass=np.full(len(STOOL.nodes), 100.0 / len(STOOL.nodes)),
            gravity=np.array([0.0, 0.0, -10.0]),
            contact_step=np.array(loaded),
            contact_nodes=np.full((5, 4), FEET[0].sole[0]),
            contact_weights=np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
            contact_normal=np.tile([0.0, 0.0, 1.0], (5, 1)),
            contact_force=np.tile([0.0, 0.0, 250.0], (5, 1)),
            contact_plane=np.zeros(5, int),
            world_index=0,
        ),
    )


def test_slip_is_the_path_of_loaded_contacts_without_swings() -> None:
    """The loaded foot slips by 3 mm in three steps. The shift of its sole is measured from the end of the first loaded
    step, so it is 2 mm. Both values are divided by the stride of 0.1 m. There is one landing."""
    assert foot_of_node(FEET)[FEET[0].sole[0]] == 0
    fell = footfalls(made_trajectory(), FEET, stride=0.1)
    assert (fell.slip, fell.sole_shift) == (pytest.approx(0.03), pytest.approx(0.02))
    assert fell.landings == 1
    later = footfalls(made_trajectory(), FEET, stride=0.1, first=3)
    nowhere = footfalls(made_trajectory(), FEET, stride=0.0)
    assert (nowhere.slip, nowhere.sole_shift, nowhere.landings) == (0.0, 0.0, fell.landings), "walk 0 ends in a report"
    assert (later.slip, later.sole_shift, later.landings) == (0.0, 0.0, 1)


def test_only_the_ground_and_bodies_below_support_a_foot() -> None:
    """Contacts of the foot with its own body, and with another body at its side, are no stance."""
    t = made_trajectory()
    t.contact_plane[:] = -1
    own = footfalls(t, FEET, stride=0.1)
    t.contact_plane[:] = -2
    below = footfalls(t, FEET, stride=0.1)
    t.contact_normal[:] = t.contact_force[:] = [250.0, 0.0, 0.0]
    beside = footfalls(t, FEET, stride=0.1)
    assert [each.landings for each in (own, below, beside)] == [0, 1, 0]
    assert (own.slip, below.slip, beside.slip) == (0.0, pytest.approx(0.03), 0.0)


def test_a_foot_may_turn_about_its_centre_of_pressure_but_not_slide() -> None:
    """The objective of a foot is zero sliding velocity at its centre of pressure. Its weight is proportional to the
    load below a tenth of the body weight; a foot without load has no objective."""
    body = make_body(STOOL, Plane(np.array([0.0, 0.0, 1.0]), 0.0))
    soles = [foot.sole for foot in FEET]
    nodes = np.concatenate(soles[:2])
    shares = np.random.default_rng(3).uniform(0.5, 1.0, len(nodes))
    own = np.repeat([0, 1], [len(sole) for sole in soles[:2]])
    loads = shares / np.bincount(own, shares)[own] * np.array([0.6, 0.05])[own]
    one_node = np.zeros((len(nodes), 4))
    one_node[:, 0] = 1.0
    contacts = cast(ContactSet, SimpleNamespace(nodes=np.repeat(nodes[:, None], 4, 1), weights=one_node))
    contacts.__dict__["nearest_nodes"] = nodes
    held = no_slip_feet(body, FEET, contacts, loads, np.eye(3)[:2], 100.0)
    assert [one.weight for one in held] == [pytest.approx(100.0), pytest.approx(50.0)]
    for index, objective in enumerate(held):
        mine = own == index
        pressure = loads[mine] @ STOOL.nodes[nodes[mine]] / loads[mine].sum()
        turning = np.cross([0.0, 0.0, 1.0], STOOL.nodes - pressure)
        assert np.allclose(objective.rows @ turning.ravel(), 0.0, atol=1e-12)
        assert np.allclose(objective.rows @ np.tile([0.3, -0.2, 5.0], len(STOOL.nodes)), [0.3, -0.2])
