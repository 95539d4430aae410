"""Splitting of bent Gaussians in the rest configuration, so that their parts can bend (Eq. 16, 17)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import warp as wp

from egs_warp.deformation.deformer import BendMeasure, Deformer
from egs_warp.deformation.embedding import GaussianEmbedding, embed_gaussians
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.kernels.deformation.splitting import split_kernel
from egs_warp.launching import empty, launch_rows

MIN_OPACITY = 2.0 / 255.0
"""Maximum opacity of a Gaussian that is never split, because its error is invisible."""

SPLIT_DEGREES = 4.0
"""Minimum angle, deg, between the two ends of an axis at which it is split, for arms of sqrt 3 standard deviations. The
paper's 15 degrees for arms of 3 standard deviations correspond to 9 degrees here. On the chair of Table 1, splitting at
9 instead of 4 degrees lowers the PSNR by 0.01 to 0.02 dB, and by more if smaller fit errors are split."""

MIN_FIT_ERROR = 7e-4
"""Minimum fit error at which a Gaussian is split, relative to the cage's diagonal. A smaller value would represent
motions more accurately (benchmarks/table1.py), but the additional splits would lower a fuzzy capture's image at rest to
below 45 dB."""


class SplitRule(Enum):
    """Rule that selects the Gaussians to split, the axis along which each is split, and the children. Every rule
    preserves mass, mean and covariance exactly."""

    MEASURED = "measured"
    """Three children at -s, 0, s with standard deviation s/sqrt 2 (mixture weights 1/4, 1/2, 1/4), with the opacities
    that minimise the image error; along the axis with the largest fit error, where that error is visible."""
    PAPER = "paper"
    """Two children of half-normal mean and variance (Eq. 17 with kappa = gamma sqrt(pi/2)), along the longest axis."""


@dataclass(frozen=True)
class SplitGaussians:
    """Cloud after splitting, still in the rest configuration, with its own embedding."""

    cloud: GaussianCloud
    """(n',) Gaussians: first those that were not split, in their original order, then the children."""
    embedding: GaussianEmbedding
    """Embedding of the n' Gaussians."""
    parents: np.ndarray
    """(n',) int32, index in the original cloud of the Gaussian from which each one comes."""
    depths: np.ndarray
    """(n',) int8, number of successive splits that led to each Gaussian."""

    @property
    def split_count(self) -> int:
        """Number of Gaussians of the original cloud that were replaced by children."""
        return len(np.unique(self.parents[self.depths > 0]))


# Opacity of one Gaussian, and of the outer and the middle of its three children, that minimise the difference between
# the images of parent and children (root mean square over viewing directions spread evenly over the sphere). The
# remaining difference is 1.5 to 1.9 % of the opacity. benchmarks/splitting.py recomputes the table.
_OPACITIES = np.array(
    [
        (0.0, 0.0, 0.0),
        (0.01, 0.00292, 0.00754),
        (0.02, 0.00584, 0.01511),
        (0.05, 0.01463, 0.03801),
        (0.1, 0.02937, 0.07683),
        (0.2, 0.05919, 0.15706),
        (0.3, 0.08939, 0.24106),
        (0.4, 0.11989, 0.32920),
        (0.5, 0.15057, 0.42188),
        (0.6, 0.18132, 0.51953),
        (0.7, 0.21196, 0.62260),
        (0.8, 0.24228, 0.73153),
        (0.85, 0.25725, 0.78834),
        (0.9, 0.27203, 0.84678),
        (0.95, 0.28658, 0.90689),
        (0.98, 0.29519, 0.94378),
        (0.99, 0.29803, 0.95621),
        (1.0, 0.30088, 0.96870),
    ]
)


def child_layout(rule: SplitRule) -> tuple[np.ndarray, float]:
    """Return the offsets (k,) of the children and their standard deviation, both in standard deviations of the parent
    (Eq. 17)."""
    if rule is SplitRule.PAPER:
        return np.array([-1.0, 1.0]) * np.sqrt(2.0 / np.pi), float(np.sqrt(1.0 - 2.0 / np.pi))
    return np.array([-1.0, 0.0, 1.0]), float(np.sqrt(0.5))


def child_opacities(opacities: np.ndarray, rule: SplitRule) -> np.ndarray:
    """Return the peak opacities (n, k) of the children of Gaussians with peak ``opacities`` (n,), 0 to 1."""
    if rule is SplitRule.PAPER:
        # Each child has half of the mass. The peak of a narrower Gaussian of the same mass is higher.
        peak = np.minimum(opacities / (2.0 * np.sqrt(1.0 - 2.0 / np.pi)), 0.99)
        return np.repeat(peak[:, None], 2, axis=1)
    outer = np.interp(opacities, _OPACITIES[:, 0], _OPACITIES[:, 1])
    middle = np.interp(opacities, _OPACITIES[:, 0], _OPACITIES[:, 2])
    return np.stack([outer, middle, outer], axis=1)


def split_bent(
    cloud: GaussianCloud,
    embedding: GaussianEmbedding,
    bend: BendMeasure,
    *,
    threshold_degrees: float = SPLIT_DEGREES,
    min_error: float | None = None,
    rule: SplitRule = SplitRule.MEASURED,
    parents: np.ndarray | None = None,
    depths: np.ndarray | None = None,
    max_depth: int = 3,
    max_count: int | None = None,
) -> SplitGaussians:
    """Replace each Gaussian that ``bend`` marks by its children, once (Eq. 17), in the rest configuration.

    ``MEASURED`` marks an axis whose ends are rotated relative to each other by more than ``threshold_degrees``, if its
    fit error is larger than ``min_error``. ``PAPER`` marks Gaussians by theta of Eq. (16) alone.

    Args:
        cloud: n Gaussians.
        embedding: their embedding.
        bend: measured bend of each Gaussian.
        threshold_degrees: minimum angle, in degrees, at which a Gaussian is split.
        min_error: minimum fit error at one standard deviation, m; default: ``MIN_FIT_ERROR`` times the cage's diagonal.
        rule: rule to apply.
        parents, depths: (n,), results of an earlier call; default: no Gaussian has been split.
        max_depth: number of splits after which a Gaussian is not split again.
        max_count: maximum number of Gaussians; if it would be exceeded, only those with the largest fit errors are
            split.
    """
    count = cloud.count
    parents = np.arange(count, dtype=np.int32) if parents is None else parents
    depths = np.zeros(count, dtype=np.int8) if depths is None else depths
    opacities = cloud.opacities()
    if rule is SplitRule.PAPER:
        axes = np.argmax(cloud.log_scales.numpy(), axis=1)
        marked = bend.bend_degrees > threshold_degrees
    else:
        error_limit = MIN_FIT_ERROR * embedding.cage.extent if min_error is None else min_error
        error = np.where(bend.curl_degrees > threshold_degrees, bend.fit_error, 0.0)
        axes = np.argmax(error, axis=1)
        marked = error.max(axis=1) > error_limit
    marked &= (depths < max_depth) & (opacities > MIN_OPACITY)
    offsets, shrink = child_layout(rule)
    chosen = np.flatnonzero(marked)
    if max_count is not None:
        capacity = max(0, (max_count - count) // (len(offsets) - 1))
        worst = np.argsort(-bend.fit_error.max(axis=1)[chosen], kind="stable")[:capacity]
        chosen = np.sort(chosen[worst])
    if len(chosen) == 0:
        return SplitGaussians(cloud, embedding, parents, depths)
    unsplit = np.setdiff1d(np.arange(count), chosen)
    sources = np.concatenate([unsplit, np.repeat(chosen, len(offsets))]).astype(np.int32)
    split_axes = np.full(len(sources), -1, dtype=np.int32)
    split_axes[len(unsplit) :] = np.repeat(axes[chosen], len(offsets))
    row_offsets = np.zeros(len(sources), dtype=np.float32)
    row_offsets[len(unsplit) :] = np.tile(offsets, len(chosen))
    logits = cloud.opacity_logits.numpy()[sources]
    peaks = np.clip(child_opacities(opacities[chosen], rule), 1e-6, 1.0 - 1e-6).ravel()
    logits[len(unsplit) :] = np.log(peaks / (1.0 - peaks))
    children = _gather(cloud, sources, split_axes, row_offsets, shrink, logits)
    return SplitGaussians(
        children,
        embed_gaussians(children, embedding.cage, gamma=embedding.gamma),
        parents[sources],
        (depths[sources] + (split_axes >= 0)).astype(np.int8),
    )


def split_for_motion(
    cloud: GaussianCloud,
    embedding: GaussianEmbedding,
    frames: Sequence[wp.array | np.ndarray],
    *,
    threshold_degrees: float = SPLIT_DEGREES,
    min_error: float | None = None,
    rule: SplitRule = SplitRule.MEASURED,
    max_depth: int = 3,
    max_growth: float = 4.0,
) -> SplitGaussians:
    """Split all Gaussians that bend too much in any of ``frames``, repeatedly, until none does.

    Call it once, before the first frame of a motion that is known in advance, so that the set of Gaussians does not
    change during the motion. A few frames that contain the extremes are enough. ``split_bent`` describes the rules.

    Args:
        frames: node positions of each frame, as for ``deform``.
        max_growth: maximum ratio of the number of Gaussians after the splits to the number before.
    """
    result = SplitGaussians(
        cloud, embedding, np.arange(cloud.count, dtype=np.int32), np.zeros(cloud.count, dtype=np.int8)
    )
    for _ in range(max_depth):
        before = result.cloud.count
        result = split_bent(
            result.cloud,
            result.embedding,
            Deformer(result.cloud, result.embedding).measure_bend(frames),
            threshold_degrees=threshold_degrees,
            min_error=min_error,
            rule=rule,
            parents=result.parents,
            depths=result.depths,
            max_depth=max_depth,
            max_count=int(max_growth * cloud.count),
        )
        if result.cloud.count == before:
            break
    return result


def _gather(
    cloud: GaussianCloud,
    sources: np.ndarray,
    axes: np.ndarray,
    offsets: np.ndarray,
    shrink: float,
    opacity_logits: np.ndarray,
) -> GaussianCloud:
    count = len(sources)
    with wp.ScopedDevice(cloud.device):
        result = GaussianCloud(
            means=empty(count, wp.vec3, cloud.device),
            rotations=empty(count, wp.vec4, cloud.device),
            log_scales=empty(count, wp.vec3, cloud.device),
            opacity_logits=wp.array(opacity_logits, dtype=wp.float32),
            sh=empty((count, cloud.sh.shape[1]), wp.vec3, cloud.device),
            antialiased=cloud.antialiased,
        )
        plan = [wp.array(sources, dtype=wp.int32), wp.array(axes, dtype=wp.int32), wp.array(offsets, dtype=wp.float32)]
    launch_rows(
        split_kernel,
        count,
        inputs=[*plan, shrink, cloud.means, cloud.rotations, cloud.log_scales, cloud.sh],
        outputs=[result.means, result.rotations, result.log_scales, result.sh],
        device=cloud.device,
    )
    return result
