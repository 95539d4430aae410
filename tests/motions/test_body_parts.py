"""Detection of heads and branches of simple bodies."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.motions.body_parts import (
    ShapeParts,
    _free_parts,  # pyright: ignore[reportPrivateUsage]
    _trunk,  # pyright: ignore[reportPrivateUsage]
    find_shape_parts,
)
from egs_warp.motions.follow import head_note, parts_of_body
from egs_warp.muscles.skeleton import Branch, Skeleton
from tests.support.meshes import UP, carved, column, figure, figure_with_tool, rabbit, stool
from tests.support.stances import standing_stance


def doll() -> TetMesh:
    """Create a block with a narrow neck and a head of half the height."""

    def keep(c: np.ndarray) -> np.ndarray:
        across, z = np.abs(c[:, :2]).max(axis=1), c[:, 2]
        return ((z < 0.5) & (across < 0.3)) | ((z < 0.7) & (across < 0.1)) | ((z > 0.7) & (across < 0.4))

    return carved((0.8, 0.8, 1.4), 0.1, keep)


def parts_of(mesh: TetMesh) -> ShapeParts:
    return find_shape_parts(mesh, np.ones(len(mesh.nodes)), UP)


def test_a_big_head_is_a_part_as_a_whole() -> None:
    """The head is the whole part above the neck and not only the topmost 0.15 of the height, so that a key frame for
    the head does not crush it."""
    mesh = doll()
    head = parts_of(mesh).head
    assert head is not None
    above = np.flatnonzero(mesh.nodes[:, 2] > 0.75)
    assert np.isin(above, head).all() and mesh.nodes[head, 2].min() > 0.55
    parts = {part.name: part for part in parts_of_body(standing_stance(mesh))}
    assert list(parts) == ["body", "base", "head", "foot"]
    np.testing.assert_array_equal(parts["head"].nodes, head)


def test_a_head_has_its_ears() -> None:
    """Both ears end above the head and belong to it; they are also branches."""
    mesh = rabbit()
    parts = parts_of(mesh)
    assert parts.head is not None
    tips = np.flatnonzero(mesh.nodes[:, 2] > 1.2)
    assert set(np.sign(mesh.nodes[tips, 0])) == {-1.0, 1.0}
    assert np.isin(tips, parts.head).all() and mesh.nodes[parts.head, 2].min() > 0.5
    assert [branch.is_on_trunk for branch in parts.branches] == [False, False]
    ears = [mesh.nodes[branch.nodes] for branch in parts.branches]
    assert {tuple(set(np.sign(ear[:, 0]))) for ear in ears} == {(-1.0,), (1.0,)}
    assert min(ear[:, 2].min() for ear in ears) > 0.9


def test_an_arm_and_the_tool_that_it_holds_are_one_branch() -> None:
    mesh = figure_with_tool()
    left, right = (min(parts_of(mesh).branches, key=lambda b, s=s: s * mesh.nodes[b.nodes, 0].mean()) for s in (1, -1))
    tool = np.flatnonzero((mesh.nodes[:, 0] > 0.65) & (np.abs(mesh.nodes[:, 2] - 0.9) > 0.15))
    assert right.is_on_trunk and left.is_on_trunk and right.tip_count == 2 and np.isin(tool, right.nodes).all()
    assert left.tip_count == 1 and mesh.nodes[left.nodes, 0].max() < -0.2
    assert np.allclose(right.root, [0.0, 0.0, 0.95], atol=0.1) and np.array_equal(right.root, left.root)


def test_arms_are_branches_from_left_to_right() -> None:
    """Branches are numbered counterclockwise, seen from above, from straight ahead (+y), so the left arm comes
    first."""
    stance = standing_stance(figure())
    arms = [part for part in parts_of_body(stance) if part.name.startswith("branch")]
    assert [part.name for part in arms] == ["branch 1", "branch 2"]
    left, right = (stance.standing[part.nodes] for part in arms)
    assert left[:, 0].max() < -0.2 and right[:, 0].min() > 0.2
    assert min(left[:, 2].min(), right[:, 2].min()) > 0.7


def test_a_raised_arm_is_not_the_head() -> None:
    """The trunk ends higher and is thicker at its top than the arm, which remains a branch."""

    def keep(c: np.ndarray) -> np.ndarray:
        (x, z), across = (c[:, 0], c[:, 2]), np.abs(c[:, 0])
        legs = (z < 0.5) & (across > 0.1) & (across < 0.3)
        arms = ((z > 0.8) & (z < 1.0)) | ((x > 0.6) & (z > 0.8) & (z < 1.2))
        return legs | ((z > 0.5) & (across < 0.3)) | arms

    mesh = carved((1.6, 0.2, 1.4), 0.1, keep)
    parts = parts_of(mesh)
    assert parts.head is None
    ends = [mesh.nodes[branch.nodes] for branch in parts.branches]
    assert any(end[:, 0].min() > 0.2 and end[:, 2].max() > 1.15 for end in ends)


@pytest.mark.parametrize("reach", [1.0, 1.6])
def test_a_raised_arm_that_ends_above_a_trunk_without_a_head_is_a_branch(reach: float) -> None:
    """If no arm ends higher, the highest part is the top of the trunk, which is not a branch."""

    def keep(c: np.ndarray) -> np.ndarray:
        (x, z), across = (c[:, 0], c[:, 2]), np.abs(c[:, 0])
        legs = (z < 0.5) & (across > 0.1) & (across < 0.3)
        arms = ((z > 0.8) & (z < 1.0)) | ((x > 0.6) & (z > 0.8) & (z < reach))
        return legs | ((z > 0.5) & (z < 1.4) & (across < 0.3)) | arms

    mesh = carved((1.6, 0.2, 1.6), 0.1, keep)
    parts = parts_of(mesh)
    assert parts.head is None
    ends = [mesh.nodes[branch.nodes] for branch in parts.branches]
    assert any(end[:, 0].min() > 0.2 and end[:, 2].max() > reach - 0.05 for end in ends)
    assert reach > 1.4 or all(end[:, 2].max() < 1.15 for end in ends)


def with_raised_arm() -> TetMesh:
    """Create a block with a head at x < 0 and a longer arm at x > 0, which ends higher. They touch, so that the
    skeleton has one branch."""

    def keep(c: np.ndarray) -> np.ndarray:
        x, z = c[:, 0], c[:, 2]
        trunk, head = (z < 1.0) & (np.abs(x) < 0.5), (x < 0.0) & (x > -0.4) & (z < 1.3)
        arm = (x > 0.0) & (x < 0.9) & (z > 1.0) & (z < 1.1)
        hand = (x > 0.3) & (x < 0.9) & (z > 0.9) & (z < 1.4)
        return trunk | head | arm | hand

    return carved((1.8, 0.4, 1.6), 0.1, keep)


def test_of_two_tops_the_compact_one_near_the_axis_is_the_head() -> None:
    """The head, at x < 0, is lower and lighter than the arm, and touches it. The arm is a branch and may be a rival."""
    stance = standing_stance(with_raised_arm())
    parts = {part.name: part for part in parts_of_body(stance)}
    head, arm = (stance.standing[parts[name].nodes] for name in ("head", "branch 1"))
    assert head[:, 0].max() < 0.25 and head[:, 2].max() > 1.25 and head[:, 2].min() > 0.8
    assert arm[:, 0].min() > 0.25 and arm[:, 2].max() > 1.35
    note = head_note(stance, list(parts.values()))
    assert note is not None and note.startswith("the head is taken to be the part 0.00 ") and "not branch 1 (" in note
    assert note.endswith("to move that instead, give branch=1")


def test_a_head_without_a_neck_is_what_sticks_out_at_the_top() -> None:
    """A post above the middle of a block, as long as a neck with a head, is the head as a whole. A post on one side is
    an ear: the head is the top of the body."""
    lowest = []
    for side in (0.0, 0.3):

        def keep(c: np.ndarray, side: float = side) -> np.ndarray:
            return (c[:, 2] < 0.6) | ((np.abs(c[:, 0] - side) < 0.1) & (np.abs(c[:, 1]) < 0.1))

        stance = standing_stance(carved((0.8, 0.4, 1.2), 0.1, keep))
        (head,) = (part for part in parts_of_body(stance) if part.name == "head")
        lowest.append(float(stance.standing[head.nodes, 2].min()))
    assert lowest[0] < 0.75 and lowest[1] > 1.2 - 0.15 * 1.2 - 1e-9


@pytest.mark.parametrize("make", [column, figure, figure_with_tool, rabbit, stool])
def test_there_is_no_note_about_a_clear_head(make: Callable[[], TetMesh]) -> None:
    """Arms and tails that end below the head are no rivals, and ears belong to the head."""
    stance = standing_stance(make())
    assert head_note(stance, parts_of_body(stance)) is None


def test_the_top_of_a_body_without_a_head_has_no_raised_arm() -> None:
    """The arm at x > 0.6 ends higher than the trunk, whose topmost 0.15 of the height is the head."""

    def keep(c: np.ndarray) -> np.ndarray:
        (x, z), across = (c[:, 0], c[:, 2]), np.abs(c[:, 0])
        legs = (z < 0.5) & (across > 0.1) & (across < 0.3)
        arms = ((z > 0.8) & (z < 1.0)) | ((x > 0.6) & (z > 0.8) & (z < 1.6))
        return legs | ((z > 0.5) & (z < 1.4) & (across < 0.3)) | arms

    stance = standing_stance(carved((1.6, 0.2, 1.6), 0.1, keep))
    parts = parts_of_body(stance)
    (head,) = (part for part in parts if part.name == "head")
    assert np.abs(stance.standing[head.nodes, 0]).max() < 0.35 and stance.standing[head.nodes, 2].min() > 1.1
    assert "not branch 2 (0.00 ahead, 0.37 right), which is as high" in str(head_note(stance, parts))


def test_a_tool_in_a_hand_that_touches_the_hip_is_not_on_the_trunk() -> None:
    """Sections 0 to 5 are leg, hip, chest, shoulders, neck and head. The arm (6, 7) connects shoulders and hip; a tool
    (8, 9) is in its hand, and a tail (10, 11) is on the hip. The neck is thinner than the arm."""
    chains = {(0, 1, 2, 3, 4, 5): 0.3, (3, 6, 7, 1): 0.1, (7, 8, 9): 0.2, (1, 10, 11): 0.1}
    branches, neighbours = [], {section: set() for section in range(12)}
    for chain, radius in chains.items():
        own = np.ones(len(chain), bool)
        radii = np.where(np.array(chain) == 4, 0.05, radius)
        ends = tuple((section,) for section in chain)
        branches.append(Branch(np.zeros((len(chain), 3)), radii, own, chain[0] == 0, True, 1.0, ends))
        for one, other in pairwise(chain):
            neighbours[one].add(other)
            neighbours[other].add(one)
    adjacent = {section: frozenset(others) for section, others in neighbours.items()}
    shape = Skeleton(tuple(branches), UP, np.zeros((0, 3)), np.zeros(0, int), adjacent, frozenset({0}))
    assert _trunk(shape, 5) == {0, 1, 2, 3, 4, 5}
    assert list(_free_parts(shape)) == [(1, {10, 11}), (3, {4, 5}), (7, {8, 9})]


@pytest.mark.parametrize("make", [column, stool, figure])
def test_without_a_neck_the_head_is_the_top(make: Callable[[], TetMesh]) -> None:
    stance = standing_stance(make())
    assert parts_of(stance.body.mesh).head is None
    (head,) = (part for part in parts_of_body(stance) if part.name == "head")
    heights = stance.standing[:, 2]
    np.testing.assert_array_equal(head.nodes, np.flatnonzero(heights > heights.max() - 0.15 * stance.body.height))
