"""Curve skeleton of simple bodies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from egs_warp.muscles.fibres import FibreKind
from egs_warp.muscles.geodesic_height import base_nodes, geodesic_height
from egs_warp.muscles.muscle_set import automatic_muscles
from egs_warp.muscles.skeleton import skeleton
from tests.support.meshes import UP, carved, column, figure, stool


def test_ascent_is_height_on_a_column() -> None:
    """The drainage field of an upright prism depends only on the height, so the ascent equals the height."""
    mesh = column()
    np.testing.assert_allclose(geodesic_height(mesh, UP), mesh.nodes[:, 2], atol=0.04)
    assert set(base_nodes(mesh, UP)) == set(np.flatnonzero(mesh.nodes[:, 2] < 1e-9))


def test_a_column_is_one_branch_from_the_ground_to_the_top() -> None:
    (trunk,) = skeleton(column(), UP).branches
    assert trunk.starts_on_ground
    assert trunk.ends_freely
    assert trunk.points[0, 2] == pytest.approx(0.0, abs=1e-12)
    assert trunk.points[-1, 2] == pytest.approx(1.2, abs=0.05)
    assert np.abs(trunk.points[:, :2]).max() < 0.02
    assert trunk.volume == pytest.approx(0.3 * 0.3 * 1.2)
    np.testing.assert_allclose(trunk.radii[3:-3], np.sqrt(0.3 * 0.3 / np.pi), rtol=0.15)


def test_a_stool_has_four_like_legs() -> None:
    branches = skeleton(stool(), UP).branches
    assert len(branches) == 4
    feet = np.array([branch.points[0] for branch in branches])
    assert all(branch.starts_on_ground for branch in branches)
    assert {(float(np.sign(x)), float(np.sign(y))) for x, y, _ in feet} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    np.testing.assert_allclose(np.abs(feet[:, :2]), 0.25, atol=0.03)
    lengths = np.array([branch.length for branch in branches])
    assert lengths.max() < 1.15 * lengths.min()


def test_a_figure_has_legs_trunk_and_arms() -> None:
    mesh = figure()
    branches = skeleton(mesh, UP).branches
    legs = [branch for branch in branches if branch.starts_on_ground]
    arms = [branch for branch in branches if np.abs(branch.points[-1, 0]) > 0.6]
    (trunk,) = [b for b in branches if not b.starts_on_ground and np.abs(b.points[-1, 0]) < 0.6]
    assert (len(legs), len(arms)) == (2, 2)
    assert legs[0].points[0, 0] * legs[1].points[0, 0] < 0
    assert arms[0].points[-1, 0] * arms[1].points[-1, 0] < 0
    assert trunk.points[-1, 2] > 1.25
    assert trunk.volume == max(branch.volume for branch in branches)


def test_small_bumps_are_no_branches() -> None:
    def keep(c: np.ndarray) -> np.ndarray:
        bump = (c[:, 2] > 0.6) & (c[:, 2] < 0.7) & (c[:, 0] > 0.2) & (np.abs(c[:, 1]) < 0.06)
        return ((np.abs(c[:, 0]) < 0.2) & (c[:, 2] < 1.2)) | bump

    assert len(skeleton(carved((0.6, 0.4, 1.2), 0.1, keep), UP).branches) == 1


def test_the_skeleton_rotates_with_the_up_axis_and_is_deterministic() -> None:
    """The same figure in other axes has the same skeleton; two calls agree bitwise."""
    mesh = figure()
    turned = TetMesh(np.ascontiguousarray(mesh.nodes[:, [1, 2, 0]]), mesh.tets)
    first, second = skeleton(mesh, UP), skeleton(mesh, UP)
    other = skeleton(turned, np.array([0.0, 1.0, 0.0]))
    assert len(first.branches) == len(other.branches)
    for one, same, rotated in zip(first.branches, second.branches, other.branches, strict=True):
        assert np.array_equal(one.points, same.points)
        assert one.volume == pytest.approx(rotated.volume, rel=1e-6)


@pytest.mark.parametrize(("make", "branch_count"), [(column, 1), (stool, 4), (figure, 5)])
def test_every_branch_gets_every_kind_of_fibre(make: Callable[[], TetMesh], branch_count: int) -> None:
    """Each branch has at least four longitudinal fibres and fibres of all other kinds, within the budget of segments.

    See docs/concepts/muscles.md.
    """
    mesh = make()
    muscles = automatic_muscles(mesh, UP, body_weight=100.0, height=1.0)
    assert muscles.segment_count <= (120 if make is stool else 112)
    assert muscles.rest_lengths.min() >= 0.25 * mean_edge_length(mesh)
    kinds = np.array([kind.value for kind in muscles.fibre_kinds])
    assert set(muscles.fibre_groups) == set(range(branch_count))
    for group in range(branch_count):
        of_group = kinds[muscles.fibre_groups == group]
        assert set(of_group) == {kind.value for kind in FibreKind} - {"user"}
        assert (of_group == "longitudinal").sum() >= 4


def test_legs_bend_in_both_directions() -> None:
    """Each leg of a four-legged body has at least three segments on each of four sides, and muscles that do not crush
    it.
    """
    mesh = stool()
    muscles = automatic_muscles(mesh, UP, body_weight=100.0, height=0.8, young_modulus=1e4)
    longitudinal = muscles.segments_of_kind(FibreKind.LONGITUDINAL)
    fibres, counts = np.unique(muscles.fibre_from_segment[longitudinal], return_counts=True)
    assert len(fibres) == 16 and counts.min() >= 3
    section = np.pi * 0.15**2
    together = muscles.max_forces[longitudinal].reshape(16, -1).min(axis=1)[:4].sum()
    assert together < 1.1 * 1e4 * section
