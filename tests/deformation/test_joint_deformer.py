"""Joint cloud of several bodies: each body is deformed as by its own deformer, and the static part does not move."""

from __future__ import annotations

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.joint_deformer import JointDeformer
from tests.support.deformation_scenes import box, random_cloud


def test_each_part_is_deformed_as_alone() -> None:
    mesh = box()
    clouds = [random_cloud(40, seed=1, degree=3), random_cloud(30, seed=2, degree=1)]
    fixed = random_cloud(20, seed=3, degree=0)
    deformers = [Deformer(cloud, embed_gaussians(cloud, mesh)) for cloud in clouds]
    joint = JointDeformer(deformers, fixed=fixed)
    poses = [mesh.nodes @ np.diag([1.1, 0.9, 1.0]) + [2.0, 0.0, 0.0], mesh.nodes[:, [1, 2, 0]]]
    for _ in range(2):
        whole = joint.deform(poses)
    first = 0
    for deformer, pose in zip(deformers, poses, strict=True):
        alone = deformer.deform(pose)
        rows = slice(first, first + alone.cloud.count)
        for name in ("means", "rotations", "log_scales", "opacity_logits"):
            np.testing.assert_array_equal(getattr(whole.cloud, name).numpy()[rows], getattr(alone.cloud, name).numpy())
        bands = alone.cloud.sh.shape[1]
        np.testing.assert_array_equal(whole.cloud.sh.numpy()[rows, :bands], alone.cloud.sh.numpy())
        assert not whole.cloud.sh.numpy()[rows, bands:].any()
        np.testing.assert_array_equal(whole.rotations.numpy()[rows], alone.rotations.numpy())
        first += alone.cloud.count
    np.testing.assert_array_equal(whole.cloud.means.numpy()[first:], fixed.means.numpy())
    np.testing.assert_array_equal(whole.rotations.numpy()[first:], np.tile([1.0, 0.0, 0.0, 0.0], (20, 1)))
