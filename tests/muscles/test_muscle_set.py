"""Muscles: columns of the activation Jacobian (Eq. 7), attachments, and motions caused by each kind of fibre."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import spsolve

from egs_warp.errors import UserError
from egs_warp.fem.body import SoftBody, make_body
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh, edge_graph
from egs_warp.muscles.attachments import attachment_rows
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.muscle_set import MuscleSet, attach_fibres, automatic_muscles
from egs_warp.muscles.tension import activation_jacobian
from tests.support.meshes import box_mesh
from tests.support.properties import examples

COLUMN = box_mesh((4, 4, 10), (0.4, 0.4, 1.0))


def random_muscles(rng: np.random.Generator) -> MuscleSet:
    fibres = [
        Fibre(f"fibre {i}", FibreKind.USER, rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 1.0], (4, 3)), 10.0 ** (i - 2))
        for i in range(5)
    ]
    return attach_fibres(COLUMN, fibres)


@settings(max_examples=examples(15))
@given(seed=st.integers(0, 2**32 - 1))
def test_columns_make_no_net_force_or_torque(seed: int) -> None:
    """Eq. (7): in any pose, the nodal forces of every column have zero resultant force and torque."""
    rng = np.random.default_rng(seed)
    muscles = random_muscles(rng)
    positions = COLUMN.nodes + rng.normal(0.0, 0.05, COLUMN.nodes.shape) + rng.normal(0.0, 1.0, 3)
    forces = activation_jacobian(muscles, positions).toarray().reshape(-1, 3, muscles.segment_count)
    scale = np.abs(forces).sum(axis=(0, 1))
    assert np.all(np.abs(forces.sum(axis=0)) <= 1e-14 * scale)
    torques = np.cross(positions[:, :, None], forces, axis=1).sum(axis=0)
    assert np.all(np.abs(torques) <= 1e-14 * scale * np.abs(positions).max())


def test_columns_are_equation_7() -> None:
    """Eq. (7): column j is k_j (B_i^T u - B_k^T u), with the unit vector u from end i to end k; a segment of zero
    length exerts no force."""
    rng = np.random.default_rng(1)
    muscles = random_muscles(rng)
    positions = COLUMN.nodes + rng.normal(0.0, 0.05, COLUMN.nodes.shape)
    dense = activation_jacobian(muscles, positions).toarray()
    rows = muscles.end_rows.toarray()
    expected = np.zeros_like(dense)
    for j, (i, k) in enumerate(muscles.segments):
        u = rows[k] @ positions - rows[i] @ positions
        u /= np.linalg.norm(u)
        expected[:, j] = muscles.stiffness[j] * np.outer(rows[i] - rows[k], u).ravel()
    np.testing.assert_allclose(dense, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
    assert not activation_jacobian(muscles, np.zeros_like(positions)).toarray().any()


def test_positive_activation_contracts() -> None:
    """The virtual work of a column is -k_j times the rate of the segment's length (finite differences)."""
    rng = np.random.default_rng(2)
    muscles = random_muscles(rng)
    velocity = rng.normal(size=COLUMN.nodes.shape)
    step = 1e-6
    rate = (muscles.lengths(COLUMN.nodes + step * velocity) - muscles.lengths(COLUMN.nodes - step * velocity)) / (
        2 * step
    )
    power = activation_jacobian(muscles, COLUMN.nodes).T @ velocity.ravel()
    np.testing.assert_allclose(power, -muscles.stiffness * rate, rtol=1e-6, atol=1e-9 * np.abs(power).max())


def test_bounds_and_strength() -> None:
    """The bounds are abs(a_j) <= s_max L_j and the stiffness is k_j = F_max / (s_max L_j): at its bound, a segment has
    the strength of its fibre."""
    fibre = Fibre("spine", FibreKind.LONGITUDINAL, np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.5], [0.0, 0.0, 0.9]]), 7.0)
    muscles = attach_fibres(COLUMN, [fibre], max_strain=0.25)
    np.testing.assert_allclose(muscles.rest_lengths, [0.3, 0.4], rtol=0.03)
    np.testing.assert_allclose(muscles.bounds, 0.25 * muscles.rest_lengths)
    np.testing.assert_allclose(muscles.max_forces, 7.0)
    np.testing.assert_allclose(muscles.lengths(COLUMN.nodes), muscles.rest_lengths)


