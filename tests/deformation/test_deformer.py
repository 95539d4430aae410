"""Eq. (14) to (16): Gaussians deformed by the cage."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egs_warp.deformation.deformer import Deformer, deform
from egs_warp.deformation.embedding import CageLocator, GaussianEmbedding, embed_gaussians
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.deformation.spherical_harmonics import rotate_sh_kernel
from egs_warp.launching import launch_rows
from egs_warp.render import render_gaussians
from tests.support.deformation_scenes import bent, box, covariances, matrices, random_cloud
from tests.support.kernels import orders_kernel, rotation_parts_kernel, signed_kernel
from tests.support.properties import examples


def colours(sh: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the linear colours (n, 3) of ``sh`` in the unit ``direction`` (n, 3), by the formulas of the INRIA
    renderer."""
    x, y, z = direction.T
    basis = [
        0.28209479177387814 + 0 * x,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.einsum("kn,nkc->nc", np.array(basis[: sh.shape[1]]), sh)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_rotated_cage_rotates_shape_and_colour_exactly(device: str, degree: int) -> None:
    """Eq. (14), (15): under a rotation the covariance rotates, and every band of colour is unchanged for a viewer that
    rotates with it."""
    mesh, cloud = box(), random_cloud(300, degree=degree, device=device)
    turn = Rotation.from_rotvec([0.7, -2.1, 0.4]).as_matrix()
    result = deform(cloud, embed_gaussians(cloud, mesh), mesh.nodes @ turn.T + [3.0, 1.0, -2.0])
    np.testing.assert_allclose(result.cloud.means.numpy(), cloud.means.numpy() @ turn.T + [3, 1, -2], atol=1e-5)
    np.testing.assert_allclose(np.exp(result.cloud.log_scales.numpy() - cloud.log_scales.numpy()), 1.0, atol=2e-5)
    np.testing.assert_allclose(matrices(result.cloud), turn @ matrices(cloud), atol=1e-5)
    views = np.random.default_rng(5).normal(size=(300, 3))
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    seen = colours(cloud.sh.numpy().astype(np.float64), views)
    turned = colours(result.cloud.sh.numpy().astype(np.float64), views @ turn.T)
    np.testing.assert_allclose(turned, seen, atol=2e-5)


def test_colour_rotates_exactly_where_euler_angles_are_arbitrary(device: str) -> None:
    """Eq. (15): colours are exact for the identity, for rotations about z alone, for rotations by 180 degrees about
    horizontal axes, and for small perturbations of each."""
    half = [np.pi * np.array([np.cos(a), np.sin(a), 0.0]) for a in (0.0, 0.5 * np.pi, 1.1)]
    near = np.array([1e-9, -3e-5, 2e-4])
    vectors = np.array(
        [v + e for v in (np.zeros(3), np.array([0.0, 0.0, 2.3]), *half) for e in (0.0 * near, near, near[::-1])]
    )
    turns = Rotation.from_rotvec(vectors)
    sh = np.random.default_rng(3).normal(size=(len(vectors), 16, 3))
    result = wp.zeros((len(vectors), 16), dtype=wp.vec3, device=device)
    launch_rows(
        rotate_sh_kernel,
        len(vectors),
        inputs=[
            wp.array(turns.as_quat(scalar_first=True), dtype=wp.vec4, device=device),
            wp.array(sh, dtype=wp.vec3, device=device),
            3,
        ],
        outputs=[result],
        device=wp.get_device(device),
    )
    turned = result.numpy().astype(np.float64)
    turned[:, 0] = sh[:, 0]
    for view in np.eye(3):
        views = np.tile(view, (len(vectors), 1))
        np.testing.assert_allclose(colours(turned, turns.apply(views)), colours(sh, views), atol=1e-5)


def test_rotating_the_object_is_rotating_the_camera(device: str) -> None:
    """Eq. (15): the image of the rotated object equals that of the object from the inversely rotated camera, to 1e-4 in
    linear colour, with bands 1 to 3 at full strength."""
    mesh, cloud = box(), random_cloud(300, degree=3, device=device)
    turn = Rotation.from_rotvec([0.7, -2.1, 0.4]).as_matrix()
    turned = deform(cloud, embed_gaussians(cloud, mesh), mesh.nodes @ turn.T).cloud
    middle, eye, up = np.full(3, 0.5), np.array([2.2, 0.9, 1.4]), np.array([0.0, 0.0, 1.0])
    pictures = [
        render_gaussians(each, Camera.look_at(r @ eye, r @ middle, r @ up, width=96, height=96)).colour.numpy()
        for each, r in ((cloud, np.eye(3)), (turned, turn))
    ]
    difference = np.abs(pictures[0] - pictures[1])
    assert pictures[0].max() - pictures[0].min() > 0.5
    # Pixels in which a splat is cut at 1/255 in only one of the images may differ by more; there are few.
    assert np.percentile(difference, 99.9) < 1e-4
    assert difference.max() < 4e-3 * np.abs(pictures[0]).max()


def test_an_affine_cage_deforms_flat_splats_exactly(device: str) -> None:
    """Eq. (14), (15): Sigma' = F Sigma F^T to float32, for scales from e^-16 to a quarter of the body; det R = +1, and
    the order and the signs of the axes match those of the deformed axes."""
    mesh, rng = box((5, 5, 5)), np.random.default_rng(3)
    count = 400
    cloud = GaussianCloud.from_numpy(
        rng.uniform(0.0, 1.0, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-16.0, np.log(0.25), (count, 3)),
        rng.normal(size=count),
        rng.normal(size=(count, 1, 3)),
        device=device,
    )
    gradient = np.array([[1.3, 0.4, 0.0], [-0.2, 0.8, 0.3], [0.1, 0.0, 1.1]])
    embedding = embed_gaussians(cloud, mesh)
    weights = embedding.points.weights.numpy().reshape(count, 7, 4)
    shortened = embedding.arms.numpy() < 1.73 * np.tile(np.exp(cloud.log_scales.numpy()), (1, 2))
    assert 0.001 < shortened.mean() < 0.6
    assert weights[:, 1:].min() >= -1.0 and weights.max() <= 2.0
    result = deform(cloud, embedding, mesh.nodes @ gradient.T).cloud
    expected = np.sort(
        np.linalg.svd(gradient @ matrices(cloud) * np.exp(cloud.log_scales.numpy().astype(float))[:, None])[1]
    )
    scales = np.exp(result.log_scales.numpy().astype(float))
    np.testing.assert_allclose(np.sort(scales), expected, rtol=3e-4)
    sigma, exact = covariances(result), gradient @ covariances(cloud) @ gradient.T
    error = np.abs(sigma - exact).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))
    assert error.max() < 2e-5
    np.testing.assert_allclose(np.linalg.det(matrices(result)), 1.0, atol=1e-6)
    left, _, right = np.linalg.svd(gradient)
    carried = left @ right @ matrices(cloud)
    assert np.einsum("nij,nij->nj", matrices(result), carried).sum(axis=1).min() > 2.0


