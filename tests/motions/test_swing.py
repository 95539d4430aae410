"""Swings of waving parts: travel of the tip, and parts that keep clear of the body and the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.motions.body_parts import FreeBranch
from egs_warp.motions.follow import shape_parts
from egs_warp.motions.sequence import Stance
from egs_warp.motions.swing import MAX_ANGLE, TRAVEL, Swing, find_swing
from tests.support.meshes import carved, figure
from tests.support.stances import standing_stance


def ends(stance: Stance, branch: FreeBranch, swing: Swing) -> np.ndarray:
    """Return the positions (2, k, 3) of the part at both ends of the swing, ground axes, body heights."""
    points = stance.ground.local(stance.standing[branch.nodes]) / stance.body.height
    away = np.linalg.norm(points - stance.ground.local(branch.root[None]) / stance.body.height, axis=1)
    joint = points[away <= np.quantile(away, 0.25)].mean(axis=0)
    turns = [Rotation.from_rotvec(angle * swing.axis, degrees=True) for angle in (swing.low, swing.degrees)]
    return np.array([joint + turn.apply(points - joint) for turn in turns])


def test_the_tip_of_an_arm_travels_in_the_picture() -> None:
    """The travel is orthogonal to the view direction: the picture shows at least 0.8 of it. An arm is raised above its
    joint, and swings there."""
    stance = standing_stance(figure())
    for branch in shape_parts(stance).branches:
        swing = find_swing(stance, branch, 0.0)
        low, high = ends(stance, branch, swing)
        moved = (high - low)[np.argmax(np.linalg.norm(high - low, axis=1))]
        assert swing.travel == pytest.approx(TRAVEL, abs=0.01)
        assert np.linalg.norm(moved) == pytest.approx(TRAVEL, rel=0.1)
        view = stance.view()
        assert np.linalg.norm(moved - (moved @ view) * view) > 0.8 * np.linalg.norm(moved)
        rest, _ = ends(stance, branch, replace(swing, low=0.0))
        tip = np.argmax(np.linalg.norm(high - low, axis=1))
        assert low[tip, 2] - rest[tip, 2] > 0.3 * swing.arm
        assert high[tip, 2] - rest[tip, 2] > 0.6 * swing.arm


def test_the_camera_decides_between_swings_of_equal_size() -> None:
    """Seen from above, an arm swings along the ground."""
    stance = replace(standing_stance(figure()), seen_from=np.array([0.0, 0.0, 1.0]))
    branch = shape_parts(stance).branches[0]
    low, high = ends(stance, branch, find_swing(stance, branch, 0.0))
    moved = (high - low)[np.argmax(np.linalg.norm(high - low, axis=1))]
    assert abs(moved[2]) < 0.5 * np.linalg.norm(moved)


def test_a_part_that_has_little_room_swings_to_the_clear_side() -> None:
    """A bar sticks out of a wall, just above the ground and just below a ledge. It swings to the side."""

    def keep(c: np.ndarray) -> np.ndarray:
        x, y, z = c.T
        is_bar = (np.abs(y) < 0.1) & (z > 0.1) & (z < 0.3)
        return (x < -0.2) | is_bar | (z > 0.5)

    stance = standing_stance(carved((0.8, 1.0, 1.0), 0.1, keep))
    x, _, z = stance.body.mesh.nodes.T
    nodes = np.flatnonzero((x > -0.15) & (z > 0.05) & (z < 0.35))
    branch = FreeBranch(nodes, np.array([-0.2, 0.0, 0.2]), 1, is_on_trunk=True)
    swing = find_swing(stance, branch, 0.0)
    assert abs(swing.axis[2]) > 0.8, "about the up axis"
    _, high = ends(stance, branch, swing)
    assert high[:, 2].min() > 0.0


def test_an_angle_that_is_given_is_kept() -> None:
    stance = standing_stance(figure())
    branch = shape_parts(stance).branches[0]
    assert find_swing(stance, branch, 20.0).degrees == 20.0
    swing = find_swing(stance, branch, MAX_ANGLE)
    assert swing.degrees == MAX_ANGLE
    offsets = (stance.standing[branch.nodes] - swing.joint) @ stance.ground.axes.T / stance.body.height
    tip = offsets[np.argmax(np.linalg.norm(offsets, axis=1))]
    high = Rotation.from_rotvec(swing.degrees * swing.axis, degrees=True).apply(tip)
    assert swing.rise == pytest.approx(high[2]), "also if the part is not clear of the rest at this angle"