def test_attachments_spread_and_keep_their_centroid() -> None:
    """Rows are non-negative, sum to 1, and have no weight above 40 %; centroids are within a tenth of an edge."""
    points = np.random.default_rng(3).uniform([-0.15, -0.15, 0.05], [0.15, 0.15, 0.95], (50, 3))
    rows = attachment_rows(COLUMN, points)
    assert rows.min() >= 0.0
    assert rows.max() <= 0.4
    np.testing.assert_allclose(rows.sum(axis=1), 1.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(rows @ COLUMN.nodes, points, rtol=0, atol=0.1 * edge_graph(COLUMN).data.mean())


def test_attachments_do_not_cross_gaps() -> None:
    """A point in one of two adjacent legs has weights only on nodes of that leg, even if nodes of the other leg are
    near enough."""
    bar = box_mesh((9, 2, 9), (0.9, 0.2, 0.9))
    centres = bar.nodes[bar.tets].mean(axis=1)
    arch = bar.tets[(centres[:, 2] > 0.6) | (np.abs(centres[:, 0]) > 0.05)]
    used, tets = np.unique(arch, return_inverse=True)
    mesh = TetMesh(bar.nodes[used], tets.reshape(-1, 4).astype(np.int32))
    row = attachment_rows(mesh, np.array([[0.07, 0.0, 0.1]])).toarray()[0]
    assert row[mesh.nodes[:, 0] > 0.0].sum() == pytest.approx(1.0, abs=1e-15)


def test_unusable_fibres_are_refused() -> None:
    ends = np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.8]])
    with pytest.raises(UserError, match="muscles: the body has no fibre; give at least one"):
        attach_fibres(COLUMN, [])
    with pytest.raises(UserError, match='two fibres are named "a"; give each its own name'):
        attach_fibres(COLUMN, [Fibre("a", FibreKind.USER, ends, 1.0), Fibre("a", FibreKind.USER, ends + 0.1, 1.0)])
    with pytest.raises(UserError, match='a segment of fibre "b" has no length inside the body'):
        attach_fibres(COLUMN, [Fibre("b", FibreKind.USER, ends[[0, 0]], 1.0)])


UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def column_body() -> SoftBody:
    return make_body(COLUMN, Plane(UP, 0.0), device="cpu")


@pytest.fixture(scope="module")
def column_muscles(column_body: SoftBody) -> MuscleSet:
    return automatic_muscles(COLUMN, UP, body_weight=column_body.weight, height=column_body.height)


def linear_response(body: SoftBody, muscles: MuscleSet, segments: np.ndarray) -> np.ndarray:
    """Return the static displacement (N, 3), m, of a body with a clamped base if ``segments`` contract by 2 % of their
    lengths."""
    return static_response(body, muscles, segments, 0.02, COLUMN.nodes[:, 2:] <= 1e-9)


def free_response(body: SoftBody, muscles: MuscleSet, segments: np.ndarray, share: float) -> np.ndarray:
    """Return the displacement (N, 3), m, of a free body if ``segments`` contract by the fraction ``share`` of their
    lengths. Six degrees of freedom at three corners are fixed, which excludes rigid motions."""
    low, ahead, aside = (
        int(np.argmin(np.linalg.norm(COLUMN.nodes - corner, axis=1)))
        for corner in ([-0.2, -0.2, 0.0], [0.2, -0.2, 0.0], [-0.2, 0.2, 0.0])
    )
    held = np.zeros(COLUMN.nodes.shape, dtype=bool)
    held[low] = True
    held[ahead, 1:] = True
    held[aside, 2] = True
    return static_response(body, muscles, segments, share, held)


def static_response(
    body: SoftBody, muscles: MuscleSet, segments: np.ndarray, share: float, held: np.ndarray
) -> np.ndarray:
    """Return the linear displacement (N, 3), m, if ``segments`` contract by the fraction ``share`` of their lengths,
    with the degrees of freedom ``held`` (N, 3) or (N, 1) fixed.
    """
    upper = body.assembly.matrix(body.assembly.hessian_entries(COLUMN.nodes))
    stiffness = (upper + sparse.triu(upper, 1).T).tocsc()
    activation = np.zeros(muscles.segment_count)
    activation[segments] = share * muscles.rest_lengths[segments]
    force = activation_jacobian(muscles, COLUMN.nodes) @ activation
    free = np.flatnonzero(~np.broadcast_to(held, COLUMN.nodes.shape).ravel())
    moved = np.zeros(force.shape)
    moved[free] = np.asarray(spsolve(stiffness[free][:, free], force[free]))
    return moved.reshape(-1, 3)


