"""Gaussians in the body's own frame and in a canonical order, as the mechanics uses them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.body_frame import BodyFrame, upright_frame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

_STEPS_PER_E = 64
"""Log scales are rounded to this many steps per factor of e (1.6 %), as a file's log scales lose bits when its unit
changes."""


def centred(cloud: GaussianCloud) -> tuple[GaussianCloud, np.ndarray]:
    """Move the capture to an origin amid its Gaussians. Returns it and the origin (3,), capture's units.

    Each coordinate of the origin is one of the capture's own, so a translation that single precision represents exactly
    does not change the result.
    """
    means = cloud.means.numpy().astype(np.float64)
    origin = np.sort(means, axis=0)[len(means) // 2]
    return replace(
        cloud, means=wp.array((means - origin).astype(np.float32), dtype=wp.vec3, device=cloud.device)
    ), origin


def canonical_order(cloud: GaussianCloud) -> np.ndarray:
    """(n,) indices that sort the Gaussians by their values, first by their means, so that the order in a file does not
    matter."""
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
    """Return the frame of the body in ``cloud`` on ``plane`` (``upright_frame``), each Gaussian weighted by its
    opacity."""
    order = canonical_order(cloud)
    return upright_frame(cloud.means.numpy()[order].astype(np.float64), cloud.opacities()[order], plane)


def body_gaussians(cloud: GaussianCloud, frame: BodyFrame) -> GaussianCloud:
    """Return the capture in ``frame``, with SH band 0 only, in canonical order.

    The bits are the same for any order of the capture's Gaussians and, unless a size lies within single precision's
    rounding of a step, for any unit that is a power of two.
    """
    rotation = Rotation.from_matrix(frame.axes)
    rotations = cloud.rotations.numpy().astype(np.float64)
    rotated = (rotation * Rotation.from_quat(rotations[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    sizes = cloud.log_scales.numpy().astype(np.float64) + np.log(frame.scale)
    body = GaussianCloud.from_numpy(
        frame.points(cloud.means.numpy()),
        rotated,
        np.rint(_STEPS_PER_E * sizes) / _STEPS_PER_E,
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy()[:, :1],
        antialiased=cloud.antialiased,
        device=str(cloud.device),
    )
    return body.subset(canonical_order(body))
