"""Obstacles of a film: their Gaussians lie on their faces, and a body above an obstacle darkens its top."""

from __future__ import annotations

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.joint_deformer import JointDeformer
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.obstacle_cloud import ObstacleShadows, make_obstacles
from egs_warp.pipelines.world_file import box
from tests.support.meshes import box_mesh


def test_a_body_on_a_box_darkens_the_top_below_it() -> None:
    solid = box((1.0, 0.0), (0.6, 0.4, 0.3))
    obstacles = make_obstacles([solid], np.array([-2.0, -2.0, 0.0]), np.array([3.0, 2.0, 1.0]), device="cpu")
    assert obstacles is not None and len(obstacles.faces) == 5
    means = obstacles.cloud.means.numpy()
    heights = np.stack([face.heights(means) for face in solid.faces])
    assert np.abs(heights.max(axis=0)).max() < 1e-6
    np.testing.assert_allclose([means.min(axis=0), means.max(axis=0)], [[0.7, -0.2, 0.0], [1.3, 0.2, 0.3]], atol=0.01)
    mesh = box_mesh((1, 1, 1), (0.1, 0.1, 0.1))
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (300, 3))
    ones = np.ones((300, 1))
    body = GaussianCloud.from_numpy(
        points,
        ones * [1.0, 0.0, 0.0, 0.0],
        np.full((300, 3), np.log(0.01)),
        3.0 * ones[:, 0],
        np.zeros((300, 1, 3)),
        device="cpu",
    )
    joint = JointDeformer([Deformer(body, embed_gaussians(body, mesh))], fixed=obstacles.cloud)
    shadows = ObstacleShadows(obstacles, body.count, blur_radius=0.01, height=0.2)
    cloud = joint.deform([mesh.nodes + [1.0, 0.0, 0.36]]).cloud
    before = cloud.sh.numpy()[body.count :, 0].copy()
    shadows.draw(cloud)
    darker = (before - cloud.sh.numpy()[body.count :, 0]).mean(axis=1)
    away = np.linalg.norm(means[:, :2] - [1.0, 0.0], axis=1)
    top = means[:, 2] > 0.299
    assert darker[top & (away < 0.03)].min() > 0.1
    assert np.abs(darker[top & (away > 0.2)]).max() < 0.02 and not darker[~top].any()