def twist(moved: np.ndarray) -> float:
    """Return the mean rotation of the upper half about the vertical axis, rad."""
    top = COLUMN.nodes[:, 2] > 0.5
    x, u = COLUMN.nodes[top], moved[top]
    return float((x[:, 0] * u[:, 1] - x[:, 1] * u[:, 0]).sum() / (x[:, :2] ** 2).sum())


def rise(moved: np.ndarray) -> float:
    """Return the mean upward displacement of the upper half, m."""
    return float(moved[COLUMN.nodes[:, 2] > 0.5, 2].mean())


def lean(moved: np.ndarray) -> np.ndarray:
    """Return the mean horizontal displacement (2,) of the upper half, m."""
    return moved[COLUMN.nodes[:, 2] > 0.5, :2].mean(axis=0)


def test_longitudinal_fibres_shorten_and_on_one_side_bend(column_body: SoftBody, column_muscles: MuscleSet) -> None:
    """Eq. (7): all longitudinal fibres together lower the upper half without a lean; the fibres on +x alone make it
    lean towards +x.

    See docs/concepts/muscles.md.
    """
    segments = column_muscles.segments_of_kind(FibreKind.LONGITUDINAL)
    together = linear_response(column_body, column_muscles, segments)
    assert rise(together) < -1e-3
    assert np.linalg.norm(lean(together)) < 0.1 * abs(rise(together))
    middles = column_muscles.end_points(COLUMN.nodes)[column_muscles.segments[segments]].mean(axis=1)
    one_sided = lean(linear_response(column_body, column_muscles, segments[middles[:, 0] > 0.05]))
    other_side = lean(linear_response(column_body, column_muscles, segments[middles[:, 0] < -0.05]))
    assert one_sided[0] > 1e-3
    assert abs(one_sided[1]) < 0.3 * one_sided[0]
    assert other_side[0] == pytest.approx(-one_sided[0], rel=0.15)


def test_radial_fibres_lengthen_by_poissons_ratio(column_body: SoftBody, column_muscles: MuscleSet) -> None:
    """Eq. (7), docs/concepts/muscles.md: the mean axial strain of a free body that is compressed by its radial fibres
    is exactly nu sum(T L) / (E V); with a clamped base, its upper half rises.

    Forces in equilibrium have the mean stress sum(f x^T) / V, which is -T L along each segment of length L and tension
    T; the mean axial strain is -nu / E times the two lateral stresses.
    """
    radial = column_muscles.segments_of_kind(FibreKind.RADIAL)
    share = 0.002
    moved = free_response(column_body, column_muscles, radial, share)
    corners, shift = COLUMN.nodes[COLUMN.tets], moved[COLUMN.tets]
    volumes = COLUMN.volumes()
    gradients = np.linalg.solve(corners[:, 1:] - corners[:, :1], shift[:, 1:] - shift[:, :1])
    axial = float(volumes @ gradients[:, 2, 2]) / volumes.sum()
    # At the bound of its activation, a strain of 30 %, a segment exerts its documented strength.
    lengths = column_muscles.lengths(COLUMN.nodes)[radial]
    pull = share / 0.3 * column_muscles.max_forces[radial]
    material = column_body.assembly.material
    expected = material.poisson_ratio / material.young_modulus * float(pull @ lengths) / volumes.sum()
    assert axial == pytest.approx(expected, rel=1e-6)
    moved = linear_response(column_body, column_muscles, radial)
    assert rise(moved) > 1e-5
    assert np.linalg.norm(lean(moved)) < 0.3 * rise(moved)


