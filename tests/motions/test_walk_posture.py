"""Postures of walking bodies: the centre of mass and the feet reach their targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.motions.feet import Foot
from egs_warp.motions.sequence import Stance
from egs_warp.motions.walk_posture import (
    COUNTER_ROTATION,
    MAX_PIVOT,
    MAX_STEP_PER_LEG,
    LeggedPosture,
    RockingPosture,
    WalkPosture,
    rocking_reason,
    select_posture,
)
from tests.support.meshes import carved, coarse_stool, figure
from tests.support.stances import block_place


def carried(place: Stance) -> tuple[np.ndarray, tuple[Foot, ...], WalkPosture, np.ndarray]:
    """Return the standing nodes, the feet, the posture and the sole poses."""
    feet, kind = select_posture(place)
    standing = place.ground.local(place.standing)
    soles = np.array([standing[foot.sole].mean(axis=0) for foot in feet])
    return standing, feet, kind(place, feet), np.column_stack([soles, np.zeros(len(feet))])


@pytest.mark.parametrize("place", [block_place(), block_place(coarse_stool()), block_place(figure())])
def test_the_initial_posture_is_the_standing_body(place: Stance) -> None:
    standing, _, carriage, soles = carried(place)
    assert carriage.pose(place.body.centre_of_mass(standing), 0.0, soles) == pytest.approx(standing, abs=1e-12)


def test_legs_follow_their_feet() -> None:
    """While the body rotates, each sole moves rigidly to its target, and the centre of mass is at its target."""
    place = block_place(coarse_stool())
    standing, feet, carriage, soles = carried(place)
    assert isinstance(carriage, LeggedPosture) and len(feet) == 4
    assert carriage.step_limits.length == pytest.approx(MAX_STEP_PER_LEG * min(foot.length for foot in feet))
    com = place.body.centre_of_mass(standing) + [0.02, -0.01, 0.005]
    soles[0, :3] += [0.06, 0.0, 0.03]
    heading = 0.1
    pose = carriage.pose(com, heading, soles)
    assert place.body.centre_of_mass(pose) == pytest.approx(com, abs=1e-12)
    for foot, sole in zip(feet, soles, strict=True):
        assert pose[foot.sole].mean(axis=0) == pytest.approx(sole[:3], abs=1e-12)
    top = standing[:, 2] > 0.9 * standing[:, 2].max()
    arms, turned = (x[top] - x[top].mean(axis=0) for x in (standing, pose))
    angle = np.arctan2((arms[:, 0] * turned[:, 1] - arms[:, 1] * turned[:, 0]).sum(), (arms * turned)[:, :2].sum())
    assert angle == pytest.approx(heading, abs=0.02)


def test_a_base_rotates_and_tips_with_its_sides() -> None:
    """If one side of the base moves forward, the body rotates about the other side; if a side is lifted, the body tips.
    The centres of the sides are near their targets, and the centre of mass is at its target."""
    place = block_place()
    standing, feet, carriage, soles = carried(place)
    assert isinstance(carriage, RockingPosture) and len(feet) == 2
    width = float(soles[0, 1] - soles[1, 1])
    assert width > 0.2, "the left side comes first"
    assert (
        carriage.step_limits.length == pytest.approx(carriage.step_limits.turn * width)
        and carriage.capture_range == 0.0
    )
    rubber, wet, ice = (
        RockingPosture(replace(place, friction=friction), feet).step_limits for friction in (9.0, 0.02, 0.01)
    )
    assert rubber.turn == pytest.approx(0.5 * MAX_PIVOT)
    assert ice.turn == pytest.approx(0.5 * wet.turn) and ice.turn < 0.1 * rubber.turn, "friction turns it"
    com = place.body.centre_of_mass(standing) + [0.01, 0.03, 0.0]
    soles[0, 0] += 0.04
    soles[1, 2] += 0.01
    pose = carriage.pose(com, 0.0, soles)
    assert place.body.centre_of_mass(pose) == pytest.approx(com, abs=1e-3)
    for foot, sole in zip(feet, soles, strict=True):
        assert pose[foot.sole].mean(axis=0) == pytest.approx(sole[:3], abs=0.005)
    top = standing[:, 2] > 0.95 * standing[:, 2].max()
    back = Rotation.align_vectors(
        *(np.c_[(x[top] - x[top].mean(axis=0))[:, :2], np.zeros(top.sum())] for x in (pose, standing))
    )
    yaw, over = -0.04 / width, standing[top, 2].mean() / place.body.height
    assert back[0].as_rotvec()[2] == pytest.approx((1.0 - COUNTER_ROTATION * over) * yaw, rel=0.1), (
        "what is above turns back"
    )
    across = pose[feet[0].sole].mean(axis=0) - pose[feet[1].sole].mean(axis=0)
    assert np.arctan2(across[1], across[0]) - np.pi / 2 == pytest.approx(-0.04 / width, rel=0.1)
    assert across[2] / width == pytest.approx(-0.01 / width, rel=0.1)


def test_a_lying_body_has_no_feet() -> None:
    """A long bar on the ground has no feet. The base of a block is divided into two feet."""
    place = block_place()
    lying = replace(place, standing=place.standing[:, [2, 0, 1]] * [4.0, 0.3, 0.3])
    feet, _ = select_posture(replace(place, standing=place.standing))
    assert len(feet) == 2
    mesh = replace(place.body.mesh, nodes=lying.standing)
    bar = block_place(mesh)
    assert select_posture(bar)[0] == ()


def on_blocks(count: int, tall: float) -> TetMesh:
    """Return a slab on ``count`` square blocks that are 0.4 wide and ``tall`` high, two of them side by side in
    front."""
    places = [(0.4, -0.4), (0.4, 0.4), *([(-0.4, 0.0)] if count == 3 else [(-0.4, -0.4), (-0.4, 0.4)])]

    def keep(c: np.ndarray) -> np.ndarray:
        under = [(np.abs(c[:, 0] - x) < 0.2) & (np.abs(c[:, 1] - y) < 0.2) for x, y in places]
        return (c[:, 2] > tall) | np.any(under, axis=0)

    return carved((1.2, 1.2, tall + 0.4), 0.1, keep)


@pytest.mark.parametrize(("count", "tall", "swings"), [(3, 0.3, False), (3, 0.6, True), (4, 0.3, True)])
def test_a_stump_is_no_leg_of_few_feet(count: int, tall: float, swings: bool) -> None:
    """A leg that is wider than it is long cannot reach the capture point, so a body on three such legs does not swing
    them. A body with four or more feet is supported by the other feet."""
    assert (select_posture(block_place(on_blocks(count, tall)))[1] is LeggedPosture) is swings


def test_the_reason_for_waddling_names_the_shortest_leg_or_the_base() -> None:
    """The body is 0.7 high, and its blocks are 0.3 high and 0.4 wide. A leg ends at the last layer of nodes below the
    slab, at a height of 0.2."""
    stumps = block_place(on_blocks(3, 0.3))
    assert rocking_reason(stumps) == "a leg is 0.29 body heights long; to swing, it would have to be at least 0.57"
    assert rocking_reason(block_place()) == "it stands on one base, without separate legs"
