"""Similarity transform of a whole cloud into another frame, colours included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.geometry.affine import rotated_colours
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud


def to_body_frame(cloud: GaussianCloud, frame: BodyFrame) -> GaussianCloud:
    """Transform the capture's ``cloud`` to ``frame``, colours included; the order of the Gaussians does not change."""
    turn = Rotation.from_matrix(frame.axes)
    rotations = cloud.rotations.numpy().astype(np.float64)
    moved = GaussianCloud.from_numpy(
        frame.points(cloud.means.numpy()),
        (turn * Rotation.from_quat(rotations[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]],
        cloud.log_scales.numpy().astype(np.float64) + np.log(frame.scale),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
        antialiased=cloud.antialiased,
        device=str(cloud.device),
    )
    return replace(moved, sh=rotated_colours(moved.sh, turn))