def tets_of(embedding: GaussianEmbedding) -> np.ndarray:
    """Return the indices (n, 7) of the tetrahedra of the mean and of the ends of the six arms of each Gaussian."""
    return np.asarray(embedding.points.tets.numpy(), np.int32).reshape(-1, 7)


def by_arms(cloud: GaussianCloud, embedding: GaussianEmbedding, positions: np.ndarray) -> np.ndarray:
    """Return (F+ + F-)/2 (n, 3, 3) of Eq. (14), computed from the deformed ends of the arms in float64."""
    nodes = np.asarray(embedding.points.nodes.numpy(), np.int32)
    weights = np.asarray(embedding.points.weights.numpy(), np.float64)
    ends = np.einsum("pk,pki->pi", weights, positions[nodes]).reshape(-1, 7, 3)
    arms = embedding.arms.numpy().astype(float)
    plus = (ends[:, 1:4] - ends[:, :1]) / arms[:, :3, None]
    minus = (ends[:, :1] - ends[:, 4:]) / arms[:, 3:, None]
    return 0.5 * (plus + minus).transpose(0, 2, 1) @ matrices(cloud).transpose(0, 2, 1)


def test_arms_follow_their_ends(device: str) -> None:
    """Eq. (14): in a bent and perturbed cage, (F+ + F-)/2 from the deformed ends, in float64, gives the deformed
    covariance. The ends are in the tetrahedron of the mean, in its neighbours or farther away."""
    mesh, cloud = box((4, 4, 4)), random_cloud(400, degree=0, scale=0.15, device=device)
    rng = np.random.default_rng(2)
    positions = bent(mesh.nodes, 1.0) + 0.02 * rng.normal(size=mesh.nodes.shape)
    embedding = embed_gaussians(cloud, mesh)
    result = deform(cloud, embedding, positions, max_stretch=1e9).cloud
    gradient, tets, arms = by_arms(cloud, embedding, positions), tets_of(embedding), embedding.arms.numpy()
    sigma = gradient @ covariances(cloud) @ gradient.transpose(0, 2, 1)
    shared = (mesh.tets[tets][:, 1:, :, None] == mesh.tets[tets][:, :1, None, :]).any(axis=3).sum(axis=2)
    assert (shared == 4).any() and (shared == 3).any() and (shared < 3).any()
    # For an arm that is too short for a difference of float32 positions, the mean of the two deformation gradients is
    # used instead.
    exact = (np.linalg.det(gradient) > 0.05) & ~((shared < 3) & (arms < 2e-3)).any(axis=1)
    assert exact.mean() > 0.9
    error = np.abs(covariances(result) - sigma).max(axis=(1, 2)) / np.abs(sigma).max(axis=(1, 2))
    assert error[exact].max() < 2e-4


