"""Eq. (14) and the baselines of Table 1: all methods agree for rigid and affine motions, and differ in a bend and a
shear."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.deformation.baselines import BoundSurface, DeformationMethod, deform_with_method
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from tests.support.deformation_scenes import bent, box, covariances, random_cloud


@pytest.mark.parametrize("method", list(DeformationMethod))
def test_every_method_is_exact_for_a_rotation(method: DeformationMethod, device: str) -> None:
    """Eq. (14): under a rigid motion, every method gives the exact cloud."""
    mesh, cloud = box(), random_cloud(200, degree=1, device=device)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    (result,) = deform_with_method(cloud, mesh, [mesh.nodes @ turn.T + [1.0, 2.0, 3.0]], method=method)
    np.testing.assert_allclose(result.means.numpy(), cloud.means.numpy() @ turn.T + [1, 2, 3], atol=2e-5)
    np.testing.assert_allclose(covariances(result), turn @ covariances(cloud) @ turn.T, atol=2e-6)
    # Band 1 rotates with the object: the coefficients are (-y, z, -x) of one vector.
    vector = np.stack([-cloud.sh.numpy()[:, 3], -cloud.sh.numpy()[:, 1], cloud.sh.numpy()[:, 2]], axis=1)
    after = np.stack([-result.sh.numpy()[:, 3], -result.sh.numpy()[:, 1], result.sh.numpy()[:, 2]], axis=1)
    np.testing.assert_allclose(after, np.einsum("ij,njc->nic", turn, vector), atol=2e-5)


@pytest.mark.parametrize(
    "method",
    [DeformationMethod.MEAN_GRADIENT, DeformationMethod.LOCAL_TETRAHEDRON, DeformationMethod.BIDIRECTIONAL_NO_SPLIT],
)
def test_volume_methods_are_exact_for_a_shear(method: DeformationMethod, device: str) -> None:
    """Eq. (14): under an affine motion, Sigma' = F Sigma F^T for every method that uses the volumetric deformation
    gradient F."""
    mesh, cloud = box(), random_cloud(200, degree=0, device=device)
    gradient = np.array([[1.2, 0.5, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 1.0]])
    (result,) = deform_with_method(cloud, mesh, [mesh.nodes @ gradient.T], method=method)
    np.testing.assert_allclose(covariances(result), gradient @ covariances(cloud) @ gradient.T, atol=2e-6)


def test_only_splitting_follows_a_bend() -> None:
    """Eq. (14)-(17): for a needle bent onto a circle, splitting reduces the distance of its mass from the circle by at
    least 40 %."""
    mesh = box((24, 2, 2), (4.0, 0.4, 0.4))
    cloud = GaussianCloud.from_numpy(
        np.array([[2.0, 0.2, 0.2]]),
        np.array([[1.0, 0, 0, 0]]),
        np.log([[0.4, 0.01, 0.01]]),
        np.array([2.0]),
        np.zeros((1, 1, 3)),
        device="cpu",
    )
    radius = 2.0

    def off_circle(method: DeformationMethod) -> float:
        (result,) = deform_with_method(cloud, mesh, [bent(mesh.nodes, radius)], method=method)
        weights = result.opacities() * np.exp(result.log_scales.numpy()).max(axis=1)
        axes = np.linalg.eigh(covariances(result))[1][:, :, 2] * np.exp(result.log_scales.numpy()).max(axis=1)[:, None]
        ends = np.concatenate([result.means.numpy() + 2.0 * axes, result.means.numpy() - 2.0 * axes])
        distance = np.abs(np.hypot(ends[:, 0], ends[:, 2] - radius) - radius)
        return float(np.average(distance, weights=np.tile(weights, 2)))

    whole = off_circle(DeformationMethod.BIDIRECTIONAL_NO_SPLIT)
    # The distance of a point two standard deviations along the tangent, minus the shift of the mean itself, s^2 / (2
    # radius).
    assert whole == pytest.approx(np.hypot(radius, 0.8) - radius - 0.4**2 / (2 * radius), rel=0.25)
    assert off_circle(DeformationMethod.BIDIRECTIONAL) < 0.6 * whole


def test_gaussians_bound_to_a_surface_follow_it_and_not_the_cage(device: str) -> None:
    """SuGaR: under a shear of the cage, Gaussians on a level sheet get the sheet's own in-plane map and normal, and no
    change of thickness."""
    mesh = box()
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    level = 0.5 * (low[2] + high[2])
    sheet = BoundSurface(
        np.array([[low[0], low[1], level], [high[0], low[1], level], [high[0], high[1], level]]),
        np.array([[0, 1, 2]], dtype=np.int32),
    )
    cloud = random_cloud(50, degree=0, device=device)
    gradient = np.array([[1.2, 0.5, 0.3], [0.0, 0.8, 0.0], [0.0, 0.0, 1.5]])
    (result,) = deform_with_method(
        cloud, mesh, [mesh.nodes @ gradient.T], method=DeformationMethod.SURFACE, surface=sheet
    )
    bound = gradient.copy()
    bound[:, 2] = [0.0, 0.0, 1.0]
    origin = np.array([low[0], low[1], level])
    expected = (cloud.means.numpy() - origin) @ bound.T + origin @ gradient.T
    np.testing.assert_allclose(result.means.numpy(), expected, atol=2e-5)
    np.testing.assert_allclose(covariances(result), bound @ covariances(cloud) @ bound.T, atol=2e-6)


def test_a_surface_needs_triangles_with_area() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    with pytest.raises(UserError, match="surface: triangle 0 has no area; give triangles with an area above zero"):
        BoundSurface(corners, np.array([[0, 1, 2]], dtype=np.int32))
    shifted = corners + [1.0, -2.0, 3.0]
    twice = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, 1.0, 0.0]])
    for flat in (shifted, twice, twice[[0, 2, 1]]):
        with pytest.raises(UserError, match="surface: triangle 1 has no area"):
            BoundSurface(np.vstack([np.eye(3), flat]), np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32))
    with pytest.raises(UserError, match="surface: it has no triangles"):
        BoundSurface(corners, np.zeros((0, 3), dtype=np.int32))
