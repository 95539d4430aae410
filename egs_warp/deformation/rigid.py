"""Similarity transform of a whole cloud into another frame, colours included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.deformation.spherical_harmonics import rotate_sh_kernel
from egs_warp.launching import launch_rows


def to_body_frame(cloud: GaussianCloud, frame: BodyFrame) -> GaussianCloud:
    """Return the capture's ``cloud`` in ``frame``, in the same order; it looks the same from there."""
    turn = Rotation.from_matrix(frame.axes)
    rotations = cloud.rotations.numpy().astype(np.float64)
    moved = GaussianCloud.from_numpy(
        frame.points(cloud.means.numpy()),
        (turn * Rotation.from_quat(rotations[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]],
        cloud.log_scales.numpy().astype(np.float64) + np.log(frame.scale),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
        device=str(cloud.device),
    )
    if cloud.sh_degree == 0:
        return moved
    sh = wp.clone(moved.sh)
    x, y, z, w = turn.as_quat()
    launch_rows(
        rotate_sh_kernel,
        cloud.count,
        inputs=[
            wp.full(cloud.count, wp.vec4(w, x, y, z), dtype=wp.vec4, device=cloud.device),
            moved.sh.contiguous(),
            cloud.sh_degree,
        ],
        outputs=[sh],
        device=cloud.device,
    )
    return replace(moved, sh=sh)