def test_colour_rotates_with_the_mean_of_the_arms(device: str) -> None:
    """Eq. (15): a Gaussian that reaches into other tetrahedra rotates by the polar rotation of (F+ + F-)/2 (SciPy's),
    which differs from the rotation of the tetrahedron that contains its mean."""
    mesh, cloud = box((4, 4, 4)), random_cloud(400, degree=0, scale=0.15, device=device)
    positions = bent(mesh.nodes, 1.0) + 0.01 * np.random.default_rng(2).normal(size=mesh.nodes.shape)
    embedding = embed_gaussians(cloud, mesh)
    turns = Rotation.from_quat(
        deform(cloud, embedding, positions, max_stretch=1e9).rotations.numpy(), scalar_first=True
    )
    through, tets = by_arms(cloud, embedding, positions), tets_of(embedding)
    corners, rest = (x[mesh.tets[tets[:, 0]]] for x in (positions, mesh.nodes))
    edges, rest_edges = ((x[:, 1:] - x[:, :1]).transpose(0, 2, 1) for x in (corners, rest))
    within = edges @ np.linalg.inv(rest_edges)
    mean, own = (Rotation.from_matrix(u @ vt) for u, _, vt in map(np.linalg.svd, (through, within)))
    reaching = (tets != tets[:, :1]).any(axis=1) & (embedding.arms.numpy() > 5e-3).all(axis=1)
    reaching &= np.linalg.det(through) > 0.2
    assert reaching.sum() > 200
    assert (turns * mean.inv()).magnitude()[reaching].max() < 1e-3
    assert np.median((own * mean.inv()).magnitude()[reaching]) > 0.01


def test_bend_angle_is_the_angle_between_the_arms(device: str) -> None:
    """Eq. (16): the bend is 40 degrees, not half of it, for a needle whose two arms are bent by 40 degrees, and zero
    for a needle across the bend."""
    mesh = box((24, 2, 2), (4.0, 0.4, 0.4))
    scales = np.log([[0.4, 0.004, 0.004], [0.004, 0.05, 0.004], [0.4, 0.4 / 3, 0.004]])
    means = np.tile([2.0, 0.2, 0.2], (3, 1))
    cloud = GaussianCloud.from_numpy(
        means, np.tile([1, 0, 0, 0], (3, 1)), scales, np.zeros(3), np.zeros((3, 1, 3)), device=device
    )
    # The chord of one arm (1.2 m) rotates by half of the angle of its arc, so the two chords differ by 1.2 / radius.
    radius = 1.2 / np.radians(40.0)
    deformer = Deformer(cloud, embed_gaussians(cloud, mesh, gamma=3.0))
    measure = deformer.measure_bend([mesh.nodes, bent(mesh.nodes, radius)])
    assert measure.bend_degrees[0] == pytest.approx(40.0, abs=1.0)
    assert measure.bend_degrees[1] < 4.0
    assert measure.bend_degrees[2] == pytest.approx(40.0, rel=0.15)
    assert np.argmax(measure.fit_error[0]) == 0
    # An affine map omits the sagitta of the arc at one standard deviation, s^2 / (2 radius).
    assert measure.fit_error[0, 0] == pytest.approx(0.4**2 / (2 * radius), rel=0.1)
    assert measure.curl_degrees[0, 0] == pytest.approx(40.0, abs=1.0)
    assert deformer.measure_bend([mesh.nodes]).bend_degrees.max() < 0.05


