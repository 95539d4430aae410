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
"""Number of steps per factor of e (1.6 % each) to which log scales are rounded, because those of a file lose bits when
its unit changes."""

MAX_GAUSSIANS = 500_000
"""Maximum number of Gaussians from which a body is measured (``representatives``)."""
_WIDE = 1.0 / 64.0
"""Width above which all Gaussians are kept, as a fraction of the body's size: one spacing of the lattice on which its
solid is found."""


def centred(cloud: GaussianCloud) -> tuple[GaussianCloud, np.ndarray]:
    """Move the capture to an origin amid its Gaussians; return the moved capture and the origin (3,), capture's units.

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
    keys = np.concatenate(
        [
            cloud.sh.numpy()[:, 0].T,
            cloud.log_scales.numpy().T,
            cloud.rotations.numpy().T,
            cloud.opacity_logits.numpy()[None],
            cloud.means.numpy()[:, ::-1].T,
        ]
    )
    # Few Gaussians agree in x and y. One sort of both is faster than one for each of the keys.
    first = _increasing_bits(keys[-1]) << np.uint64(32) | _increasing_bits(keys[-2])
    order = np.argsort(first)
    equal = first[order][1:] == first[order][:-1]
    tied = np.append(equal, False) | np.append(False, equal)
    rows = np.sort(order[tied])
    order[tied] = rows[np.lexsort(keys[:, rows])]
    return order


def _increasing_bits(values: np.ndarray) -> np.ndarray:
    """(n,) uint64 below 2^32 that sort like the float32 ``values`` (n,); 0 and -0 give the same integer."""
    bits = (values + np.float32(0.0)).view(np.uint32)
    return np.where(bits >> 31 == 1, ~bits, bits | np.uint32(1 << 31)).astype(np.uint64)


def representatives(cloud: GaussianCloud) -> GaussianCloud:
    """Return at most ``MAX_GAUSSIANS`` Gaussians that show the same body; the cloud itself if it has no more than that.

    All wide Gaussians remain, because a few of them show much of the surface. The others are sampled evenly.
    """
    if cloud.count <= MAX_GAUSSIANS:
        return cloud
    order = canonical_order(cloud)
    some = cloud.means.numpy()[order[:: -(-cloud.count // MAX_GAUSSIANS)]]
    size = float(np.ptp(np.quantile(some, (0.01, 0.99), axis=0), axis=0).max())
    wide = cloud.breadths() > _WIDE * size
    if np.count_nonzero(wide) > MAX_GAUSSIANS // 2:
        wide[:] = False
    others = order[~wide[order]]
    count = MAX_GAUSSIANS - np.count_nonzero(wide)
    return cloud.subset(np.concatenate([np.flatnonzero(wide), others[np.arange(count) * len(others) // count]]))


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
