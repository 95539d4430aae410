"""Decimation of a capture: pairs of neighbours are merged into Gaussians with the moments of the pairs.

Pairs are neighbours along a Morton curve. The pairs that increase the weighted variance of positions and colours least
are merged first (J. H. Ward, "Hierarchical grouping to optimize an objective function", 1963).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import logit

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.morton import morton_order

_MIN_OPACITY, _MAX_OPACITY = 1e-6, 0.999
_MERGED = -1
_TINY = 1e-300
_MIN_VARIANCE = 1e-14
"""Minimum variance of a merged Gaussian along an axis, relative to its maximum variance. Rounding could make the
variance of a flat Gaussian negative."""
_BLOCK_ROWS = 1 << 18


def decimated(cloud: GaussianCloud, count: int) -> tuple[GaussianCloud, float]:
    """Merge Gaussians until ``count`` remain.

    The weight of a Gaussian is its opacity times the product of its two largest standard deviations. A pair is replaced
    by a Gaussian with the weighted mean, the weighted covariance, the sum of the weights, and the weighted mean of the
    colours.

    Args:
        cloud: The capture.
        count: Number of Gaussians of the result, from 1 to the number in ``cloud``.

    Returns:
        The decimated capture, and the weighted root mean square of the distances by which Gaussians were moved, scene
        units.
    """
    means, covariances = cloud.means.numpy().astype(np.float64), _covariances(cloud)
    weights, sh = cloud.opacities() * _areas(covariances), cloud.sh.numpy().copy()
    sources = np.arange(cloud.count)
    squares, total = 0.0, float(weights.sum())
    while len(means) > count:
        order = morton_order(means)
        a, b = order[0 : len(order) // 2 * 2 : 2], order[1::2]
        both = weights[a] + weights[b]
        share = weights[b] / np.maximum(both, _TINY)
        steps = means[b] - means[a]
        distances = np.einsum("ni,ni->n", steps, steps)
        colours = SH_BAND_0**2 * ((sh[b, 0] - sh[a, 0]) ** 2).sum(axis=1)
        cost = weights[a] * share * (distances / max(float(np.median(distances)), _TINY) + colours)
        # Merge at most half of the pairs, because the other Gaussians can find better partners in the next round.
        chosen = np.sort(np.argsort(cost, kind="stable")[: max(1, min(len(means) - count, len(a) // 2))])
        a, b, both, share, steps = a[chosen], b[chosen], both[chosen], share[chosen], steps[chosen]
        squares += float((weights[a] * share * distances[chosen]).sum())
        mixed = covariances[a] + share[:, None, None] * (covariances[b] - covariances[a])
        covariances[a] = mixed + (share * (1.0 - share))[:, None, None] * steps[:, :, None] * steps[:, None, :]
        means[a] += share[:, None] * steps
        sh[a] += share[:, None, None].astype(np.float32) * (sh[b] - sh[a])
        weights[a], sources[a] = both, _MERGED
        kept = np.ones(len(means), bool)
        kept[b] = False
        means, covariances, weights, sh, sources = (x[kept] for x in (means, covariances, weights, sh, sources))
    return _cloud(cloud, means, covariances, weights, sh, sources), (squares / max(total, _TINY)) ** 0.5


def _covariances(cloud: GaussianCloud) -> np.ndarray:
    """Return the covariances (n, 3, 3) float64 of the Gaussians."""
    covariances = np.empty((cloud.count, 3, 3))
    quaternions, log_scales = cloud.rotations.numpy(), cloud.log_scales.numpy()
    for start in range(0, cloud.count, _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        axes = Rotation.from_quat(quaternions[rows][:, [1, 2, 3, 0]]).as_matrix()
        axes *= np.exp(log_scales[rows].astype(np.float64))[:, None, :]
        covariances[rows] = axes @ axes.transpose(0, 2, 1)
    return covariances


def _areas(covariances: np.ndarray) -> np.ndarray:
    """Return the products (n,) of the two largest standard deviations."""
    squares = np.maximum(np.linalg.eigvalsh(covariances), 0.0)
    return np.sqrt(squares[:, 1] * squares[:, 2])


def _cloud(
    cloud: GaussianCloud,
    means: np.ndarray,
    covariances: np.ndarray,
    weights: np.ndarray,
    sh: np.ndarray,
    sources: np.ndarray,
) -> GaussianCloud:
    """Return the Gaussians of ``cloud`` with indices ``sources``; where the index is ``_MERGED``, return a merged
    Gaussian."""
    merged = sources == _MERGED
    variances, axes = np.linalg.eigh(covariances[merged])
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    variances = np.maximum(variances, _MIN_VARIANCE * variances[:, 2:])
    areas = np.sqrt(variances[:, 1] * variances[:, 2])
    rotations, log_scales, logits = (
        x.numpy()[sources] for x in (cloud.rotations, cloud.log_scales, cloud.opacity_logits)
    )
    rotations[merged] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    log_scales[merged] = 0.5 * np.log(variances)
    logits[merged] = logit(np.clip(weights[merged] / areas, _MIN_OPACITY, _MAX_OPACITY))
    new = GaussianCloud.from_numpy(means, rotations, log_scales, logits, sh, device=str(cloud.device))
    # Other properties of the cloud do not change.
    return replace(
        cloud,
        means=new.means,
        rotations=new.rotations,
        log_scales=new.log_scales,
        opacity_logits=new.opacity_logits,
        sh=new.sh,
    )