@pytest.mark.parametrize("along", [0, 1, 2])
@pytest.mark.parametrize("quarters", [0, 1])
def test_a_bend_about_any_axis_of_a_needle_is_measured(device: str, along: int, quarters: int) -> None:
    """Eq. (16): a bend of 40 degrees is measured for each choice of the long axis and of the axis of bending."""
    mesh, radius = box((24, 2, 2), (4.0, 0.4, 0.4)), 1.2 / np.radians(40.0)
    # The axis ``along`` of the Gaussian is parallel to x, and the next one to y, or to z after a quarter turn about x.
    frame = Rotation.from_rotvec([0.5 * np.pi * quarters, 0.0, 0.0]).as_matrix() @ np.roll(np.eye(3), along, axis=1)
    scales = np.roll([0.4, 0.02, 0.004], along)
    cloud = GaussianCloud.from_numpy(
        np.array([[2.0, 0.2, 0.2]]),
        Rotation.from_matrix(frame).as_quat(scalar_first=True)[None],
        np.log(scales)[None],
        np.zeros(1),
        np.zeros((1, 1, 3)),
        device=device,
    )
    measure = Deformer(cloud, embed_gaussians(cloud, mesh, gamma=3.0)).measure_bend([bent(mesh.nodes, radius)])
    assert measure.bend_degrees[0] == pytest.approx(40.0, abs=1.0)