def test_radial_fibres_are_diameters_spread_over_length_and_directions(column_muscles: MuscleSet) -> None:
    """Fibres are horizontal, pass through the axis, and extend to 0.7 of the half-width on both sides; their directions
    are evenly distributed on each level.
    """
    ends = column_muscles.end_points(COLUMN.nodes)[
        column_muscles.segments[column_muscles.segments_of_kind(FibreKind.RADIAL)]
    ]
    across, middles = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
    edge = 0.1
    assert np.abs(across[:, 2]).max() < 0.2 * edge and np.abs(middles[:, :2]).max() < 0.1 * edge
    directions = across[:, :2] / np.linalg.norm(across[:, :2], axis=1, keepdims=True)
    reach = 0.2 / np.abs(directions).max(axis=1)
    np.testing.assert_allclose(0.5 * np.linalg.norm(across, axis=1), 0.7 * reach, rtol=0.1)
    levels = np.unique(np.round(middles[:, 2], 1))
    assert len(levels) >= 3 and np.ptp(levels) > 0.5
    # The second moments of the directions are isotropic, so all horizontal directions contract equally.
    second = np.einsum("ni,nj->ij", directions, directions) / len(directions)
    np.testing.assert_allclose(second, 0.5 * np.eye(2), atol=0.02)


def test_oblique_fibres_twist_by_their_hand_and_hoops_do_not(column_body: SoftBody, column_muscles: MuscleSet) -> None:
    """Eq. (7): right-handed and left-handed helices twist the body in opposite directions; hoops and radial fibres
    hardly twist it.

    A right-handed helix that contracts unwinds: seen from above, its upper end rotates clockwise (negative).

    See docs/concepts/muscles.md.
    """
    turned = {
        kind: twist(linear_response(column_body, column_muscles, column_muscles.segments_of_kind(kind)))
        for kind in FibreKind
        if len(column_muscles.segments_of_kind(kind))
    }
    assert turned[FibreKind.OBLIQUE_RIGHT] < -1e-3
    assert turned[FibreKind.OBLIQUE_LEFT] == pytest.approx(-turned[FibreKind.OBLIQUE_RIGHT], rel=0.1)
    for kind in (FibreKind.CIRCULAR, FibreKind.RADIAL, FibreKind.LONGITUDINAL):
        assert abs(turned[kind]) < 0.05 * turned[FibreKind.OBLIQUE_LEFT]


def test_hoops_make_no_axial_torque_between_halves(column_muscles: MuscleSet) -> None:
    """The forces of a planar hoop rotate neither half of the body about the axis, for any activation (erratum,
    docs/concepts/muscles.md).
    """
    columns = activation_jacobian(column_muscles, COLUMN.nodes).toarray().reshape(-1, 3, column_muscles.segment_count)
    x = COLUMN.nodes
    torque = x[:, 0, None] * columns[:, 1] - x[:, 1, None] * columns[:, 0]
    crossing = np.abs(torque[x[:, 2] > 0.5].sum(axis=0)) / column_muscles.stiffness
    hoops = column_muscles.segments_of_kind(FibreKind.CIRCULAR)
    helices = column_muscles.segments_of_kind(FibreKind.OBLIQUE_LEFT, FibreKind.OBLIQUE_RIGHT)
    assert crossing[hoops].max() < 0.05 * crossing[helices].max()


def test_automatic_muscles_of_a_column(column_body: SoftBody, column_muscles: MuscleSet) -> None:
    """A column gets fibres of every kind, each with a mirrored partner, within the budget of segments. The longitudinal
    fibres are distributed all around, and two calls give bitwise equal results."""
    muscles = column_muscles
    assert set(muscles.fibre_kinds) == set(FibreKind) - {FibreKind.USER}
    assert 60 <= muscles.segment_count <= 112
    assert np.all(muscles.fibre_partners >= 0)
    assert np.array_equal(muscles.fibre_partners[muscles.fibre_partners], np.arange(muscles.fibre_count))
    low = muscles.end_points(COLUMN.nodes)
    low = low[low[:, 2] < 0.1]
    angles = np.sort(np.degrees(np.arctan2(low[:, 1], low[:, 0])))
    assert np.diff(np.append(angles, angles[0] + 360.0)).max() < 60.0
    again = automatic_muscles(COLUMN, UP, body_weight=column_body.weight, height=column_body.height)
    assert np.array_equal(again.end_rows.toarray(), muscles.end_rows.toarray())
    assert np.array_equal(again.stiffness, muscles.stiffness)
