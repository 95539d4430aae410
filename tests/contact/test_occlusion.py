"""Occlusion between bodies: a body darkens the Gaussians of another body, but not its own, as a function of their gap
and of its normal."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from egs_warp.contact.occlusion import BodyShadows, OccludingBody
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from tests.support.props import box_body

SIZE = (0.6, 0.6, 0.4)


def _cloud(points: np.ndarray) -> GaussianCloud:
    count = len(points)
    sh = np.full((count, 4, 3), 0.2)
    return GaussianCloud.from_numpy(
        points, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.full((count, 3), -4.0), np.zeros(count), sh, device="cpu"
    )


@pytest.mark.parametrize("soft", [False, True])
def test_darkening_below_beside_and_above_a_body(soft: bool) -> None:
    bodies = [box_body(SIZE, soft=soft), box_body(SIZE)]
    occluding = []
    for body in bodies:
        geometry = body.stepper.geometry
        mesh = body.stepper.body.mesh
        occluding.append(
            OccludingBody(mesh, geometry.tet_from_point, geometry.weights, body.level_set, body.stepper.body.height)
        )
    lift = np.array([0.0, 0.0, 1.0])
    poses = [body.stepper.body.mesh.nodes + lift * index for body, index in zip(bodies, (1, 0), strict=True)]
    # The first body, at heights 1 to 1.4, has one Gaussian; the second one, below it, has four.
    points = np.array([[0.0, 0.0, 0.98], [0.32, 0.0, 1.2], [0.0, 0.0, 1.42], [0.0, 0.0, 0.8]])
    joint = _cloud(np.concatenate([points[:1], points]))
    # Only shapes near each other cast a shadow, so the second body is moved up to the first one.
    poses[1] = poses[1] + 0.55 * lift
    BodyShadows(occluding, [1, 4], wp.get_device("cpu")).draw(joint, poses)
    sh = joint.sh.numpy()
    gains = (0.5 + SH_BAND_0 * sh[:, 0, 0]) / (0.5 + SH_BAND_0 * 0.2)
    np.testing.assert_allclose(sh[:, 1, 0], 0.2 * gains, rtol=1e-5)
    fraction = 0.85 * np.exp(-0.02 / (0.06 * 0.4))
    np.testing.assert_allclose(gains[1:], [1.0 - fraction, 1.0 - 0.5 * fraction, 1.0, 1.0], atol=0.02)
    # The Gaussian of the first body is 0.03 above the second body, which hides nothing of its sky.
    assert gains[0] == pytest.approx(1.0, abs=1e-3)