@settings(max_examples=examples(40))
@given(
    seed=st.integers(0, 2**31),
    noise=st.sampled_from([0.0, 0.05, 0.3, 2.0]),
    flatten=st.sampled_from([1.0, 1e-3, 0.0, -1.0]),
    reach=st.sampled_from([0.0, 0.5, 30.0]),
)
def test_no_spike_and_no_nan_for_any_cage(seed: int, noise: float, flatten: float, reach: float) -> None:
    """Eq. (14): for inverted and flattened tetrahedra, far ends, means far outside and scales from e^-16 to a quarter
    of the body, results are finite with proper rotations, and no Gaussian is stretched more than the material around it
    allows."""
    rng = np.random.default_rng(seed)
    mesh, count = box((2, 2, 2)), 60
    cloud = GaussianCloud.from_numpy(
        rng.uniform(-reach, 1.0 + reach, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-16.0, np.log(0.25), (count, 3)),
        np.zeros(count),
        rng.normal(size=(count, 16, 3)),
        device="cpu",
    )
    cage = CageLocator(mesh, device="cpu")
    positions = mesh.nodes * [1.0, 1.0, flatten] + noise * rng.normal(size=mesh.nodes.shape)
    embedding = embed_gaussians(cloud, cage)
    result = deform(cloud, embedding, positions)
    for values in (
        result.cloud.means,
        result.cloud.rotations,
        result.cloud.log_scales,
        result.cloud.sh,
        result.rotations,
    ):
        assert np.isfinite(values.numpy()).all()
    np.testing.assert_allclose(np.linalg.norm(result.cloud.rotations.numpy(), axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(result.rotations.numpy(), axis=1), 1.0, atol=1e-5)
    corners, rest = positions[mesh.tets], mesh.nodes[mesh.tets]
    edges, rest_edges = ((x[:, 1:] - x[:, :1]).transpose(0, 2, 1) for x in (corners, rest))
    stretch = np.linalg.svd(edges @ np.linalg.inv(rest_edges))[1][:, 0]
    around = stretch[np.asarray(embedding.points.tets.numpy(), np.int32).reshape(count, 7)].max(axis=1)
    grown = np.exp(result.cloud.log_scales.numpy().max(axis=1) - cloud.log_scales.numpy().max(axis=1))
    # The length of a column is at most 1.5 times the stretch, so the norm of three columns is at most sqrt(3) times
    # that.
    assert (grown <= 1.5 * np.sqrt(3.0) * around + 1e-3).all()
    weights = embedding.points.weights.numpy().reshape(count, 7, 4)[:, 0]
    far = (weights.min(axis=1) < -1.0) | (weights.max(axis=1) > 2.0)
    if reach == 30.0:
        assert far.mean() > 0.9
    np.testing.assert_allclose(result.cloud.log_scales.numpy()[far], cloud.log_scales.numpy()[far], atol=1e-3)


def test_the_mean_is_the_mean_of_the_deformed_mass(device: str) -> None:
    """Eq. (14) with the second-order term: the deformed mean of a long Gaussian is the mean of its deformed mass, which
    is estimated by sampling."""
    mesh = box((24, 2, 2), (4.0, 0.4, 0.4))
    scales = np.array([0.3, 0.02, 0.03])
    cloud = GaussianCloud.from_numpy(
        np.array([[2.0, 0.2, 0.2]]),
        np.array([[1.0, 0, 0, 0]]),
        np.log(scales)[None],
        np.zeros(1),
        np.zeros((1, 1, 3)),
        device=device,
    )
    result = deform(cloud, embed_gaussians(cloud, mesh), bent(mesh.nodes, 2.0))
    samples = bent(np.random.default_rng(0).normal(size=(200_000, 3)) * scales + [2.0, 0.2, 0.2], 2.0)
    point = bent(np.array([[2.0, 0.2, 0.2]]), 2.0)[0]
    shift = samples.mean(axis=0) - point
    assert np.linalg.norm(shift) > 0.02
    assert np.linalg.norm(result.cloud.means.numpy()[0] - point - shift) < 0.15 * np.linalg.norm(shift)


def test_scale_and_rotation_do_not_flicker() -> None:
    """Eq. (15): under a slow twist by 360 degrees with stretch, axes keep their order and move little in every
    frame."""
    mesh, cloud = box(), random_cloud(200, degree=0)
    # The ratios of the scales exceed the stretch, because axes with more similar scales may swap within one frame.
    scales = np.random.default_rng(1).permuted(np.tile(np.log([0.06, 0.03, 0.01]), (200, 1)), axis=1)
    cloud = GaussianCloud.from_numpy(
        cloud.means.numpy(),
        cloud.rotations.numpy(),
        scales,
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
        device="cpu",
    )
    deformer = Deformer(cloud, embed_gaussians(cloud, mesh))
    previous = None
    for angle in np.linspace(0.0, 2 * np.pi, 121):
        turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        stretch = np.diag([1.0 + 0.2 * np.sin(angle), 1.0, 1.0 - 0.1 * np.sin(angle)])
        frame = matrices(deformer.deform(mesh.nodes @ (turn @ stretch).T).cloud)
        if previous is not None:
            assert np.einsum("nij,nij->nj", frame, previous).min() > np.cos(np.radians(10.0))
        previous = frame


def test_a_wrong_number_of_nodes_is_refused() -> None:
    mesh, cloud = box(), random_cloud(5)
    with pytest.raises(
        UserError, match=r"^deformation: 7 node positions for a cage of 64 nodes; give one for each node$"
    ):
        deform(cloud, embed_gaussians(cloud, mesh), np.zeros((7, 3)))


def test_far_gaussians_neither_bend_nor_stretch(device: str) -> None:
    """Eq. (14), (16): a Gaussian far from the cage moves rigidly with the nearest tetrahedron."""
    mesh = box()
    cloud = random_cloud(50, degree=0, device=device)
    far = GaussianCloud.from_numpy(
        cloud.means.numpy() + [8.0, 0.0, 0.0],
        cloud.rotations.numpy(),
        cloud.log_scales.numpy(),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
        device=device,
    )
    positions = mesh.nodes * [1.0, 3.0, 0.2] + 0.05 * np.random.default_rng(0).normal(size=mesh.nodes.shape)
    deformer = Deformer(far, embed_gaussians(far, mesh))
    result = deformer.deform(positions).cloud
    np.testing.assert_allclose(np.exp(result.log_scales.numpy() - far.log_scales.numpy()), 1.0, atol=1e-4)
    assert np.linalg.norm(result.means.numpy() - far.means.numpy(), axis=1).max() < 12.0
    assert deformer.measure_bend([positions]).fit_error.max() == 0.0


@pytest.mark.cuda
@pytest.mark.parametrize("count", [1, 31, 1000])
def test_one_pass_on_cuda_equals_two_on_the_cpu(count: int) -> None:
    """Eq. (14), (15): one kernel computes the shape and the SH of degree 3, also for counts with which the last warp is
    partly empty."""
    mesh, cloud = box((6, 6, 6)), random_cloud(count)
    positions = bent(mesh.nodes, 1.0)
    expected = deform(cloud, embed_gaussians(cloud, mesh), positions)
    there = random_cloud(count, device="cuda:0")
    result = deform(there, embed_gaussians(there, mesh), positions)
    np.testing.assert_allclose(result.cloud.means.numpy(), expected.cloud.means.numpy(), atol=2e-6)
    np.testing.assert_allclose(covariances(result.cloud), covariances(expected.cloud), atol=1e-6)
    np.testing.assert_allclose(result.cloud.sh.numpy(), expected.cloud.sh.numpy(), atol=1e-4)


def turns_of(count: int, seed: int) -> np.ndarray:
    """Return (count, 3, 3) random rotations."""
    return Rotation.from_quat(np.random.default_rng(seed).normal(size=(count, 4))).as_matrix()


def test_the_rotation_of_a_singular_map_is_that_of_its_svd(device: str) -> None:
    """Eq. (15): if one singular value of F is zero or almost zero, the rotation equals that of SciPy's SVD with det =
    +1, whatever the order of the other two singular values."""
    stretches = [(1.0, 0.4, 0.0), (1.0, 0.0, 0.4), (0.4, 1.0, 0.0), (0.0, 0.4, 1.0), (0.4, 0.0, 1.0), (0.0, 1.0, 0.4)]
    stretches += [(1.0, 1e-9, 0.3), (0.3, 1.0, -0.05), (-0.05, 0.3, 1.0), (0.9, -0.02, 0.4)]
    for turned in (False, True):
        sides = turns_of(len(stretches), 1) if turned else np.eye(3)
        turns = turns_of(len(stretches), 2)
        maps = turns @ sides @ (np.array(stretches)[:, :, None] * np.swapaxes(sides * np.ones((10, 1, 1)), 1, 2))
        given = wp.array(maps.astype(np.float32), dtype=wp.mat33, device=device)
        found = wp.zeros(len(maps), dtype=wp.mat33, device=device)
        wp.launch(rotation_parts_kernel, len(maps), inputs=[given], outputs=[found], device=device)
        left, _, right = np.linalg.svd(maps)
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        np.testing.assert_allclose(found.numpy(), left @ right, atol=2e-5)


def test_the_rotation_of_a_rank_one_map_maps_its_line(device: str) -> None:
    """For F = s u v^T with u and v along the axes or oblique, the rotation is proper, and R v = u."""
    slanted = np.random.default_rng(5).normal(size=(6, 2, 3))
    lines = np.concatenate([[(a, b) for a in np.eye(3) for b in np.eye(3)], slanted])
    u, v = np.swapaxes(lines / np.linalg.norm(lines, axis=2, keepdims=True), 0, 1)
    maps = 1.3 * u[:, :, None] * v[:, None, :]
    given = wp.array(maps.astype(np.float32), dtype=wp.mat33, device=device)
    found = wp.zeros(len(maps), dtype=wp.mat33, device=device)
    wp.launch(rotation_parts_kernel, len(maps), inputs=[given], outputs=[found], device=device)
    turns = found.numpy().astype(np.float64)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(3), (len(maps), 1, 1)), atol=2e-5)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=2e-5)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turns, v), u, atol=2e-5)


