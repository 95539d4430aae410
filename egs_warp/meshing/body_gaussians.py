"""Gaussians for the mechanics, in the frame of the body and in a canonical order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.body_frame import BodyFrame, upright_frame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

_STEPS_PER_E = 64
"""Number of steps per factor of e to which log scales are rounded (1.6 % each). Rounding is needed because a change of
the unit of the file changes the last bits of log scales."""

MAX_GAUSSIANS = 500_000
"""Maximum number of Gaussians that define a body (``representatives``)."""
_WIDE = 1.0 / 64.0
"""Width, as a fraction of the body's size, above which all Gaussians are kept. It is one spacing of the lattice of the
body's solid."""


def centred(cloud: GaussianCloud) -> tuple[GaussianCloud, np.ndarray]:
    """Move the capture so that its origin is in the middle of its Gaussians.

    Returns the moved capture and the new origin (3,) in the capture's frame and units. Each coordinate of the origin is
    a coordinate of some Gaussian, so a translation that is exact in single precision does not change the result.
    """
    means = cloud.means.numpy().astype(np.float64)
    origin = np.sort(means, axis=0)[len(means) // 2]
    return replace(
        cloud, means=wp.array((means - origin).astype(np.float32), dtype=wp.vec3, device=cloud.device)
    ), origin


def canonical_order(cloud: GaussianCloud) -> np.ndarray:
    """Return the indices (n,) that sort the Gaussians by their values, means first, so that results do not depend on
    the order in a file."""
    keys = np.concatenate(
        [
            cloud.sh.numpy()[:, 0].T,
            cloud.log_scales.numpy().T,
            cloud.rotations.numpy().T,
            cloud.opacity_logits.numpy()[None],
            cloud.means.numpy()[:, ::-1].T,
        ]
    )
    # Few Gaussians have equal x and y, and one sort by both is faster than one sort per key.
    first = _increasing_bits(keys[-1]) << np.uint64(32) | _increasing_bits(keys[-2])
    order = np.argsort(first)
    equal = first[order][1:] == first[order][:-1]
    tied = np.append(equal, False) | np.append(False, equal)
    rows = np.sort(order[tied])
    order[tied] = rows[np.lexsort(keys[:, rows])]
    return order


def _increasing_bits(values: np.ndarray) -> np.ndarray:
    """Return integers (n,) uint64 below 2^32 in the same order as the float32 ``values`` (n,); 0 and -0 have the same
    integer."""
    bits = (values + np.float32(0.0)).view(np.uint32)
    return np.where(bits >> 31 == 1, ~bits, bits | np.uint32(1 << 31)).astype(np.uint64)


def representatives(cloud: GaussianCloud) -> GaussianCloud:
    """Return at most ``MAX_GAUSSIANS`` Gaussians that represent the same body; the cloud itself if it is small enough.

    All wide Gaussians are kept, because each of them covers much of the surface. The others are sampled evenly.
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
    """Return the frame of the body in ``cloud`` on ``plane`` (``upright_frame``), with each Gaussian weighted by its
    opacity."""
    order = canonical_order(cloud)
    return upright_frame(cloud.means.numpy()[order].astype(np.float64), cloud.opacities()[order], plane)


def body_gaussians(cloud: GaussianCloud, frame: BodyFrame) -> GaussianCloud:
    """Return the capture in ``frame``, with SH band 0 only, in canonical order.

    The result is bitwise independent of the order of the capture's Gaussians. It is also bitwise independent of a
    factor of two in the unit, except for a scale so close to the boundary between two steps that rounding decides.
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
