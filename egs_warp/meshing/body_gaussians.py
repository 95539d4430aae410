"""What the mechanics sees of a capture: its Gaussians in the body's own frame and in an order of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.body_frame import BodyFrame, upright_frame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

_STEPS_PER_E = 64
"""Sizes are rounded to this many steps a factor of e (1.6 %): a file's log scales lose bits when its unit changes."""


def centred(cloud: GaussianCloud) -> tuple[GaussianCloud, np.ndarray]:
    """The capture moved to an origin amid its Gaussians, and where that was (3,), capture's units.

    Each coordinate of the origin is one of the capture's own, so a move that single precision holds exactly leaves no
    trace.
    """
    means = cloud.means.numpy().astype(np.float64)
    origin = np.sort(means, axis=0)[len(means) // 2]
    return replace(
        cloud, means=wp.array((means - origin).astype(np.float32), dtype=wp.vec3, device=cloud.device)
    ), origin


def canonical_order(cloud: GaussianCloud) -> np.ndarray:
    """(n,) indices that sort the Gaussians by what they are, first by their means, so that a file's order has no
    say.
    """
    return np.lexsort(
        np.concatenate(
            [
                cloud.sh.numpy()[:, 0].T,
                cloud.log_scales.numpy().T,
                cloud.rotations.numpy().T,
                cloud.opacity_logits.numpy()[None],
                cloud.means.numpy()[:, ::-1].T,
            ]
        )
    )


def find_body_frame(cloud: GaussianCloud, plane: Plane) -> BodyFrame:
    """The frame of the body that ``cloud`` shows on ``plane`` (``upright_frame``), each Gaussian with its opacity."""
    order = canonical_order(cloud)
    return upright_frame(cloud.means.numpy()[order].astype(np.float64), cloud.opacities()[order], plane)


def body_gaussians(cloud: GaussianCloud, frame: BodyFrame) -> GaussianCloud:
    """The capture in ``frame``, of its colours the even part, in an order that follows the body.

    The same bits for any order of the capture's Gaussians and, unless a size lies within single precision's rounding of
    a step, for any unit that is a power of two.
    """
    turn = Rotation.from_matrix(frame.axes)
    rotations = cloud.rotations.numpy().astype(np.float64)
    turned = (turn * Rotation.from_quat(rotations[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    sizes = cloud.log_scales.numpy().astype(np.float64) + np.log(frame.scale)
    body = GaussianCloud.from_numpy(
        frame.points(cloud.means.numpy()),
        turned,
        np.rint(_STEPS_PER_E * sizes) / _STEPS_PER_E,
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy()[:, :1],
        device=str(cloud.device),
    )
    return body.subset(canonical_order(body))