def test_axes_keep_their_order(device: str) -> None:
    """The best aligned one of all six orders of a frame's columns is chosen."""
    count = 200
    frames = turns_of(count, 4)
    carried = np.random.default_rng(10).normal(size=(count, 3, 3))
    given = [wp.array(maps.astype(np.float32), dtype=wp.mat33, device=device) for maps in (frames, carried)]
    out = wp.zeros(count, dtype=wp.vec3i, device=device)
    wp.launch(orders_kernel, count, inputs=given, outputs=[out], device=device)
    found = [tuple(order) for order in out.numpy()]
    for frame, target, order in zip(frames, carried, found, strict=True):
        aligned = {p: np.abs((frame[:, p] * target).sum(axis=0)).sum() for p in itertools.permutations(range(3))}
        assert order == max(aligned, key=lambda p: float(aligned[p]))
    assert set(found) == set(itertools.permutations(range(3)))


def test_axes_keep_their_signs(device: str) -> None:
    """The signs closest to the reference are chosen from the four choices with det = +1."""
    count, random = 200, np.random.default_rng(9)
    frames = turns_of(count, 3)
    orders = np.array([random.permutation(3) for _ in range(count)])
    carried = random.normal(size=(count, 3, 3))
    out = wp.zeros(count, dtype=wp.mat33, device=device)
    given = (
        wp.array(frames.astype(np.float32), dtype=wp.mat33, device=device),
        wp.array(orders, dtype=wp.vec3i, device=device),
        wp.array(carried.astype(np.float32), dtype=wp.mat33, device=device),
    )
    wp.launch(signed_kernel, count, inputs=[*given], outputs=[out], device=device)
    for frame, order, target, got in zip(frames, orders, carried, out.numpy(), strict=True):
        choices = [frame[:, order] * signs for signs in itertools.product((1.0, -1.0), repeat=3)]
        proper = [choice for choice in choices if np.linalg.det(choice) > 0.0]
        np.testing.assert_allclose(got, max(proper, key=lambda choice: float((choice * target).sum())), atol=1e-6)
